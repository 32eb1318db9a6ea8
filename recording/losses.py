"""Losses of a recording: messages that processes dropped, and gaps while a bus was down."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import islice

from protocol.bus import Bus
from protocol.errors import MessageError
from protocol.topics import BusName
from recording.limits import MAX_PROCESSES, MAX_REASONS
from recording.tables import DropRow, GapRow


@dataclass(slots=True)
class RestartSafeCounts:
    """Counts by reason, published since a process's start, summed over its restarts.

    `told` are the last published counts.
    """

    total: Counter[str] = field(default_factory=Counter)
    reported: dict[str, int] = field(default_factory=dict)

    def take(self, reported: Mapping[str, int]) -> None:
        """Adds the increase; if one count has fallen, all are those of a restarted process."""
        if any(reported.get(reason, 0) < count for reason, count in self.reported.items()):
            self.reported = {}
        for reason, count in reported.items():
            self.total[reason] += count - self.reported.get(reason, 0)
        self.reported = dict(reported)


class DropCounts:
    """Drop counts by process, summed over restarts: a count that falls indicates one."""

    def __init__(self, known: Iterable[DropRow] = ()) -> None:
        self._counts: dict[str, RestartSafeCounts] = {}
        self._changed: set[str] = set()
        for row in known:
            counts = self._counts.setdefault(row.process, RestartSafeCounts())
            counts.total[row.reason] = counts.reported[row.reason] = row.times

    def received(self, process: str, reasons: Mapping[str, int]) -> None:
        """Adds a process's counts since its start; reasons beyond the limit are ignored.

        Raises:
            MessageError: it is one process too many.
        """
        if process not in self._counts and len(self._counts) >= MAX_PROCESSES:
            raise MessageError(f"{process} is one process more than {MAX_PROCESSES}")
        counts = self._counts.setdefault(process, RestartSafeCounts())
        unknown = (reason for reason in reasons if reason not in counts.total)
        fresh = islice(unknown, MAX_REASONS - len(counts.total))
        named = counts.total.keys() | set(fresh)
        reported = {reason: times for reason, times in reasons.items() if reason in named}
        if reported != counts.reported:
            counts.take(reported)
            self._changed.add(process)

    def take_changed(self) -> list[DropRow]:
        """Returns the rows of all processes whose counts changed, once."""
        changed, self._changed = sorted(self._changed), set()
        return [
            DropRow(process, reason, times)
            for process in changed
            for reason, times in sorted(self._counts[process].total.items())
        ]

    def total(self) -> int:
        """Returns the total number of dropped messages."""
        return sum(counts.total.total() for counts in self._counts.values())


class BusGaps:
    """Registers a gap whenever a bus's router was lost or was replaced by another.

    Messages in transit may then have reached some subscribers and not others.
    """

    def __init__(self, name: BusName, bus: Bus) -> None:
        self._name = name
        self._bus = bus
        self._router = bus.router()
        self._changed_ns = 0
        self._since: int | None = None

    def look(self, last_whole: int, now_ns: int) -> None:
        """Checks the bus's router, before messages are taken; `last_whole`: last complete frame."""
        router = self._bus.router()
        if router == self._router:
            return
        if self._since is None:
            self._since = last_whole
        self._router, self._changed_ns = router, now_ns

    def received(self, bus: BusName, frame: int, received_ns: int) -> GapRow | None:
        """Returns the gap that ends with a message of this frame, if one does.

        Messages received before the change was noticed may have come through the old router.
        """
        is_through = bus is self._name and self._router and received_ns > self._changed_ns
        if self._since is None or not is_through:
            return None
        since, self._since = self._since, None
        return GapRow(since, self._name.value, frame)


class RestartGaps:
    """The gap of a recorder that restarted: it ends when messages arrive again on both buses.

    They must be of the topic that was subscribed to last on its bus: then all others arrive too.
    """

    def __init__(self, last_whole: int) -> None:
        self._last_whole = last_whole
        self._first: dict[BusName, int] = {}

    def received(self, bus: BusName, frame: int) -> GapRow | None:
        """Returns the gap as it is known now, if this message changes it."""
        if bus in self._first:
            return None
        self._first[bus] = frame
        return GapRow(self._last_whole, "recorder", max(self._first.values()))
