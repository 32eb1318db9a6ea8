"""When a run is over: the world has ended and what the others say of its last frame has come."""

from __future__ import annotations

from recorder.ledger import Ledger

PATIENCE_NS = 2_000_000_000
SILENCE_NS = 150_000_000
LAST_TO_SPEAK = frozenset({"edge", "signal"})


class Ending:
    """Waits for stragglers: topics of two buses and many processes keep no common order."""

    def __init__(self) -> None:
        self._began_ns: int | None = None
        self._awaits_last_frame = True
        self._heard_ns = 0

    def begin(self, now_ns: int, *, in_time: bool) -> None:
        """The world stops; if before its time, the last frame is not waited for."""
        self._began_ns = now_ns
        self._awaits_last_frame = in_time

    def heard(self, now_ns: int) -> None:
        """Something was said."""
        self._heard_ns = max(self._heard_ns, now_ns)

    def is_over(self, now_ns: int, ledger: Ledger) -> bool:
        """Whether the last frame is whole and all are silent, or patience has run out."""
        if self._began_ns is None:
            return False
        if now_ns - self._began_ns >= PATIENCE_NS:
            return True
        if self._awaits_last_frame and not _is_whole(ledger):
            return False
        return now_ns - self._heard_ns >= SILENCE_NS


def _is_whole(ledger: Ledger) -> bool:
    last = ledger.get(ledger.newest_tick)
    return last is not None and last.heard >= LAST_TO_SPEAK and last.detections is not None
