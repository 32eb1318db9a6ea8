"""Reads a run folder, read-only, whether the run ended, was killed or still goes on."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

from protocol.config import is_file
from protocol.errors import ConfigError, ProtocolError
from protocol.messages import Setup
from protocol.wire import decode
from recording.database import FILE_NAME
from recording.tables import SCHEMA_VERSION, TABLES, MetaRow

SETUP_NAME = "setup.msgpack"
R = TypeVar("R", bound=tuple[Any, ...])


class Run:
    """A recorded run; use it as a context manager."""

    def __init__(self, run_dir: Path) -> None:
        """Opens the database.

        Raises:
            ConfigError: there is no run, or it was written by another version.
        """
        self.dir = run_dir
        path = run_dir / FILE_NAME
        if not is_file(path):
            raise ConfigError(f"{run_dir} is not a run: it has no {FILE_NAME}")
        self._path = path
        self._connection = _connect(path)
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
        """Lets the database go."""
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
        """Returns what a SELECT gives; see `recording.tables` for the columns.

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
            ConfigError: what was recorded of it is no JSON object.
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
        """What every process was given: the road, vehicle types, meshes.

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
            raise ConfigError(f"{self._path} is not a run's database: {error}") from None

    def _check_version(self) -> None:
        try:
            found = self.meta.get("schema_version")
        except ConfigError:
            self.close()
            raise
        if found != str(SCHEMA_VERSION):
            self.close()
            raise ConfigError(
                f"{self._path} has schema version {found}, this side reads {SCHEMA_VERSION}"
            )


def _connect(path: Path) -> sqlite3.Connection:
    uri = path.resolve().as_uri()
    connection = sqlite3.connect(f"{uri}?mode=ro", uri=True)
    try:
        connection.execute("SELECT 1 FROM sqlite_master")
    except sqlite3.OperationalError:  # a write-ahead log without its index, on a read-only medium
        connection.close()
        connection = sqlite3.connect(f"{uri}?immutable=1", uri=True)
    except sqlite3.DatabaseError:
        pass  # not a database: the caller finds out and says so
    return connection
