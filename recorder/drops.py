"""What all processes dropped, by reason: each counts since its own start, and may start again."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import islice

from protocol.errors import MessageError
from protocol.rising import Rising
from recorder.tables import DropRow

MAX_PROCESSES = 512
MAX_REASONS = 64  # for which a process drops messages


class Drops:
    """Adds up over restarts: a count that falls tells of one."""

    def __init__(self, known: Iterable[DropRow] = ()) -> None:
        self._counts: dict[str, Rising] = {}
        self._changed: set[str] = set()
        for row in known:
            counts = self._counts.setdefault(row.process, Rising())
            counts.total[row.reason] = counts.told[row.reason] = row.times

    def heard(self, process: str, reasons: Mapping[str, int]) -> None:
        """Takes what a process has counted since its start; of too many reasons the first.

        Raises:
            MessageError: it is one process too many.
        """
        if process not in self._counts and len(self._counts) >= MAX_PROCESSES:
            raise MessageError(f"{process} is one process more than {MAX_PROCESSES}")
        counts = self._counts.setdefault(process, Rising())
        unknown = (reason for reason in reasons if reason not in counts.total)
        fresh = islice(unknown, MAX_REASONS - len(counts.total))
        named = counts.total.keys() | set(fresh)
        told = {reason: times for reason, times in reasons.items() if reason in named}
        if told != counts.told:
            counts.take(told)
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
