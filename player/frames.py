"""What a tape holds, frame by frame."""

from __future__ import annotations

from collections.abc import Iterable

from protocol.inbox import Envelope
from protocol.limits import MAX_FRAMES_AHEAD
from protocol.sequence_window import SequenceWindow

CLOCK = "state"
"""The topic that tells which frames are real: one message a frame, from the world."""


class Frames:
    """Is read on as frames are asked for, and never back, so that a long tape takes no memory.

    A tape is in the order in which messages came: of a frame, some may lie as far behind as
    others of the `MAX_FRAMES_AHEAD` frames after it. What lies farther is counted in `late`,
    and what is of a frame that cannot be in `absurd`.
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
        """Returns the lowest frame near the tape's beginning that has one of these topics."""
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
        if item.topic == CLOCK:
            self._horizon.follow(frame)
        if frame <= self._taken:
            self.late += 1
        elif not self._horizon.admits(frame):
            self.absurd += 1
        else:
            self._waiting.setdefault(frame, []).append(item)
