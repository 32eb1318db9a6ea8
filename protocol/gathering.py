"""What came for who is in no hurry: it waits with the transport, and is fetched all at once.

To hand over each message as it comes wakes two threads for it. A frame is made of so many messages
that this is a third of what it takes to hear them all.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from datetime import datetime
from typing import Any, Protocol

from protocol.inbox import Presence, Sealed

CAPACITY = 4096  # of a topic; what is beyond waits before this process, or is dropped there
_AT_ONCE = 512  # of a topic


Read = Callable[[Any, int], Sealed | Presence | None]
"""Reads a sample that arrived then, on our clock; None if it cannot."""


class Stamp(Protocol):
    """A time by the clock of a router."""

    def get_time(self) -> datetime:
        """Returns it, with its zone."""


class Sample(Protocol):
    """What a transport hands over, with when a router took it, if one did."""

    timestamp: Stamp | None


class Channel(Protocol):
    """Where the samples of one subscription wait, as in Zenoh's own."""

    def try_recv(self) -> Sample | None:
        """Returns the next one, None if nothing waits."""


class Gathering:
    """The subscriptions of one bus."""

    def __init__(self) -> None:
        self._sources: list[tuple[Channel, Read]] = []
        self._fetched_ns = time.monotonic_ns()

    def add(self, channel: Channel, read: Read) -> None:
        """Adds a subscription."""
        self._sources.append((channel, read))

    def fetch(self) -> Iterator[tuple[int, Sealed | Presence]]:
        """Yields what waits, one subscription after the other, and when it arrived.

        That is what the router says, if its clock can be right: after the last time that all was
        fetched, and before now.
        """
        since_ns, self._fetched_ns = self._fetched_ns, time.monotonic_ns()
        ahead_ns = time.time_ns() - self._fetched_ns  # noqa: TID251 - the stamps are of that clock
        for channel, read in self._sources:
            for _ in range(_AT_ONCE):
                if (sample := channel.try_recv()) is None:
                    break
                now_ns = time.monotonic_ns()
                stamped_ns = _unix_ns(sample.timestamp, now_ns + ahead_ns)
                arrived_ns = min(max(stamped_ns - ahead_ns, since_ns), now_ns)
                if (item := read(sample, arrived_ns)) is not None:
                    yield arrived_ns, item


def _unix_ns(stamp: Stamp | None, now_ns: int) -> int:
    """Returns when a router took a sample, by its clock, or now if it does not say."""
    return now_ns if stamp is None else round(stamp.get_time().timestamp() * 1e9)
