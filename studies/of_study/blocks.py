"""Tables and charts of any grid: means over seeds with their 95 % confidence intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from studies.of_study.findings import Known, label_of, number
from studies.page.charts import Chart, Number, Series
from studies.page.model import Cell, Column, Table


@dataclass(frozen=True, slots=True)
class Shown:
    """A measure as pages write it: its name, its unit's factor, its decimals."""

    value: str
    name: str
    factor: float = 1.0
    decimals: int = 1


DELAY = Shown("delay_s", "mean delay, s")
E_CVPR = Shown("e_cvpr", "E-CVPR, %", 100)
VISIBLE = Shown("visible_share", "visible, %", 100)
IN_RANGE = Shown("in_range_share", "in range, %", 100)
COUNT_ERROR = Shown("count_error", "error of a lane's count, vehicles", 1, 2)
UPLINK = Shown("uplink_mbps", "uplink of all, Mbit/s", 1, 2)
TRAFFIC = (
    Shown("vehicles_inserted", "inserted", 1, 0),
    Shown("vehicles_finished", "finished", 1, 0),
    Shown("vehicles_teleported", "teleported", 1, 1),
    Shown("vehicles_waiting", "kept outside", 1, 1),
)
"""What stands beside every delay: whom it is the mean of, and who is missing."""


def mean_of(row: Known, shown: Shown) -> str | None:
    """Returns mean ± half width of its confidence interval; the mean alone of a single seed."""
    mean, half = number(row, f"{shown.value}_mean"), number(row, f"{shown.value}_ci95")
    if mean is None:
        return None
    text = f"{mean * shown.factor:.{shown.decimals}f}"
    return text if half is None else f"{text} ± {half * shown.factor:.{shown.decimals}f}"


def bare_mean(row: Known, shown: Shown) -> float | None:
    """Returns the mean alone, rounded as it is written."""
    mean = number(row, f"{shown.value}_mean")
    return None if mean is None else round(mean * shown.factor, shown.decimals)


def grid_table(rows: list[Known], axes: Sequence[str], caption: str = "") -> Table:
    """Returns a line for each cell."""
    measures = (DELAY, E_CVPR, VISIBLE, IN_RANGE, COUNT_ERROR, UPLINK)
    used = [one for one in measures if any(number(r, f"{one.value}_mean") for r in rows)]
    columns = [*(Column(axis) for axis in axes), *(Column(one.name) for one in used)]
    columns += [*(Column(one.name, f".{one.decimals}f") for one in TRAFFIC), Column("seeds")]
    cells: list[tuple[Cell, ...]] = [
        (
            *(label_of(row[axis]) for axis in axes),
            *(mean_of(row, one) for one in used),
            *(bare_mean(row, one) for one in TRAFFIC),
            row["n"],
        )
        for row in rows
    ]
    return Table(tuple(columns), tuple(cells), caption)


def curve(rows: list[Known], axis: str, shown: Shown, name: str) -> Series:
    """Returns a measure over an axis of numbers, with its confidence band."""
    points = sorted(
        (number(row, axis) or 0.0, row) for row in rows if number(row, axis) is not None
    )
    x: tuple[Number, ...] = tuple(at for at, _ in points)
    mean = [number(row, f"{shown.value}_mean") for _, row in points]
    half = [number(row, f"{shown.value}_ci95") for _, row in points]
    scaled = tuple(None if m is None else m * shown.factor for m in mean)
    if any(h is None for h in half):
        return Series(name, x, scaled, style="line+points")
    pairs = list(zip(mean, half, strict=True))
    low = tuple(None if m is None or h is None else (m - h) * shown.factor for m, h in pairs)
    high = tuple(None if m is None or h is None else (m + h) * shown.factor for m, h in pairs)
    return Series(name, x, scaled, low, high, style="line+points")


def curves(rows: list[Known], axis: str, others: Sequence[str], shown: Shown) -> Chart:
    """Returns a line for each combination of the other axes."""
    groups: dict[str, list[Known]] = {}
    for row in rows:
        name = ", ".join(label_of(row[other]) for other in others) or shown.name
        groups.setdefault(name, []).append(row)
    series = tuple(curve(part, axis, shown, name) for name, part in groups.items())
    return Chart(f"{shown.name} over {axis}", axis, shown.name, series, x_log=_is_wide(rows, axis))


def bars(rows: list[Known], axes: Sequence[str], shown: Shown) -> Chart:
    """Returns a bar for each cell, with whiskers where there are several seeds."""
    names = tuple(", ".join(label_of(row[axis]) for axis in axes) for row in rows)
    mean = [number(row, f"{shown.value}_mean") for row in rows]
    half = [number(row, f"{shown.value}_ci95") for row in rows]
    pairs = list(zip(mean, half, strict=True))
    known = all(h is not None for h in half)
    low = tuple(None if m is None or h is None else (m - h) * shown.factor for m, h in pairs)
    high = tuple(None if m is None or h is None else (m + h) * shown.factor for m, h in pairs)
    series = Series(
        shown.name,
        tuple(range(len(names))),
        tuple(None if m is None else m * shown.factor for m in mean),
        low if known else None,
        high if known else None,
    )
    return Chart(shown.name, "", shown.name, (series,), "bar", x_categories=names)


def _is_wide(rows: list[Known], axis: str) -> bool:
    """Whether an axis spans so much that only a logarithm shows it all."""
    values = [value for row in rows if (value := number(row, axis)) is not None]
    return bool(values) and min(values) > 0 and max(values) / min(values) > 100
