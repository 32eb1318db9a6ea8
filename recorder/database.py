"""The writing side of a run's database: rows gather in memory and are committed in batches.

SQLite keeps committed transactions through SIGKILL (write-ahead log), so a killed run loses what
came after its last commit and nothing else.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from protocol.errors import ConfigError
from recorder.tables import SCHEMA_VERSION, TABLES, MetaRow

FILE_NAME = "run.sqlite"
Row = tuple[Any, ...]
_ROW_FAULTS = (OverflowError, sqlite3.IntegrityError, sqlite3.DataError, sqlite3.InterfaceError)


class Database:
    """The open database of a run that is being recorded."""

    def __init__(self, run_dir: Path) -> None:
        """Makes the file and its tables.

        Raises:
            ConfigError: the folder is missing, cannot be written or has a recording already.
        """
        self.path = run_dir / FILE_NAME
        if self.path.exists():
            raise ConfigError(f"{self.path} exists; a run is recorded into a folder of its own")
        try:
            self._connection = sqlite3.connect(self.path, isolation_level=None)
            self._connection.execute("PRAGMA journal_mode = WAL")
            self._connection.execute("PRAGMA synchronous = NORMAL")
        except sqlite3.OperationalError as error:
            raise ConfigError(f"{self.path} cannot be written: {error}") from None
        self._pending: dict[type, list[Row]] = {row: [] for row in TABLES}
        self.pending_rows = 0
        self.refused_rows = 0
        self._create()

    def add(self, row: type, rows: Iterable[Row]) -> None:
        """Takes rows of one type; they are written at the next commit."""
        pending = self._pending[row]
        before = len(pending)
        pending.extend(rows)
        self.pending_rows += len(pending) - before

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
        self.pending_rows = 0

    def close(self) -> None:
        """Commits and leaves one plain file, which opens read-only on any medium."""
        self.commit()
        self._connection.execute("PRAGMA journal_mode = DELETE")
        self._connection.close()

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
