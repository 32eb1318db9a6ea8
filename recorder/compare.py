"""Whether two runs had the same results, row for row: clocks and measured bytes do not count."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

from recorder.run import Run
from recorder.tables import TABLES, Table

_Row = tuple[object, ...]
RESULTS = tuple(table for table in TABLES.values() if table.is_result)


_MOST_TOLD = 60  # characters of a value


@dataclass(frozen=True, slots=True)
class Difference:
    """One table in which two runs differ, and where the first pair of rows does."""

    table: str
    rows_a: int
    rows_b: int
    differing: int
    first: str

    def __str__(self) -> str:
        return (
            f"{self.table}: {self.differing} rows differ ({self.rows_a} against {self.rows_b}); "
            f"first {self.first}"
        )


def differences(run_a: Path, run_b: Path) -> list[Difference]:
    """Returns the result tables in which two runs differ; none if they agree in every row.

    Raises:
        ConfigError: one of the folders is no run.
    """
    with Run(run_a) as a, Run(run_b) as b:
        found = [_difference(table, a, b) for table in RESULTS]
    return [difference for difference in found if difference.differing]


def results_digest(run_dir: Path) -> dict[str, str]:
    """Returns a SHA-256 for each result table; equal digests mean equal rows.

    Raises:
        ConfigError: the folder is no run.
    """
    digests = {}
    with Run(run_dir) as run:
        for table in RESULTS:
            state = hashlib.sha256()
            for row in run.rows(table.row):
                state.update(repr(tuple(row)).encode())
            digests[table.name] = state.hexdigest()
    return digests


def _difference(table: Table, a: Run, b: Run) -> Difference:
    count_a = count_b = differing = 0
    first = ""
    for row_a, row_b in zip_longest(a.rows(table.row), b.rows(table.row)):
        count_a += row_a is not None
        count_b += row_b is not None
        if row_a != row_b:
            first = first or _told(table, row_a, row_b)
            differing += 1
    return Difference(table.name, count_a, count_b, differing, first)


def _told(table: Table, row_a: _Row | None, row_b: _Row | None) -> str:
    """Returns which row it is, by its keys, and what differs in it."""
    if row_a is None or row_b is None:
        keys = table.columns[: table.keys]
        row = row_a or row_b or ()
        named = " ".join(f"{name} {_short(v)}" for name, v in zip(keys, row, strict=False))
        return f"{named}, in one of them alone"
    both = list(zip(table.columns, row_a, row_b, strict=True))
    same = [f"{name} {_short(x)}" for name, x, y in both[: table.keys] if x == y]
    apart = [f"{name} {_short(x)} against {_short(y)}" for name, x, y in both if x != y]
    return ": ".join(filter(None, [" ".join(same), ", ".join(apart)]))


def _short(value: object) -> str:
    told = str(value)
    return told if len(told) <= _MOST_TOLD else f"{told[:_MOST_TOLD]}…"
