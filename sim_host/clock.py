"""The beat of the frames in realtime mode."""

from __future__ import annotations


class Beat:
    """When the next frame is due, in monotonic ns. A world that falls behind slips."""

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._due_ns: int | None = None
        self.late = 0

    def wait_ns(self, now_ns: int) -> int:
        """Returns how long to wait for the next frame, 0 if it is due."""
        return 0 if self._due_ns is None else max(0, self._due_ns - now_ns)

    def strike(self, now_ns: int) -> None:
        """Notes that a frame begins now; one that is a whole period late shifts all that follow."""
        due_ns = now_ns if self._due_ns is None else self._due_ns
        if now_ns - due_ns >= self._period_ns:
            self.late += 1
            due_ns = now_ns
        self._due_ns = due_ns + self._period_ns
