"""The sequence window: which received frame numbers are plausible; absurd ones are refused."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

from protocol.limits import MAX_FRAMES_AHEAD

_STEPS = 3  # states of so many consecutive frames are accepted, wherever they are
_TRAIL = 16


class SequenceWindow:
    """Accepts frame numbers up to a few beyond the newest one known to be real.

    That is one that was finished, or one that the signal's states reached step by step: a process
    that was started in mid-run synchronises again. Until there is one, the lowest frame received
    counts.
    """

    def __init__(self) -> None:
        self._newest: int | None = None
        self._lowest: int | None = None
        self._trail: deque[int] = deque(maxlen=_TRAIL)

    @property
    def newest(self) -> int:
        """The newest real frame, else the lowest received, else -1."""
        if self._newest is not None:
            return self._newest
        return -1 if self._lowest is None else self._lowest

    def reach(self, frame: int) -> None:
        """Registers a frame that is known to be real."""
        self._newest = frame if self._newest is None else max(self._newest, frame)

    def follow(self, frame: int) -> None:
        """Registers the frame of a signal state."""
        self._trail.append(frame)
        if all(frame - back in self._trail for back in range(_STEPS)):
            self.reach(frame)

    def admits(self, frame: int) -> bool:
        """Whether a frame can be real."""
        if self._newest is None:
            self._lowest = frame if self._lowest is None else min(self._lowest, frame)
        return frame <= self.newest + MAX_FRAMES_AHEAD

    def farthest(self, frames: Iterable[int]) -> int:
        """Returns the frame that is farthest from the newest real one."""
        return max(frames, key=lambda frame: (abs(frame - self.newest), frame))
