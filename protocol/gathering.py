"""What came for who is in no hurry: it waits with the transport, and is fetched all at once.

To hand over each message as it comes wakes two threads for it. A frame is made of so many messages
that this is a third of what it takes to hear them all.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from datetime import datetime
from operator import itemgetter
from typing import Any, Protocol

from protocol.inbox import Presence, RawMessage

CAPACITY = 4096  # of a topic; what is beyond waits before this process, or is dropped there
_AT_ONCE = 512  # of a topic


Read = Callable[[Any, int], RawMessage | Presence | None]
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

    def fetch(self, now_ns: int) -> list[tuple[int, RawMessage | Presence]]:
        """Returns what waits in the order in which the router took it, and when it arrived.

        That is when the router says, if its clock can be right: since the last time and before now.
        Where it is not right the order still is that of its stamps.
        """
        since_ns, self._fetched_ns = self._fetched_ns, now_ns
        found = sorted(self._waiting(), key=itemgetter(0))
        newest_ns = max((taken_ns for taken_ns, *_ in found), default=0)
        ahead_ns = max(newest_ns - time.monotonic_ns(), 0)
        came = []
        for taken_ns, sample, read in found:
            arrived_ns = max(taken_ns - ahead_ns, since_ns)
            if (item := read(sample, arrived_ns)) is not None:
                came.append((arrived_ns, item))
        return came

    def _waiting(self) -> Iterator[tuple[int, Sample, Read]]:
        """Yields each sample, when a router took it as far as its clock is ours, and its reader."""
        ours_ns = time.time_ns() - time.monotonic_ns()  # noqa: TID251 - stamps are of that clock
        for channel, read in self._sources:
            for _ in range(_AT_ONCE):
                if (sample := channel.try_recv()) is None:
                    break
                stamp = sample.timestamp
                yield (
                    time.monotonic_ns() if stamp is None else _unix_ns(stamp) - ours_ns,
                    sample,
                    read,
                )


def _unix_ns(stamp: Stamp) -> int:
    return round(stamp.get_time().timestamp() * 1e9)
