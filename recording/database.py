"""Writes a run's database; rows are buffered and committed in batches.

SQLite keeps committed transactions through SIGKILL (write-ahead log), so a killed run loses only
what came after its last commit.
"""

from __future__ import annotations

import platform
import sqlite3
from collections.abc import Iterable
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from protocol.errors import ConfigError
from protocol.plugins import packages
from recording.limits import MAX_PENDING_BYTES, MAX_PENDING_ROWS
from recording.tables import SCHEMA_VERSION, TABLES, CloudRow, DropRow, MetaRow

FILE_NAME = "run.sqlite"
PAGE_BYTES = 8192  # a row with more than a quarter of a page, as of sightings, takes pages alone
Row = tuple[Any, ...]
_ROW_FAULTS = (OverflowError, sqlite3.IntegrityError, sqlite3.DataError, sqlite3.InterfaceError)


class Database:
    """The open database of a run that is being recorded.

    After a restart, `last_frame` is the last frame of the earlier recorder, `last_whole` the last
    with a request, `last_tick` frame and ns of simulation of the last tick; None if this is the
    first recorder.
    """

    def __init__(self, run_dir: Path, scenario: str = "") -> None:
        """Makes the file and its tables, or resumes a recording that was interrupted.

        Args:
            run_dir: the run's folder.
            scenario: as JSON; only a recording of the same is resumed.

        Raises:
            ConfigError: the folder is missing, cannot be written or has another recording already.
        """
        self.path = run_dir / FILE_NAME
        is_there = self.path.exists()
        try:
            self._connection = sqlite3.connect(self.path, isolation_level=None)
            self._connection.execute(f"PRAGMA page_size = {PAGE_BYTES}")
            self._connection.execute("PRAGMA journal_mode = WAL")
            self._connection.execute("PRAGMA synchronous = NORMAL")
            self.last_frame = self._resume(scenario) if is_there else None
            self.last_whole = self._newest("requests") if is_there else None
            self.last_tick = self._last_tick() if is_there else None
        except sqlite3.Error as error:
            raise ConfigError(f"{self.path} cannot be written: {error}") from None
        self._pending: dict[type, list[Row]] = {row: [] for row in TABLES}
        self.pending_rows = 0
        self._pending_bytes = 0
        self.refused_rows = 0
        if not is_there:
            self._create()

    def known_drops(self) -> list[DropRow]:
        """Returns the drop counts of the earlier recorder."""
        return list(map(DropRow._make, self._connection.execute(TABLES[DropRow].select)))

    def add(self, row: type, rows: Iterable[Row]) -> None:
        """Takes rows of one type; they are written at the next commit."""
        pending = self._pending[row]
        before = len(pending)
        pending.extend(rows)
        self.pending_rows += len(pending) - before
        if row is CloudRow:
            self._pending_bytes += sum(len(cloud[-1]) for cloud in pending[before:])

    @property
    def is_full(self) -> bool:
        """Whether so many rows are buffered that they should be committed, to bound memory."""
        return self.pending_rows > MAX_PENDING_ROWS or self._pending_bytes > MAX_PENDING_BYTES

    def commit(self) -> None:
        """Writes all that was added, in one transaction.

        Raises:
            sqlite3.OperationalError: the disk is full or gone.
        """
        if not self.pending_rows:
            return
        self._connection.execute("BEGIN")
        for row, rows in self._pending.items():
            if rows:
                self._write(TABLES[row].insert, rows)
                rows.clear()
        self._connection.execute("COMMIT")
        self.pending_rows = self._pending_bytes = 0

    def close(self) -> None:
        """Commits and leaves one plain file, which opens read-only on any medium.

        While another process reads, the write-ahead log stays beside it.
        """
        self.commit()
        with suppress(sqlite3.OperationalError):
            self._connection.execute("PRAGMA journal_mode = DELETE")
        self._connection.close()

    def _resume(self, scenario: str) -> int:
        """Returns the last frame of a recording of this scenario that has not ended."""
        meta = dict(self._connection.execute(TABLES[MetaRow].select))
        expected = {"schema_version": str(SCHEMA_VERSION), "scenario": scenario}
        if "end_reason" in meta or any(meta.get(key) != v for key, v in expected.items()):
            raise ConfigError(
                f"{self.path} exists; a run is recorded into a folder of its own, and only one of "
                "the same scenario that broke off is gone on with"
            )
        return self._newest("frames")

    def _newest(self, table: str) -> int:
        ((newest,),) = self._connection.execute(f"SELECT max(frame) FROM {table}").fetchall()
        return -1 if newest is None else int(newest)

    def _last_tick(self) -> tuple[int, int] | None:
        sql = (
            "SELECT frame, sim_time_ns FROM frames WHERE sim_time_ns NOT NULL "
            "ORDER BY frame DESC LIMIT 1"
        )
        found: tuple[int, int] | None = self._connection.execute(sql).fetchone()
        return found

    def _create(self) -> None:
        self._connection.execute("BEGIN")
        for table in TABLES.values():
            self._connection.execute(table.create)
        self._connection.execute("COMMIT")
        self.add(MetaRow, [MetaRow("schema_version", str(SCHEMA_VERSION))])
        self.commit()

    def _write(self, statement: str, rows: list[Row]) -> None:
        try:
            self._connection.executemany(statement, rows)
        except _ROW_FAULTS:  # an integer beyond 64 bit, or NaN: find the row and leave it out
            for row in rows:
                try:
                    self._connection.execute(statement, row)
                except _ROW_FAULTS:
                    self.refused_rows += 1


PACKAGES = ("cpnet-edge", "eclipse-sumo", "eclipse-zenoh", "numpy", "numba", "embreex")


def versions() -> dict[str, str]:
    """Returns the versions of Python and of the packages that results depend on.

    Of the recording process, that is; a package that its machine lacks is left out, and those
    that bring plug-ins are among them, in use or not.
    """
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:  # another machine has it, or it runs from a checkout
            continue
    return found | packages()
