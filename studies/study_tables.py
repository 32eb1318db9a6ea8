"""Tables and charts of a study's grids: means over seeds with confidence intervals.

From five seeds on that is the 95 % confidence interval, cut off at what is possible; below, the
values of the seeds themselves. Comparisons are paired by seed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import polars as pl
import yaml

from studies.page.model import Block, Cell, Chart, Code, Column, Numbers, Section, Series, Table
from studies.sweep.results import SEEDS_FOR_INTERVAL, over_seeds, paired_difference
from studies.sweep.study_file import Study

MEASURE_COLUMNS = (
    "delay_s",
    "delay_p95_s",
    "stops",
    "co2_g",
    "e_cvpr",
    "e_cvpr_std",
    "visible_share",
    "in_range_share",
    "count_error",
    "uplink_mbps",
    "wire_up_mbps",
    "wire_down_mbps",
    "false_detections",
    "vehicles_inserted",
    "vehicles_finished",
    "vehicles_teleported",
    "vehicles_waiting",
)
"""Measures that pages show."""

GridRow = dict[str, Any]
CAPTION = (
    "Means over seeds ± half the width of the 95 % confidence interval; below "
    f"{SEEDS_FOR_INTERVAL} seeds, the values of the seeds in brackets."
)


@dataclass(frozen=True, slots=True)
class StudyResults:
    """A study, its table, and the command that reproduces both.

    `scenario` is what all cells have in common, with every key; `missing` has no figures;
    `networks` are sections about nets of several junctions.
    """

    study: Study
    frame: pl.DataFrame
    command: str
    versions: Mapping[str, str] = field(default_factory=dict)
    scenario: Mapping[str, Any] = field(default_factory=dict)
    missing: tuple[str, ...] = ()
    networks: tuple[Section, ...] = ()

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

    def rows(self, grid: str) -> list[GridRow]:
        """Returns a row for each cell of a grid, over its seeds: see `over_seeds`."""
        part = self.frame.filter(pl.col("grid") == grid)
        present = [value for value in MEASURE_COLUMNS if value in part.columns]
        return over_seeds(part, self.axes(grid), present).to_dicts() if len(part) else []


def figure_of(row: GridRow, name: str) -> float | None:
    """Returns a row's figure, None where it has none."""
    value = row.get(name)
    return float(value) if isinstance(value, (int, float)) else None


def values_of(row: GridRow, name: str) -> list[float]:
    """Returns a measure's values, one of each seed."""
    return [float(value) for value in row.get(f"{name}_values") or []]


def label_of(value: float | str | None) -> str:
    """Returns an axis's label as text."""
    return value if isinstance(value, str) else "–" if value is None else f"{value:g}"


@dataclass(frozen=True, slots=True)
class Measure:
    """A measure as pages write it: name, factor of its unit, decimals, largest possible value.

    None can be less than 0, unless it is a difference.
    """

    value: str
    name: str
    factor: float = 1.0
    decimals: int = 1
    most: float | None = None

    def bounds(self, row: GridRow) -> tuple[float, float] | None:
        """Returns the ends of a row's interval, as written; None below five seeds."""
        mean, half = figure_of(row, f"{self.value}_mean"), figure_of(row, f"{self.value}_ci95")
        if mean is None or half is None or len(values_of(row, self.value)) < SEEDS_FOR_INTERVAL:
            return None
        high = (mean + half) * self.factor
        return max(0.0, (mean - half) * self.factor), min(high, self.most or high)


DELAY = Measure("delay_s", "mean delay, s")
E_CVPR = Measure("e_cvpr", "E-CVPR, %", 100, most=100)
VISIBLE = Measure("visible_share", "visible, %", 100, most=100)
IN_RANGE = Measure("in_range_share", "in range, %", 100, most=100)
COUNT_ERROR = Measure("count_error", "error of a lane's count, vehicles", 1, 2)
UPLINK = Measure("uplink_mbps", "payload of all, Mbit/s", 1, 2)
WIRE_UP = Measure("wire_up_mbps", "on the wire, up", 1, 2)
WIRE_DOWN = Measure("wire_down_mbps", "and down", 1, 3)
TRAFFIC = (
    Measure("vehicles_inserted", "inserted", 1, 0),
    Measure("vehicles_finished", "finished", 1, 0),
    Measure("vehicles_teleported", "teleported", 1, 1),
    Measure("vehicles_waiting", "not inserted", 1, 1),
)
"""Measures shown beside every delay: the number of vehicles in its mean, and of those missing."""


def mean_of(row: GridRow, shown: Measure) -> str | None:
    """Returns the mean with its interval or, below five seeds, with the values of the seeds.

    An interval that is cut off at what is possible is written by its ends.
    """
    mean = figure_of(row, f"{shown.value}_mean")
    if mean is None:
        return None
    text, half = _written(mean, shown), figure_of(row, f"{shown.value}_ci95")
    values, bounds = values_of(row, shown.value), shown.bounds(row)
    if bounds is not None and half is not None:
        low, high = bounds
        if high - low < 1.999 * half * shown.factor:
            return f"{text} ({low:.{shown.decimals}f} to {high:.{shown.decimals}f})"
        return f"{text} ± {_written(half, shown)}"
    if len(values) < 2:
        return text
    return f"{text} ({', '.join(_written(value, shown) for value in values)})"


