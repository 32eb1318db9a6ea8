"""Cells of a study that need no world."""

from studies.sweep.cells import Cell, identify


def cell(seed: int, grid: str = "all", **labels: str | float) -> Cell:
    scenario = {"mode": "lockstep", "seed": seed, **labels}
    return Cell(grid, dict(labels), seed, scenario, identify(scenario))
