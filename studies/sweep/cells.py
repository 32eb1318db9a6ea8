"""Cells of a study: one scenario with one seed each, and their results on disk."""

from __future__ import annotations

import hashlib
import json
import math
import os
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from protocol.config import is_file
from protocol.errors import ConfigError
from studies.sweep.study_file import LISTS, MEASURES, Grid, Label, Point, Settings, Study, points

if TYPE_CHECKING:  # a study's file is checked without loading all roles
    from studies.sweep.worker import Outcome, Row, Rows


SCHEMA = 3
"""Version, to be raised when `worker.measure` gives other figures for the same run."""
_DECIDING = (
    *("protocol", "sensing", "vehicle_agent", "infra_agent", "sim_host", "link_relay"),
    *("perception", "edge_server", "signal_controller", "recording", "learning"),
)
PartKind: TypeAlias = Literal["junctions", "regions"]
Scenario = dict[str, Any]
Resolve = Callable[[Settings], Scenario]
"""Lays dotted keys over the study's scenario; every key of the result has its value."""


@dataclass(frozen=True, slots=True)
class Cell:
    """One row of the study's table. Cells with equal ids are one run."""

    grid: str
    labels: dict[str, Label]
    seed: int
    scenario: Scenario
    id: str

    @property
    def title(self) -> str:
        """The cell's name for display."""
        shown = [f"{name}={label}" for name, label in self.labels.items()]
        return " ".join([self.grid, *shown, f"seed={self.seed}"])


def cells_of(study: Study, resolve: Resolve) -> list[Cell]:
    """Returns all cells in the order of the file: grids, axes, seeds.

    Raises:
        ConfigError: a cell's scenario is invalid; names the cell.
    """
    return [cell for grid in study.grids for cell in _of_grid(study, grid, resolve)]


def _of_grid(study: Study, grid: Grid, resolve: Resolve) -> Iterator[Cell]:
    for point in points(grid.axes):
        for seed in study.seeds:
            settings = study.settings | grid.settings | point.settings | {"seed": seed}
            try:
                scenario = resolve(settings)
            except ConfigError as error:
                raise ConfigError(f"grid {grid.name}, {point.labels}: {error}") from None
            if scenario["mode"] != "lockstep":
                raise ConfigError(
                    f"grid {grid.name}: mode is {scenario['mode']}, a study's must be lockstep"
                )
            _check_network(grid, point, scenario)
            yield Cell(grid.name, point.labels, seed, scenario, identify(scenario))


def _check_network(grid: Grid, point: Point, scenario: Scenario) -> None:
    """Raises ConfigError if a net hides an axis of built-in networks: its cells are equal."""
    given = [key for key in ("net", "sumocfg") if scenario.get("traffic", {}).get(key)]
    if given and "traffic.network" in point.settings:
        raise ConfigError(
            f"grid {grid.name}, {point.labels}: traffic.network has no effect, as "
            f"traffic.{given[0]} is set"
        )


def identify(scenario: Scenario) -> str:
    """Returns a cell's id: of its scenario, of the files this names, of the code that runs it."""
    decides = {
        "scenario": scenario,
        "files": {name: _digest(Path(name)) for name in sorted(set(_files(scenario)))},
        "code": _own_code(),
        "schema": SCHEMA,
    }
    return hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()[:16]


def code_digest(root: Path, packages: Sequence[str] = _DECIDING) -> str:
    """Returns a hash of the packages below `root` that decide a run's rows, weights included."""
    found = hashlib.sha256()
    for package in packages:
        for path in sorted(p for p in (root / package).rglob("*") if p.is_file()):
            if "__pycache__" not in path.parts:
                found.update(f"{path.relative_to(root)} {_digest(path)}\n".encode())
    return found.hexdigest()


@cache
def _own_code() -> str:
    return code_digest(Path(__file__).resolve().parents[2])


def _files(value: object) -> Iterator[str]:
    """Yields every text of a scenario that is a file's name."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        for item in value:
            yield from _files(item)
    elif isinstance(value, str) and is_file(value):
        yield value


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@dataclass(frozen=True, slots=True)
class ResultStore:
    """The folder of a study's results; several studies may share one."""

    folder: Path

    @staticmethod
    def at(folder: Path) -> ResultStore:
        """Makes the folder where there is none.

        Raises:
            ConfigError: it cannot be made.
        """
        try:
            (folder / "cells").mkdir(parents=True, exist_ok=True)
        except (OSError, ValueError) as error:
            raise ConfigError(f"--out {folder}: {error}") from None
        return ResultStore(folder)

    def row(self, cell_id: str) -> Row | None:
        """Returns the figures of a finished cell; None if it has to be run."""
        found = self._read(cell_id)
        row: Row | None = found and found["row"]
        return row

    def parts(self, cell_id: str, kind: PartKind) -> Rows | None:
        """Returns the figures of a finished cell by junction or region; None if it is to be run."""
        found = self._read(cell_id)
        rows: Rows | None = found and found[kind]
        return rows

    def _read(self, cell_id: str) -> dict[str, Any] | None:
        try:
            data: Any = json.loads(self._path(cell_id).read_text("utf-8"))
        except (OSError, ValueError):
            return None
        if not isinstance(data, dict) or data.get("id") != cell_id:
            return None
        rows = [data.get("row")]
        for parts in (data.get("junctions"), data.get("regions")):
            if not isinstance(parts, dict):
                return None
            rows += parts.values()
        return data if all(map(_is_row, rows)) else None

    def save(self, cell: Cell, outcome: Outcome) -> None:
        """Writes a finished cell; from then on it is never run again."""
        data = {
            "id": cell.id,
            "title": cell.title,
            "took_s": round(outcome.took_s, 3),
            "row": outcome.row,
            "junctions": outcome.junctions,
            "regions": outcome.regions,
            "scenario": cell.scenario,
        }
        write_atomically(self._path(cell.id), json.dumps(data, indent=1).encode())
        self._traceback(cell.id).unlink(missing_ok=True)

    def record_failure(self, cell: Cell, error: BaseException) -> None:
        """Writes the traceback of a failed cell; the cell is tried again next time."""
        text = "".join(traceback.format_exception(error))
        write_atomically(self._traceback(cell.id), f"{cell.title}\n{text}".encode())

    def run_dir(self, cell_id: str) -> Path:
        """The folder of a cell's run, if runs are kept."""
        return (self.folder / "runs" / cell_id).absolute()

    def _traceback(self, cell_id: str) -> Path:
        return self.folder / "cells" / f"{cell_id}.failed.txt"

    def _path(self, cell_id: str) -> Path:
        return self.folder / "cells" / f"{cell_id}.json"


def _is_row(row: object) -> bool:
    """Whether figures have the keys of `worker.measure`; others are measured again."""
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


def write_atomically(path: Path, data: bytes) -> None:
    """Writes a file whole or not at all, also if the machine stops."""
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with partial.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {error}") from None
