"""`cpnet record` attaches to a run and keeps what is said; `cpnet foxglove` makes more of that."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from rich.console import Console

from cpnet.discovery import RunLocation
from cpnet.looking import looking_for
from cpnet.run_monitor import StopSignals
from protocol.config import is_file, is_folder, is_free
from protocol.errors import ConfigError, CpnetError
from protocol.onlooker import Onlooker, lower_priority
from protocol.process import loop
from recording.mcap.format import next_file
from recording.mcap.foxglove import export_foxglove
from recording.mcap.reader import McapReader
from recording.mcap.recorder import McapRecorder, RecordedContent

STEM, FOXGLOVE_STEM = "record", "foxglove"


def record_run(
    running: RunLocation,
    choice: RecordedContent,
    out: Path | None,
    duration_s: float | None,
    console: Console,
) -> None:
    """Tapes a run until it is over, the duration has passed or a signal comes.

    A run on this machine waits for its recording, so that nothing is missing; one elsewhere does
    not: the network between may be slow.

    Raises:
        ConfigError: there can be no such file.
        BusError: a bus is not there, or nobody tells the setup.
        CpnetError: the disk is full, or fails.
    """
    next_path = _next_path(running.run_dir or Path(), STEM, out)
    signal.signal(signal.SIGTSTP, signal.SIG_IGN)  # a run that waits would stand still as well
    with ExitStack() as stack:
        with looking_for(running, console):
            yields = running.run_dir is None
            onlooker = stack.enter_context(Onlooker(running.v2x, running.world, (), yields=yields))
            setup = onlooker.setup()
        lower_priority()  # but for Zenoh's own threads: who is waited for must not be slow to take
        onlooker.hear(choice.topics)
        stop = stack.enter_context(StopSignals()).event
        recorder = McapRecorder(setup, next_path, onlooker.inbox, choice, stop)
        console.print(
            f"recording to {recorder.writer.files[0]}; Ctrl-C ends it", markup=False, soft_wrap=True
        )
        if duration_s is not None:
            alarm = threading.Timer(duration_s, stop.set)
            alarm.daemon = True
            alarm.start()
        try:
            keep(recorder, onlooker, stop)
        except CpnetError:
            _tell(recorder, console, "readable as far as it goes: ")
            raise
    _tell(recorder, console)


def keep(recorder: McapRecorder, onlooker: Onlooker, stop: threading.Event) -> None:
    """Tapes what an onlooker hears until it is told to stop.

    Raises:
        CpnetError: the disk is full, or fails.
    """
    try:
        loop(recorder, onlooker.inbox, stop)
    finally:
        recorder.close()


def convert_recording(path: Path, out: Path | None, cloud_every: int, console: Console) -> None:
    """Writes what a recording holds for other tools, all of it.

    Raises:
        ConfigError: there is no such recording, or there can be no such file.
        CpnetError: the disk is full, or fails.
    """
    recording = McapReader(path)
    folder = path if is_folder(path) else path.parent
    next_path = _next_path(folder, FOXGLOVE_STEM, out)
    with console.status("") as status:
        made = export_foxglove(
            recording, next_path, cloud_every, lambda done: status.update(f"{done} frames are done")
        )
    names = ", ".join(map(str, made.files))
    line = f"{names}: {made.frames} frames, {made.size_bytes / 1e6:.1f} MB"
    if not recording.is_whole or recording.drops:
        line += f"; {recording.path} is not whole, what could be read is there"
    console.print(line, markup=False, highlight=False, soft_wrap=True)


def _next_path(folder: Path, stem: str, out: Path | None) -> Callable[[], Path]:
    if out is None:
        return lambda: next_file(folder, stem)
    if out.suffix != ".mcap" or not is_free(out):
        raise ConfigError(f"--out {out}: needs a new file NAME.mcap in a folder that is there")
    return lambda: out if not is_file(out) else next_file(out.parent, out.stem)


def _tell(recorder: McapRecorder, console: Console, before: str = "") -> None:
    writer = recorder.writer
    names = ", ".join(map(str, writer.files))
    line = f"{before}{names}: {writer.messages} messages, {writer.size_bytes / 1e6:.1f} MB"
    line += f", {recorder.dropped} dropped"
    if recorder.scene is not None:
        frames, clouds = recorder.scene.frames_left_out, recorder.scene.clouds_left_out
        line += f"; for Foxglove without {frames} frames, and without clouds in {clouds} more"
    console.print(line, markup=False, highlight=False, soft_wrap=True)
