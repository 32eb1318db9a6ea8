"""A cell: one scenario with one seed, known by what decides its results and by nothing else."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from protocol.errors import ConfigError
from protocol.files import is_file
from studies.sweep.axes import Label, Settings, points
from studies.sweep.spec import Grid, Study

SCHEMA = 1
"""To be raised when `studies.measures` gives other figures for the same run: all is run anew."""

Scenario = dict[str, Any]
Resolve = Callable[[Settings], Scenario]
"""Lays dotted keys over the study's scenario; every key of the result has its value."""


@dataclass(frozen=True, slots=True)
class Cell:
    """One row of the table to come. Cells with equal ids are one run."""

    grid: str
    labels: dict[str, Label]
    seed: int
    scenario: Scenario
    id: str

    @property
    def title(self) -> str:
        """What people are shown."""
        shown = [f"{name}={label}" for name, label in self.labels.items()]
        return " ".join([self.grid, *shown, f"seed={self.seed}"])


def cells_of(study: Study, resolve: Resolve) -> list[Cell]:
    """Returns all cells in the order of the file: grids, axes, seeds.

    Raises:
        ConfigError: a cell's scenario cannot be; says which.
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
            yield Cell(grid.name, point.labels, seed, scenario, identify(scenario))


def identify(scenario: Scenario) -> str:
    """Returns a cell's id: of its scenario, of the files this names, of this version."""
    decides = {
        "scenario": scenario,
        "files": {name: _digest(Path(name)) for name in sorted(set(_files(scenario)))},
        "version": version("cpnet-edge"),
        "schema": SCHEMA,
    }
    return hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()[:16]


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
