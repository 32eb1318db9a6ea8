"""A link in simulated time: a first-in, first-out queue before a path."""

from __future__ import annotations

from dataclasses import dataclass

from protocol.messages import MAX_DELAY_NS
from sensing.link.path import Path, on_air_bytes


@dataclass(frozen=True, slots=True)
class Passage:
    """A message's way over a virtual link, in simulated time.

    It was queued at `sent_ns`, its first bit left at `left_ns` and its last at `gone_ns`.
    """

    sent_ns: int
    left_ns: int
    gone_ns: int
    arrival_ns: int
    on_air_bytes: int

    @property
    def took_ns(self) -> int:
        """Time in the queue and on the link."""
        return min(self.arrival_ns - self.sent_ns, MAX_DELAY_NS)


class VirtualLink:
    """Says when messages arrive that are sent in simulated time; no clock is read."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._last: Passage | None = None
        self._before: list[Passage | None] = []  # of what may be recalled, what was last before it

    def send(self, now_ns: int, size_bytes: int, *, recallable: bool = False) -> Passage:
        """Queues a message of so many bytes of TCP payload.

        Messages keep their order, also where a later one would have the shorter delay.
        """
        left_ns = now_ns if self._last is None else max(now_ns, self._last.gone_ns)
        gone_ns = self._path.departure_ns(left_ns, size_bytes)
        arrival_ns = self._path.arrival_ns(left_ns, gone_ns)
        if self._last is not None:
            arrival_ns = max(arrival_ns, self._last.arrival_ns)
        if recallable:
            self._before.append(self._last)
        else:
            self._before.clear()
        self._last = Passage(now_ns, left_ns, gone_ns, arrival_ns, on_air_bytes(size_bytes))
        return self._last

    def recall(self, time_ns: int) -> list[Passage]:
        """Takes back what had not begun to leave then and may be taken back, the last one first.

        What is left counts as sent for good.
        """
        recalled = []
        while self._before and self._last is not None and self._last.left_ns >= time_ns:
            recalled.append(self._last)
            self._last = self._before.pop()
        self._before.clear()
        return recalled

    def backlog_ns(self, now_ns: int) -> int:
        """Returns how long what is queued now will take to leave."""
        return 0 if self._last is None else max(0, self._last.gone_ns - now_ns)

    def delay_ns(self, time_ns: int) -> int:
        """Returns how long a small message takes that goes the other way then."""
        return self._path.delay_ns(time_ns)
