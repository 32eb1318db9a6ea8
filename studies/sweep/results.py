"""The table of a study, a row for each cell and seed, and its overview over seeds."""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from scipy.special import stdtrit

from protocol.errors import ConfigError
from studies.bench import print_whole
from studies.sweep.cells import Cell, PartKind, ResultStore, write_atomically
from studies.sweep.worker import Row

FILE = "results.parquet"
PART_IDS: dict[PartKind, str] = {"junctions": "tls", "regions": "region"}
"""The column that names a row's junction or region; `KIND.parquet` is the file."""
_CONFIDENCE = 0.95
SEEDS_FOR_INTERVAL = 5  # below, an interval by Student's t is mostly its quantile: points are shown


def table(cells: list[Cell], store: ResultStore) -> pl.DataFrame:
    """Returns `grid`, a column for each axis, `seed`, then the measures; unfinished cells lack.

    An axis of numbers only is a column of numbers, any other of texts; it is null in grids that do
    not have it.

    Raises:
        ConfigError: an axis is called like a measure.
    """
    return _frame(cells, [(cell, row) for cell in cells if (row := store.row(cell.id)) is not None])


def parts_table(cells: list[Cell], store: ResultStore, kind: PartKind) -> pl.DataFrame:
    """Returns the table by junction (`tls`) or region (`region`): a row for each in each cell.

    Raises:
        ConfigError: an axis is called like a measure.
    """
    found: list[tuple[Cell, Row]] = [
        (cell, {PART_IDS[kind]: part, **row})
        for cell in cells
        for part, row in (store.parts(cell.id, kind) or {}).items()
    ]
    return _frame(cells, found)


def _frame(cells: list[Cell], found: list[tuple[Cell, Row]]) -> pl.DataFrame:
    axes = list(dict.fromkeys(name for cell in cells for name in cell.labels))
    measures = list(dict.fromkeys(name for _, row in found for name in row))
    both = sorted(set(axes) & set(measures))
    if both:
        raise ConfigError(f"the axis {both[0]} is called like a measure: give it another name")
    columns = [pl.Series("grid", [cell.grid for cell, _ in found], pl.String)]
    columns += [_axis(name, cells, [cell for cell, _ in found]) for name in axes]
    columns.append(pl.Series("seed", [cell.seed for cell, _ in found], pl.Int64))
    columns += [_measure(name, [row for _, row in found]) for name in measures]
    return pl.DataFrame(columns)


def write_table(frame: pl.DataFrame, store: ResultStore, name: str = FILE) -> Path:
    """Writes a table into the study's folder; returns its path."""
    buffer = io.BytesIO()
    frame.write_parquet(buffer)
    path = store.folder / name
    write_atomically(path, buffer.getvalue())
    return path


def over_seeds(frame: pl.DataFrame, by: list[str], values: list[str]) -> pl.DataFrame:
    """Returns a row for each combination of `by`, in the order of their first rows.

    For each value V: V_mean, V_sd (of a sample) and V_ci95, the half width of the mean's 95 %
    confidence interval by Student's t; null where there are too few; V_values, one of each seed. n
    counts rows, so seeds; a value that some of them lack is taken over the others.
    """
    grouped = frame.group_by(by, maintain_order=True)
    parts = [pl.len().alias("n")]
    for value in values:
        column = pl.col(value).drop_nulls()
        parts += [
            column.mean().alias(f"{value}_mean"),
            column.std().alias(f"{value}_sd"),
            column.len().alias(f"_{value}_n"),
            column.implode().alias(f"{value}_values"),
        ]
    result = grouped.agg(parts)
    for value in values:
        counts, spreads = result[f"_{value}_n"], result[f"{value}_sd"]
        half = [_half_width(n, sd) for n, sd in zip(counts, spreads, strict=True)]
        result = result.with_columns(pl.Series(f"{value}_ci95", half, pl.Float64))
    kept = [f"{value}_{part}" for value in values for part in ("mean", "sd", "ci95", "values")]
    return result.select(*by, "n", *kept)