def difference_of(frame: pl.DataFrame, shown: Measure, one: pl.Expr, other: pl.Expr) -> str | None:
    """Returns the difference of a measure between two cells, paired by seed; as `mean_of`."""
    found = paired_difference(frame, shown.value, one, other)
    if found is None:
        return None
    mean, half, values = (found[f"{shown.value}_{part}"] for part in ("mean", "ci95", "values"))
    text = f"{mean * shown.factor:+.{shown.decimals}f}"
    if half is not None and len(values) >= SEEDS_FOR_INTERVAL:
        return f"{text} ± {_written(half, shown)}"
    signed = (f"{value * shown.factor:+.{shown.decimals}f}" for value in values)
    return text if len(values) < 2 else f"{text} ({', '.join(signed)})"


def _written(value: float, shown: Measure) -> str:
    return f"{value * shown.factor:.{shown.decimals}f}"


def rounded_mean(row: GridRow, shown: Measure) -> float | None:
    """Returns the mean alone, rounded as it is written."""
    mean = figure_of(row, f"{shown.value}_mean")
    return None if mean is None else round(mean * shown.factor, shown.decimals)


def grid_table(rows: list[GridRow], axes: Sequence[str], caption: str = "") -> Table:
    """Returns a line for each cell."""
    measures = (DELAY, E_CVPR, VISIBLE, IN_RANGE, COUNT_ERROR, UPLINK, WIRE_UP, WIRE_DOWN)
    used = [one for one in measures if any(figure_of(r, f"{one.value}_mean") for r in rows)]
    columns = [*(Column(axis) for axis in axes), *(Column(one.name) for one in used)]
    columns += [*(Column(one.name, f".{one.decimals}f") for one in TRAFFIC), Column("seeds")]
    cells: list[tuple[Cell, ...]] = [
        (
            *(label_of(row[axis]) for axis in axes),
            *(mean_of(row, one) for one in used),
            *(rounded_mean(row, one) for one in TRAFFIC),
            row["n"],
        )
        for row in rows
    ]
    return Table(tuple(columns), tuple(cells), caption)


def curve(rows: list[GridRow], axis: str, shown: Measure, name: str) -> Series:
    """Returns a measure over an axis of numbers, with its confidence band or its seeds' points."""
    points = sorted(
        (figure_of(row, axis) or 0.0, row) for row in rows if figure_of(row, axis) is not None
    )
    x = tuple(at for at, _ in points)
    rows = [row for _, row in points]
    return Series(name, x, *_means(rows, shown), style="line+points", points=_points(rows, shown))


def _means(rows: list[GridRow], shown: Measure) -> tuple[Numbers, Numbers | None, Numbers | None]:
    """Returns means, and both ends of their confidence intervals if all rows have one."""
    mean = [figure_of(row, f"{shown.value}_mean") for row in rows]
    scaled = tuple(None if m is None else m * shown.factor for m in mean)
    bounds = [shown.bounds(row) for row in rows]
    known = [one for one in bounds if one is not None]
    if len(known) < len(rows):
        return scaled, None, None
    return scaled, tuple(low for low, _ in known), tuple(high for _, high in known)


def _points(rows: list[GridRow], shown: Measure) -> tuple[Numbers, ...]:
    """Returns the values of several seeds where they are too few for an interval."""
    values = [values_of(row, shown.value) for row in rows]
    if all(len(one) < 2 for one in values) or _means(rows, shown)[1] is not None:
        return ()
    return tuple(tuple(value * shown.factor for value in one) for one in values)


def curves(rows: list[GridRow], axis: str, others: Sequence[str], shown: Measure) -> Chart:
    """Returns a line for each combination of the other axes."""
    groups: dict[str, list[GridRow]] = {}
    for row in rows:
        name = ", ".join(label_of(row[other]) for other in others) or shown.name
        groups.setdefault(name, []).append(row)
    series = tuple(curve(part, axis, shown, name) for name, part in groups.items())
    return Chart(f"{shown.name} over {axis}", axis, shown.name, series, x_log=_is_wide(rows, axis))


def bars(rows: list[GridRow], axes: Sequence[str], shown: Measure) -> Chart:
    """Returns a bar for each cell, with whiskers where there are several seeds."""
    names = tuple(", ".join(label_of(row[axis]) for axis in axes) for row in rows)
    x, points = tuple(range(len(names))), _points(rows, shown)
    series = Series(shown.name, x, *_means(rows, shown), points=points)
    return Chart(shown.name, "", shown.name, (series,), "bar", x_categories=names)


def _is_wide(rows: list[GridRow], axis: str) -> bool:
    """Whether an axis spans so much that it needs a logarithmic scale."""
    values = [value for row in rows if (value := figure_of(row, axis)) is not None]
    return bool(values) and min(values) > 0 and max(values) / min(values) > 100


def origin_section(findings: StudyResults) -> Section:
    """Returns the section on reproducing the study."""
    text = yaml.safe_dump(
        findings.study.model_dump(by_alias=True), sort_keys=False, allow_unicode=True
    )
    blocks: list[Block] = [Code(findings.command, "The command that makes this again")]
    if findings.versions:
        rows = tuple(findings.versions.items())
        blocks.append(Table((Column("made with"), Column("version")), rows))
    blocks.append(Code(text, "The study, with what was set on the command line", folded=True))
    return Section("How it was made", tuple(blocks))
