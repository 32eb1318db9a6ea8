"""A tape once more, for other tools: what there was no time for beside the run."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from protocol.courtesy import Budget
from protocol.errors import CpnetError
from protocol.topics import TOPICS
from protocol.wire import peek_frame_time
from tape.names import GOES_ON_FROM
from tape.reader import Tape
from tape.scene import DRAWN, Scene
from tape.writer import TapeWriter


@dataclass(frozen=True, slots=True)
class Translation:
    """What came of it: the new files, and how many frames are in them."""

    files: list[Path]
    size_bytes: int
    frames: int


def translate(
    tape: Tape, next_path: Callable[[], Path], cloud_every: int, tell: Callable[[int], None]
) -> Translation:
    """Writes boxes and poses of all frames of a tape, and the clouds of every n-th.

    Args:
        tape: what of it cannot be read is left out, and counted there.
        next_path: says where a new file is to be.
        cloud_every: n; frames are counted as the run did.
        tell: is called with how many frames are done.

    Raises:
        ConfigError: the tape cannot be read, or there can be no such file.
        CpnetError: the disk is full, or fails; then nothing is left.
    """
    facts = {name: fact for name, fact in tape.facts.items() if name != GOES_ON_FROM}
    facts["made_of"] = ", ".join(file.name for file in tape.files)
    writer = TapeWriter(next_path, tape.setup, facts)
    scene = Scene(tape.setup, writer, Budget.endless(), Budget.endless())
    try:
        for item in tape.heard(DRAWN):
            number = peek_frame_time(item.data, TOPICS[item.topic].message).frame
            if number is not None and (item.topic != "scan" or number % cloud_every == 0):
                scene.take(item, number)
                _draw(scene, tell)
            writer.settle(item.received_ns)
        scene.finish()
        _draw(scene, tell)
        writer.close({"frames_left_out": str(scene.frames_left_out)})
    except BaseException:  # an interruption as well: half of it would look whole
        with suppress(CpnetError):
            writer.close({})
        for file in writer.files:
            file.unlink(missing_ok=True)
        raise
    return Translation(writer.files, writer.size_bytes, scene.frames_drawn)


def _draw(scene: Scene, tell: Callable[[int], None]) -> None:
    drawn = False
    while scene.step():
        drawn = True
    if drawn:
        tell(scene.frames_drawn)