def _half_width(n: int, sd: float | None) -> float | None:
    if sd is None or n < 2:
        return None
    return float(stdtrit(n - 1, (1 + _CONFIDENCE) / 2)) * sd / math.sqrt(n)


def _axis(name: str, cells: list[Cell], rows: list[Cell]) -> pl.Series:
    """Returns an axis's column; its type follows from the file, not from what is done already."""
    kinds = {type(cell.labels[name]) for cell in cells if name in cell.labels}
    labels = [cell.labels.get(name) for cell in rows]
    if str in kinds:
        texts = [None if label is None else str(label) for label in labels]
        return pl.Series(name, texts, pl.String)
    return pl.Series(name, labels, pl.Float64 if float in kinds else pl.Int64, strict=False)


def _measure(name: str, rows: list[Row]) -> pl.Series:
    values = [row.get(name) for row in rows]
    kinds = {type(value) for value in values}
    if list in kinds:
        return pl.Series(name, values, pl.List(pl.Int64))
    if str in kinds:
        return pl.Series(name, values, pl.String)
    return pl.Series(name, values, pl.Int64 if kinds == {int} else pl.Float64, strict=False)


SHOWN = {"delay_s": "delay s", "e_cvpr": "E-CVPR", "count_error": "count error"}
"""Measures in the overview; the file has all."""


def overview(frame: pl.DataFrame, axes: list[str]) -> pl.DataFrame:
    """Returns `SHOWN` over seeds, a row for each grid and combination of its axes."""
    shown = [name for name in SHOWN if name in frame.columns]
    return over_seeds(frame, ["grid", *axes], shown)


def print_overview(frame: pl.DataFrame, axes: list[str], console: Console) -> None:
    """Prints a table for each grid: mean and 95 % confidence interval, or the seeds' values."""
    for (grid,), part in overview(frame, axes).group_by("grid", maintain_order=True):
        mine = [name for name in axes if part[name].null_count() < len(part)]
        table = Table(box=box.SIMPLE_HEAD, title=escape(str(grid)), title_justify="left")
        for name in mine:
            table.add_column(
                escape(name), justify="right" if part[name].dtype.is_numeric() else "left"
            )
        for head in (*SHOWN.values(), "n"):
            table.add_column(head, justify="right")
        for row in part.iter_rows(named=True):
            figures = [_figure(row, name) for name in SHOWN]
            table.add_row(*(_label(row[name]) for name in mine), *figures, str(row["n"]))
        print_whole(table, console)


def _label(label: str | float) -> str:
    return escape(label) if isinstance(label, str) else f"{label:g}"


def _figure(row: dict[str, Any], name: str) -> str:
    mean, half_width = row.get(f"{name}_mean"), row.get(f"{name}_ci95")
    if mean is None:
        return "–"
    values = row[f"{name}_values"]
    if half_width is None:
        return f"{mean:.3g}"
    if len(values) < SEEDS_FOR_INTERVAL:
        return f"{mean:.3g} ({' '.join(f'{value:.3g}' for value in values)})"
    return f"{mean:.3g} ± {half_width:.2g}"


def paired_difference(
    frame: pl.DataFrame, value: str, one: pl.Expr, other: pl.Expr
) -> dict[str, Any] | None:
    """Returns the mean, interval and values of `one` minus `other`, seed by seed.

    Seeds share traffic and noise: their differences vary less than their values. None without a
    seed that has both; keys as of `over_seeds`.
    """
    halves = [frame.filter(which).select("seed", value).drop_nulls() for which in (one, other)]
    both = halves[0].join(halves[1], on="seed", suffix="_other").sort("seed")
    if not len(both):
        return None
    values = (both[value] - both[f"{value}_other"]).to_list()
    spread = float(np.std(values, ddof=1)) if len(values) > 1 else None
    return {
        f"{value}_mean": float(np.mean(values)),
        f"{value}_ci95": _half_width(len(values), spread),
        f"{value}_values": values,
    }
