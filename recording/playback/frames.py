"""The frames of a recording, one after another."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from protocol.errors import ConfigError
from protocol.inbox import Envelope
from protocol.limits import MAX_FRAMES_AHEAD
from protocol.messages import Roster, SignalState, Tick, Truth
from protocol.sequence_window import SequenceWindow
from recording.mcap.reader import McapReader

FRAME_TOPIC = "state"
"""The topic that tells which frames are real: one message a frame, from the world."""


class RecordedFrames:
    """Is read on as frames are asked for, and never back, so that a long recording takes no memory.

    Messages are in the order of their arrival: some of a frame may come after others of the
    `MAX_FRAMES_AHEAD` frames that follow it. Later ones are counted in `late`, those with an
    impossible frame number in `absurd`.
    """

    def __init__(self, heard: Iterable[Envelope]) -> None:
        self._heard = iter(heard)
        self._has_more = True
        self._waiting: dict[int, list[Envelope]] = {}
        self._horizon = SequenceWindow()
        self._taken = -1
        self.late = 0
        self.absurd = 0

    def first(self, *topics: str) -> int | None:
        """Returns the lowest frame near the recording's beginning that has one of these topics."""
        self._read_beyond(0)
        self._read_beyond(min(self._waiting, default=0))
        return min(
            (
                frame
                for frame, items in self._waiting.items()
                if any(item.topic in topics for item in items)
            ),
            default=None,
        )

    def take(self, frame: int) -> list[Envelope]:
        """Returns all of a frame, in the order in which it came, and forgets those before it."""
        self._read_beyond(frame)
        for passed in [number for number in self._waiting if number < frame]:
            del self._waiting[passed]
        self._taken = max(self._taken, frame)
        return self._waiting.pop(frame, [])

    def _read_beyond(self, frame: int) -> None:
        while self._has_more and self._horizon.newest < frame + MAX_FRAMES_AHEAD:
            item = next(self._heard, None)
            if item is None:
                self._has_more = False
            else:
                self._sort(item)

    def _sort(self, item: Envelope) -> None:
        frame: int = getattr(item.message, "frame", -1)
        if item.topic == FRAME_TOPIC:
            self._horizon.follow(frame)
        if frame <= self._taken:
            self.late += 1
        elif not self._horizon.admits(frame):
            self.absurd += 1
        else:
            self._waiting.setdefault(frame, []).append(item)


_VEHICLE = "vehicle-"


@dataclass(frozen=True, slots=True)
class RecordingSummary:
    """So many frames in a row, of which the recording may lack some; `vehicles` are processes."""

    frames: int
    vehicles: int
    has_truth: bool

    @classmethod
    def of(cls, recording: McapReader) -> RecordingSummary:
        """Goes through a recording once.

        Raises:
            ConfigError: there is no frame on it, or it cannot be read.
        """
        horizon = SequenceWindow()
        times: set[int] = set()
        vehicles, has_truth = 0, False
        for item in recording.heard(["tick", "truth", "roster", FRAME_TOPIC]):
            message = item.message
            if isinstance(message, SignalState):
                horizon.follow(message.frame)
            if isinstance(message, Tick | SignalState) and horizon.admits(message.frame):
                times.add(message.frame)
            has_truth |= isinstance(message, Truth)
            if isinstance(message, Roster):
                vehicles = max(vehicles, _number(item.parts.get("process", "")) + 1)
        if not times:
            raise ConfigError(
                f"{recording.path}: holds no frame, neither a tick nor a state of the signal"
            )
        return cls(max(times) - min(times) + 1, vehicles, has_truth)


def _number(process: str) -> int:
    number = process.removeprefix(_VEHICLE)
    return int(number) if process != number and number.isdigit() and len(number) < 4 else -1
