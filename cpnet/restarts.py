"""How often a process may die and be started again."""

from __future__ import annotations

from collections import defaultdict, deque

MAX_RESTARTS = 5
WITHIN_NS = 30_000_000_000


class Restarts:
    """Remembers when each process was started again; dying all the time is no life."""

    def __init__(self) -> None:
        self._at_ns: dict[str, deque[int]] = defaultdict(lambda: deque(maxlen=MAX_RESTARTS))

    def admits(self, process: str, now_ns: int) -> bool:
        """Whether a process may be started once more now; if so, that counts."""
        times_ns = self._at_ns[process]
        if len(times_ns) == MAX_RESTARTS and now_ns - times_ns[0] < WITHIN_NS:
            return False
        times_ns.append(now_ns)
        return True
