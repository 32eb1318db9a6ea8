"""How far an agent is believed, from one frame to the next."""

from __future__ import annotations

FALL = 0.3  # how much of a worse frame's score is taken over
RISE = 0.05  # of a better one's: who was caught is believed again only after a while
BACK = 0.2  # how far over the threshold the score must rise


class Trust:
    """A mean over frames that falls fast and rises slowly, and a yes or no with hysteresis.

    Whoever is new is believed. One odd frame does not change that; one in four does.
    """

    __slots__ = ("_threshold", "is_believed", "score")

    def __init__(self, threshold: float) -> None:
        self._threshold = threshold
        self.score = 1.0
        self.is_believed = True

    def add(self, score: float) -> None:
        """Takes a frame's score, 0 to 1."""
        self.score += (FALL if score < self.score else RISE) * (score - self.score)
        mark = self._threshold if self.is_believed else self._threshold + BACK
        self.is_believed = self.score >= min(mark, 0.99)
