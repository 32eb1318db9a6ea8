"""Finished cells on disk: a file each, written whole or not at all."""

from __future__ import annotations

import json
import math
import os
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from protocol.errors import ConfigError
from studies.columns import LISTS, MEASURES
from studies.sweep.cell import Cell

if TYPE_CHECKING:  # a study's file is read and refused without loading all roles
    from studies.measures import Row
    from studies.sweep.work import Outcome


@dataclass(frozen=True, slots=True)
class Store:
    """The folder of a study's results; several studies may share one."""

    folder: Path

    @staticmethod
    def at(folder: Path) -> Store:
        """Makes the folder where there is none.

        Raises:
            ConfigError: it cannot be made.
        """
        try:
            (folder / "cells").mkdir(parents=True, exist_ok=True)
        except (OSError, ValueError) as error:
            raise ConfigError(f"--out {folder}: {error}") from None
        return Store(folder)

    def row(self, cell_id: str) -> Row | None:
        """Returns the figures of a finished cell; None if it has to be run."""
        try:
            data: Any = json.loads(self._path(cell_id).read_text("utf-8"))
        except (OSError, ValueError):
            return None
        if not isinstance(data, dict) or data.get("id") != cell_id:
            return None
        row: Any = data.get("row")
        return row if _is_row(row) else None

    def keep(self, cell: Cell, outcome: Outcome) -> None:
        """Writes a finished cell; from then on it is never run again."""
        data = {
            "id": cell.id,
            "title": cell.title,
            "took_s": round(outcome.took_s, 3),
            "row": outcome.row,
            "scenario": cell.scenario,
        }
        write_whole(self._path(cell.id), json.dumps(data, indent=1).encode())

        self._traceback(cell.id).unlink(missing_ok=True)

    def blame(self, cell: Cell, error: BaseException) -> None:
        """Writes how a cell failed, for who wants to know where; it is tried again next time."""
        text = "".join(traceback.format_exception(error))
        write_whole(self._traceback(cell.id), f"{cell.title}\n{text}".encode())

    def run_dir(self, cell_id: str) -> Path:
        """Where a cell's run is kept, if runs are."""
        return (self.folder / "runs" / cell_id).absolute()

    def _traceback(self, cell_id: str) -> Path:
        return self.folder / "cells" / f"{cell_id}.failed.txt"

    def _path(self, cell_id: str) -> Path:
        return self.folder / "cells" / f"{cell_id}.json"


def _is_row(row: object) -> bool:
    """Whether figures are what `studies.measures` gives; others are measured anew."""
    if not isinstance(row, dict) or not row:
        return False
    return all(_is_figure(name, value) for name, value in row.items())


def _is_figure(name: str, value: object) -> bool:
    if isinstance(value, list):
        return all(type(one) is int for one in value) and name not in MEASURES - LISTS
    if isinstance(value, float) and not math.isfinite(value):
        return False
    kinds = (int, float) if name in MEASURES else (int, float, str)
    return name not in LISTS and (value is None or type(value) in kinds)


def write_whole(path: Path, data: bytes) -> None:
    """Writes a file so that nobody ever sees a part of it, also if the machine stops."""
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with partial.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {error}") from None
