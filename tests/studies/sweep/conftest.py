"""A small study, and cells that need no world."""

from pathlib import Path

import pytest

from studies.sweep.cells import Cell, ResultStore, identify


def cell(seed: int, grid: str = "all", **labels: str | float) -> Cell:
    scenario = {"mode": "lockstep", "seed": seed, **labels}
    return Cell(grid, dict(labels), seed, scenario, identify(scenario))


@pytest.fixture
def store(tmp_path: Path) -> ResultStore:
    return ResultStore.at(tmp_path / "out")
