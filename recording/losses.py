"""What a recording lacks: messages that processes dropped, and gaps while a bus was away."""

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
    """Counts by reason that their process tells since its own start, kept over its restarts.

    `told` is what it said last.
    """

    total: Counter[str] = field(default_factory=Counter)
    reported: dict[str, int] = field(default_factory=dict)

    def take(self, reported: Mapping[str, int]) -> None:
        """Adds what is new; counts of which one has fallen are those of a new process."""
        if any(reported.get(reason, 0) < count for reason, count in self.reported.items()):
            self.reported = {}
        for reason, count in reported.items():
            self.total[reason] += count - self.reported.get(reason, 0)
        self.reported = dict(reported)


class DropCounts:
    """Adds up over restarts: a count that falls tells of one."""

    def __init__(self, known: Iterable[DropRow] = ()) -> None:
        self._counts: dict[str, RestartSafeCounts] = {}
        self._changed: set[str] = set()
        for row in known:
            counts = self._counts.setdefault(row.process, RestartSafeCounts())
            counts.total[row.reason] = counts.reported[row.reason] = row.times

    def received(self, process: str, reasons: Mapping[str, int]) -> None:
        """Takes what a process has counted since its start; of too many reasons the first.

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
        """Returns the rows of all processes of which something new was heard, once."""
        changed, self._changed = sorted(self._changed), set()
        return [
            DropRow(process, reason, times)
            for process in changed
            for reason, times in sorted(self._counts[process].total.items())
        ]

    def total(self) -> int:
        """Returns how much was dropped in all."""
        return sum(counts.total.total() for counts in self._counts.values())


class BusGaps:
    """Notes a gap whenever a bus's router was lost or was replaced by another.

    What was on its way then may have come to some and not to others.
    """

    def __init__(self, name: BusName, bus: Bus) -> None:
        self._name = name
        self._bus = bus
        self._router = bus.router()
        self._changed_ns = 0
        self._since: int | None = None

    def look(self, last_whole: int, now_ns: int) -> None:
        """Asks the bus, before messages are taken; `last_whole` is the last frame with all."""
        router = self._bus.router()
        if router == self._router:
            return
        if self._since is None:
            self._since = last_whole
        self._router, self._changed_ns = router, now_ns

    def received(self, bus: BusName, frame: int, received_ns: int) -> GapRow | None:
        """Returns the gap that ends with a message of this frame, if one does.

        What came before the change was seen may have come through the router that is gone.
        """
        is_through = bus is self._name and self._router and received_ns > self._changed_ns
        if self._since is None or not is_through:
            return None
        since, self._since = self._since, None
        return GapRow(since, self._name.value, frame)


class RestartGaps:
    """The gap of a recorder that was away: it ends when something came again on both buses.

    What is heard must be of the topic that was asked for last on its bus: then all others are
    heard too.
    """

    def __init__(self, last_whole: int) -> None:
        self._last_whole = last_whole
        self._first: dict[BusName, int] = {}

    def received(self, bus: BusName, frame: int) -> GapRow | None:
        """Returns the gap as it is known now, if this tells more of it."""
        if bus in self._first:
            return None
        self._first[bus] = frame
        return GapRow(self._last_whole, "recorder", max(self._first.values()))
