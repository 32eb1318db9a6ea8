"""Attaches observers to a run: `cpnet view`, `top`, `record`; `foxglove` converts a recording.

Packages of extras, and those that take long to import, are imported when they are needed. Then the
priority is lowered: a run may be going on.
"""

from __future__ import annotations

import signal
import subprocess
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from cpnet.discovery import RunLocation, find_run
from cpnet.exit_report import describe_status
from cpnet.run_monitor import StopSignals
from protocol.config import is_file, is_folder, is_free
from protocol.errors import ConfigError, CpnetError
from protocol.extras import to_install
from protocol.messages import Setup
from protocol.observer import Observer, lower_priority
from protocol.process import loop

if TYPE_CHECKING:
    from recording.mcap.recorder import McapRecorder

NOTICE_AFTER_S = 2.0


@contextmanager
def connecting_to(run: RunLocation, console: Console) -> Iterator[None]:
    """Prints which run is being connected to, if connecting takes a while."""
    where = f"{run.v2x.locator} and {run.world.locator}"

    def notify() -> None:
        console.print(
            f"looking for the run at {where}", markup=False, highlight=False, soft_wrap=True
        )

    timer = threading.Timer(NOTICE_AFTER_S, notify)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


CONNECT_MS = 20_000  # a run that has just been started
SETUP_S = 30.0


@dataclass(frozen=True, slots=True)
class Screen:
    """Output of the viewer: a page at a port, a file, or else a window; its maximum frame rate."""

    port: int | None
    save: Path | None
    fps: float


def view(
    run: Path | None,
    connect: list[str],
    keys: Path | None,
    tls: str | None,
    screen: Screen,
    console: Console,
) -> None:
    """Shows a run, or one junction of it, in Rerun until it ends or a signal stops the viewer.

    Raises:
        ConfigError: there is no such run or signal, the extra is missing, or the output cannot be
            opened.
        BusError: the run does not answer.
        ProtocolError: the run's setup cannot be decoded.
        CpnetError: the page's server ended, or the file is not whole.
    """
    with needs_extra():
        from viewer.live import TOPICS, Live
        from viewer.rerun_log import Log
        from viewer.scene import Scene
        from viewer.sinks import check, opened
    check(screen.port, screen.save)
    lower_priority()
    found = find_run(run, connect, keys)
    with _attached(found, TOPICS, console) as (observer, setup, interruption):
        scene = Scene(setup, tls)
        with opened(screen.port, screen.save, scene) as sink:
            console.print(sink.where, markup=False, highlight=False, soft_wrap=True)
            log = Log(sink.recording, scene)
            following = Live(observer.inbox, scene, log, screen.fps)
            if sink.server is not None:
                _stop_without(sink.server, interruption.event)
            following.follow(interruption.event)
            drawn, left_out = following.drawn, following.left_out
            console.print(f"{drawn} frames shown, {left_out} left out to keep up", highlight=False)
            if sink.stays and not interruption.event.is_set():
                console.print("the run has ended; Ctrl-C takes the page away")
                interruption.event.wait()
            if sink.server is not None and (status := sink.server.poll()) is not None:
                if sink.stays:
                    raise CpnetError("Rerun, which served the page, has ended; view the run again")
                if status:  # else the user closed the window
                    raise CpnetError(
                        f"Rerun's window {describe_status(status)}; --web shows a page"
                    )


def top(
    run: Path | None,
    connect: list[str],
    keys: Path | None,
    tls: str | None,
    console: Console,
    *,
    once: bool,
) -> None:
    """Shows a run, or one junction of it, in the terminal until it ends or a signal stops it.

    Raises:
        ConfigError: there is no such run, or it has no such signal.
        BusError: the run does not answer.
    """
    from viewer import board, terminal

    if not once:
        lower_priority()
    found = find_run(run, connect, keys)
    with _attached(found, board.BOARD_TOPICS, console) as (observer, setup, interruption):
        filled = board.Board(setup, tls)
        if once:
            terminal.show_once(observer, filled, console, interruption.event)
        else:
            terminal.show(observer, filled, console, interruption.event)


