"""Counts that begin anew with each process, and go on rising for whoever adds them up."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(slots=True)
class Rising:
    """Counts by reason that their process tells since its own start, kept over its restarts.

    `told` is what it said last.
    """

    total: Counter[str] = field(default_factory=Counter)
    told: dict[str, int] = field(default_factory=dict)

    def take(self, told: Mapping[str, int]) -> None:
        """Adds what is new; counts of which one has fallen are those of a new process."""
        if any(told.get(reason, 0) < count for reason, count in self.told.items()):
            self.restart()
        for reason, count in told.items():
            self.total[reason] += count - self.told.get(reason, 0)
        self.told = dict(told)

    def take_highest(self, told: Mapping[str, int]) -> None:
        """Keeps the most that any of several processes told, which is less than their sum."""
        self.total |= Counter(told)

    def restart(self) -> None:
        """Expects counts from 0."""
        self.told = {}
