"""Whether two runs had the same results, row for row: clocks and measured bytes do not count."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import Any

from recording.run import Run
from recording.tables import TABLES, Table

_Row = tuple[object, ...]
RESULTS = tuple(table for table in TABLES.values() if table.is_result)


_Pair = tuple[_Row | None, _Row | None]
_MAX_VALUE_CHARS = 60  # characters of a value
_COMMON_CHARS = 20  # of them that are the same


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
    for row_a, row_b in _pairs(table, a.rows(table.row), b.rows(table.row)):
        count_a += row_a is not None
        count_b += row_b is not None
        if row_a != row_b:
            first = first or _description(table, row_a, row_b)
            differing += 1
    return Difference(table.name, count_a, count_b, differing, first)


def _pairs(table: Table, a: Iterator[_Row], b: Iterator[_Row]) -> Iterator[_Pair]:
    """Yields rows with the same keys together, None where a run has no such row."""
    if not table.keys:  # these are told apart by their place alone
        yield from zip_longest(a, b)
        return
    row_a, row_b = next(a, None), next(b, None)
    while row_a is not None or row_b is not None:
        key_a, key_b = _key(table, row_a), _key(table, row_b)
        is_a, is_b = key_a <= key_b, key_b <= key_a
        yield (row_a if is_a else None), (row_b if is_b else None)
        row_a = next(a, None) if is_a else row_a
        row_b = next(b, None) if is_b else row_b


def _key(table: Table, row: _Row | None) -> tuple[Any, ...]:
    """Returns what a row is sorted by; that of none is beyond all others."""
    return (True,) if row is None else (False, *row[: table.keys])


def _description(table: Table, row_a: _Row | None, row_b: _Row | None) -> str:
    """Returns which row it is, by its keys, and what differs in it."""
    named = zip(table.columns[: table.keys], row_a or row_b or (), strict=False)
    place = " ".join(f"{name} {value}" for name, value in named)
    if row_a is None or row_b is None:
        return f"{place}: only in the {'first' if row_b is None else 'second'} run"
    both = zip(table.columns, row_a, row_b, strict=True)
    apart = ", ".join(f"{name} {_value_pair(x, y)}" for name, x, y in both if x != y)
    return f"{place}: {apart}"


def _value_pair(x: object, y: object) -> str:
    """Returns two values, of long ones the part in which they begin to differ."""
    texts = [str(x), str(y)]
    apart = (n for n, (p, q) in enumerate(zip(*texts, strict=False)) if p != q)
    begin = max(next(apart, min(map(len, texts))) - _COMMON_CHARS, 0)
    return " against ".join(map(partial(_part, begin=begin), texts))


def _part(text: str, begin: int) -> str:
    end = begin + _MAX_VALUE_CHARS
    return ("…" if begin else "") + text[begin:end] + ("…" if end < len(text) else "")
