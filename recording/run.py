"""Reads run folders, read-only, of runs that ended, were killed or are running; compares two."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import zip_longest
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

from protocol.config import is_file
from protocol.errors import ConfigError, ProtocolError
from protocol.messages import Setup
from protocol.wire import decode
from recording.database import FILE_NAME
from recording.tables import ADDED, SCHEMA_VERSION, TABLES, MetaRow, Table

SETUP_NAME = "setup.msgpack"
R = TypeVar("R", bound=tuple[Any, ...])


class Run:
    """A recorded run; use it as a context manager.

    `lacking` are the columns, by table, that a run of an older schema version does not have: they
    are read as NULL.
    """

    def __init__(self, run_dir: Path) -> None:
        """Opens the database.

        Raises:
            ConfigError: there is no run, or it was written by another version.
        """
        self.dir = run_dir
        path = run_dir / FILE_NAME
        if not is_file(path):
            page = run_dir / "report.html"
            other = f"; its page is {page}" if is_file(page) else ""
            raise ConfigError(f"{run_dir} is not a run: it has no {FILE_NAME}{other}")
        self._path = path
        self._connection = _connect(path)
        self.lacking: dict[str, tuple[str, ...]] = {}
        self._check_version()

    def __enter__(self) -> Run:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Closes the database."""
        self._connection.close()

    def rows(self, row: type[R]) -> Iterator[R]:
        """Yields all rows of a table, in the order of their keys.

        Raises:
            ConfigError: the database is damaged.
        """
        table = TABLES[row]
        with self._named_faults():
            yield from map(table.row._make, self._connection.execute(table.select))

    def query(self, sql: str, *parameters: object) -> list[tuple[Any, ...]]:
        """Returns the rows of a SELECT; see `recording.tables` for the columns.

        Raises:
            ConfigError: the database is damaged.
        """
        with self._named_faults():
            return self._connection.execute(sql, parameters).fetchall()

    def of_frame(self, row: type[R], frame: int) -> list[R]:
        """Returns a table's rows of one frame, in the order of their keys."""
        table = TABLES[row]
        order = ", ".join(table.columns[: table.keys]) or "rowid"
        sql = f"SELECT * FROM {table.name} WHERE frame = ? ORDER BY {order}"
        return list(map(table.row._make, self.query(sql, frame)))

    @cached_property
    def meta(self) -> dict[str, str]:
        """Facts about the run: schema_version, scenario, version, started, end_reason …."""
        return dict(self.rows(MetaRow))

    @cached_property
    def scenario(self) -> dict[str, Any]:
        """The resolved scenario.

        Raises:
            ConfigError: the recorded one is no JSON object.
        """
        text = self.meta.get("scenario", "{}")
        try:
            result = json.loads(text)
        except (TypeError, ValueError, RecursionError):
            result = None
        if not isinstance(result, dict):
            raise ConfigError(f"{self._path}: scenario in meta is no JSON object: {text!r:.80}")
        return result

    @cached_property
    def setup(self) -> Setup:
        """The run's setup message: the road, vehicle types, meshes.

        Raises:
            ConfigError: the folder lacks it or it is damaged.
        """
        path = self.dir / SETUP_NAME
        try:
            return decode(path.read_bytes(), Setup)
        except FileNotFoundError:
            raise ConfigError(f"{self.dir} is not a whole run: it has no {SETUP_NAME}") from None
        except ProtocolError as error:
            raise ConfigError(f"{path} cannot be read: {error}") from None

    @contextmanager
    def _named_faults(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.DatabaseError as error:
            raise ConfigError(
                f"{self._path} is not a run's database: {error}{_advice(str(error))}"
            ) from None

    def _check_version(self) -> None:
        try:
            found = self.meta.get("schema_version")
        except ConfigError:
            self.close()
            raise
        readable = range(min(ADDED) - 1, SCHEMA_VERSION + 1)
        if found is None or found not in map(str, readable):
            self.close()
            raise ConfigError(
                f"{self._path} has schema version {found}, this side reads {readable[0]} to "
                f"{readable[-1]}"
            )
        self._add_columns(int(found))

    def _add_columns(self, version: int) -> None:
        """Lets queries read as NULL what the tables of an older schema version lack."""
        for added in (ADDED[later] for later in sorted(ADDED) if later > version):
            for table, columns in added.items():
                self.lacking[table] = self.lacking.get(table, ()) + columns
        for table, lacking in self.lacking.items():
            nulls = ", ".join(f"NULL AS {column}" for column in lacking)
            self._connection.execute(
                f"CREATE TEMP VIEW {table} AS SELECT *, {nulls} FROM main.{table}"
            )


def _advice(error: str) -> str:
    """Returns advice on where rows may be that a database lacks."""
    if not error.startswith("no such table"):
        return ""
    wal = f"{FILE_NAME}-wal"
    return f"; if it was copied: its last rows may be in {wal}, which must stand beside it"


def _connect(path: Path) -> sqlite3.Connection:
    uri = path.resolve().as_uri()
    connection = sqlite3.connect(f"{uri}?mode=ro", uri=True)
    try:
        connection.execute("SELECT 1 FROM sqlite_master")
    except sqlite3.OperationalError:  # a write-ahead log without its index, on a read-only medium
        connection.close()
        connection = sqlite3.connect(f"{uri}?immutable=1", uri=True)
    except sqlite3.DatabaseError:
        pass  # not a database: the caller raises
    return connection


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

    Columns that one of them lacks, see `Run`, are not compared.

    Raises:
        ConfigError: one of the folders is no run.
    """
    with Run(run_a) as a, Run(run_b) as b:
        found = [_difference(table, a, b) for table in RESULTS]
    return [difference for difference in found if difference.differing]


def _difference(table: Table, a: Run, b: Run) -> Difference:
    count_a = count_b = differing = 0
    first = ""
    lacking = max(len(run.lacking.get(table.name, ())) for run in (a, b))
    width = len(table.columns) - lacking
    rows = ((row[:width] for row in run.rows(table.row)) for run in (a, b))
    for row_a, row_b in _pairs(table, *rows):
        count_a += row_a is not None
        count_b += row_b is not None
        if row_a != row_b:
            first = first or _description(table, row_a, row_b)
            differing += 1
    return Difference(table.name, count_a, count_b, differing, first)


def _pairs(table: Table, a: Iterator[_Row], b: Iterator[_Row]) -> Iterator[_Pair]:
    """Yields rows with the same keys together, None where a run has no such row."""
    if not table.keys:  # these are identified by their position alone
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
    """Returns the sort key of a row; that of None is beyond all others."""
    return (True,) if row is None else (False, *row[: table.keys])


def _description(table: Table, row_a: _Row | None, row_b: _Row | None) -> str:
    """Describes a differing row: its keys, and the columns that differ."""
    named = zip(table.columns[: table.keys], row_a or row_b or (), strict=False)
    place = " ".join(f"{name} {value}" for name, value in named)
    if row_a is None or row_b is None:
        return f"{place}: only in the {'first' if row_b is None else 'second'} run"
    both = zip(table.columns, row_a, row_b, strict=False)  # without what one run lacks
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
