"""What a page about a study is made from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import polars as pl

from studies.sweep.spec import Study
from studies.sweep.table import over_seeds

VALUES = (
    "delay_s",
    "e_cvpr",
    "e_cvpr_std",
    "visible_share",
    "in_range_share",
    "count_error",
    "uplink_mbps",
    "false_detections",
    "vehicles_inserted",
    "vehicles_finished",
    "vehicles_teleported",
    "vehicles_waiting",
)
"""Measures that pages speak of."""

Known = dict[str, float | int | str | None]


@dataclass(frozen=True, slots=True)
class Findings:
    """A study, its table, and the command that makes both again.

    `scenario` is what all cells have in common, with every key; `missing` has no figures.
    """

    study: Study
    frame: pl.DataFrame
    command: str
    versions: Mapping[str, str] = field(default_factory=dict)
    scenario: Mapping[str, Any] = field(default_factory=dict)
    missing: tuple[str, ...] = ()

    def gaps(self) -> str:
        """Returns a sentence on cells that failed or were not run; empty if there are none."""
        if not self.missing:
            return ""
        some = "; ".join(self.missing[:5]) + (" …" if len(self.missing) > 5 else "")
        whole = len(self.frame) + len(self.missing)
        return (
            f" {len(self.missing)} of {whole} cells are MISSING, means are over the rest: {some}."
        )

    def axes(self, grid: str) -> list[str]:
        """Returns the names of a grid's axes."""
        return [name for one in self.study.grids if one.name == grid for name in one.axes]

    def rows(self, grid: str) -> list[Known]:
        """Returns a row for each cell of a grid, over its seeds: see `over_seeds`."""
        part = self.frame.filter(pl.col("grid") == grid)
        present = [value for value in VALUES if value in part.columns]
        return over_seeds(part, self.axes(grid), present).to_dicts() if len(part) else []


def number(row: Known, name: str) -> float | None:
    """Returns a row's figure, None where it has none."""
    value = row.get(name)
    return None if value is None or isinstance(value, str) else float(value)


def label_of(value: float | str | None) -> str:
    """Returns an axis's label as people write it."""
    return value if isinstance(value, str) else "–" if value is None else f"{value:g}"
