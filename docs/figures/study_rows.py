"""Prints a study's rows with the LiDARs of their cells: `study_rows.py STUDY.yaml RESULTS`.

Without arguments it prints the LiDARs of each kind of `realism`.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any, get_args

from pyarrow import parquet

from cpnet import scenario
from studies.sweep.cells import cells_of
from studies.sweep.study_file import read_study

KEYS = ("channels", "points_per_second", "range")


def main() -> None:
    """Prints JSON."""
    found = rows(sys.argv[1], Path(sys.argv[2])) if len(sys.argv) > 1 else by_realism()
    json.dump(found, sys.stdout)


def rows(study_file: str, results: Path) -> list[dict[str, Any]]:
    """Returns the rows of a study, each with `lidar`: that of its vehicles and posts."""
    file = read_study(study_file)
    cells = cells_of(
        file.study, lambda keys: scenario.load(file.scenario, keys).model_dump(mode="json")
    )
    lidars = {_key(one.grid, one.seed, one.labels): lidar_of(one.scenario) for one in cells}
    labels = {grid.name: list(grid.axes) for grid in file.study.grids}
    return [
        row
        | {
            "lidar": lidars[
                _key(row["grid"], row["seed"], {name: row[name] for name in labels[row["grid"]]})
            ]
        }
        for row in parquet.read_table(results / "results.parquet").to_pylist()
    ]


def by_realism() -> dict[str, dict[str, float]]:
    """Returns the LiDAR of `t_junction` by kind of `realism`."""
    kinds = get_args(scenario.Realism)
    loaded = {one: scenario.load("t_junction", {"realism": one}) for one in kinds}
    return {one: lidar_of(world.model_dump(mode="json")) for one, world in loaded.items()}


def lidar_of(world: dict[str, Any]) -> dict[str, float]:
    """Returns rings, points a second and range in m.

    Raises:
        ValueError: vehicles and posts have different ones.
    """
    vehicle, roadside = (
        {key: world["lidar"][kind][key] for key in KEYS} for kind in ("vehicle", "roadside")
    )
    if vehicle != roadside:
        raise ValueError(f"LiDARs differ: {vehicle} on vehicles, {roadside} on posts")
    return vehicle


def _key(grid: str, seed: int, labels: dict[str, Any]) -> tuple[Any, ...]:
    return (
        grid,
        seed,
        *((name, str(float(v) if isinstance(v, int) else v)) for name, v in labels.items()),
    )


if __name__ == "__main__":
    main()