@contextmanager
def _attached(
    run: RunLocation, topics: Iterable[str], console: Console
) -> Iterator[tuple[Observer, Setup, StopSignals]]:
    """Attaches an observer; until then a signal ends the command: there is nothing to close."""
    from viewer.live import modest_inbox

    with ExitStack() as stack:
        with connecting_to(run, console):
            observer = stack.enter_context(
                Observer(
                    run.v2x,
                    run.world,
                    topics,
                    inbox=modest_inbox(),
                    timeout_ms=CONNECT_MS,
                    yields=True,
                )
            )
            setup = observer.setup(SETUP_S)
        yield observer, setup, stack.enter_context(StopSignals())


def _stop_without(server: subprocess.Popen[bytes], stop: threading.Event) -> None:
    """Stops when the viewer's process has ended: a window was closed, a server died."""

    def wait() -> None:
        server.wait()
        stop.set()

    threading.Thread(target=wait, daemon=True).start()


@contextmanager
def needs_extra() -> Iterator[None]:
    """Names the extra where a package is missing that viewing needs."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"viewing needs {error.name} (extra `view`): {to_install('view')}"
        ) from None


STEM, FOXGLOVE_STEM = "record", "foxglove"


def record_run(
    running: RunLocation,
    out: Path | None,
    duration_s: float | None,
    console: Console,
    *,
    truth: bool,
) -> None:
    """Records a run until it is over, the duration has passed or a signal comes.

    A run on this machine waits for its recording, so that nothing is missing; one elsewhere does
    not: the network between may be slow.

    Raises:
        ConfigError: there can be no such file.
        BusError: a bus is not there, or does not answer with the setup.
        CpnetError: the disk is full, or fails.
    """
    from recording.mcap.recorder import McapRecorder, recorded_topics

    next_path = _next_path(running.run_dir or Path(), STEM, out)
    signal.signal(signal.SIGTSTP, signal.SIG_IGN)  # a run that waits for it would stop as well
    with ExitStack() as stack:
        with connecting_to(running, console):
            yields = running.run_dir is None
            observer = stack.enter_context(Observer(running.v2x, running.world, (), yields=yields))
            setup = observer.setup()
        lower_priority()  # but not for Zenoh's own threads, which publishers wait for
        observer.subscribe(recorded_topics(truth=truth))
        stop = stack.enter_context(StopSignals()).event
        recorder = McapRecorder(setup, next_path, observer.inbox, stop, truth=truth)
        console.print(
            f"recording to {recorder.writer.files[0]}; Ctrl-C ends it", markup=False, soft_wrap=True
        )
        if duration_s is not None:
            alarm = threading.Timer(duration_s, stop.set)
            alarm.daemon = True
            alarm.start()
        try:
            keep(recorder, observer, stop)
        except CpnetError:
            _print_result(recorder, console, "readable as far as it goes: ")
            raise
    _print_result(recorder, console)


def keep(recorder: McapRecorder, observer: Observer, stop: threading.Event) -> None:
    """Records what an observer receives until `stop` is set.

    Raises:
        CpnetError: the disk is full, or fails.
    """
    try:
        loop(recorder, observer.inbox, stop)
    finally:
        recorder.close()


def convert_recording(path: Path, out: Path | None, cloud_every: int, console: Console) -> None:
    """Converts a whole recording to Foxglove's messages.

    Raises:
        ConfigError: there is no such recording, or there can be no such file.
        CpnetError: the disk is full, or fails.
    """
    from recording.mcap.foxglove import export_foxglove
    from recording.mcap.reader import McapReader

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
    from recording.mcap.format import next_file

    if out is None:
        return lambda: next_file(folder, stem)
    if out.suffix != ".mcap" or not is_free(out):
        raise ConfigError(f"--out {out}: needs a new file NAME.mcap in a folder that is there")
    return lambda: out if not is_file(out) else next_file(out.parent, out.stem)


def _print_result(recorder: McapRecorder, console: Console, before: str = "") -> None:
    writer = recorder.writer
    names = ", ".join(map(str, writer.files))
    line = f"{before}{names}: {writer.messages} messages, {writer.size_bytes / 1e6:.1f} MB"
    line += f", {recorder.dropped} dropped"
    console.print(line, markup=False, highlight=False, soft_wrap=True)
