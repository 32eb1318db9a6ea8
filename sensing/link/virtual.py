"""A link in simulated time: a first-in, first-out queue before a path."""

from __future__ import annotations

from sensing.link.path import Path


class VirtualLink:
    """Says when messages arrive that are sent in simulated time; no clock is read."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._free_ns: int | None = None
        self._arrived_ns: int | None = None

    def send(self, now_ns: int, size_bytes: int) -> int:
        """Queues a message of so many bytes of TCP payload; returns when all of it has arrived.

        Messages keep their order, also where a later one would have the shorter delay.
        """
        start_ns = now_ns if self._free_ns is None else max(now_ns, self._free_ns)
        self._free_ns = self._path.departure_ns(start_ns, size_bytes)
        arrival_ns = self._path.arrival_ns(start_ns, self._free_ns)
        if self._arrived_ns is not None:
            arrival_ns = max(arrival_ns, self._arrived_ns)
        self._arrived_ns = arrival_ns
        return arrival_ns

    def backlog_ns(self, now_ns: int) -> int:
        """Returns how long what is queued now will take to leave."""
        return 0 if self._free_ns is None else max(0, self._free_ns - now_ns)
