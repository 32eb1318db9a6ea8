"""A study's table over seeds, for people."""

from __future__ import annotations

import polars as pl
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from studies.sweep.table import over_seeds
from studies.whole_table import print_whole

SHOWN = {"delay_s": "delay s", "e_cvpr": "E-CVPR", "count_error": "count error"}
"""Measures in the overview; the file has all."""


def overview(frame: pl.DataFrame, axes: list[str]) -> pl.DataFrame:
    """Returns `SHOWN` over seeds, a row for each grid and combination of its axes."""
    shown = [name for name in SHOWN if name in frame.columns]
    return over_seeds(frame, ["grid", *axes], shown)


def print_overview(frame: pl.DataFrame, axes: list[str], console: Console) -> None:
    """Prints a table for each grid: mean ± half width of the 95 % confidence interval."""
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
            figures = [_figure(row.get(f"{m}_mean"), row.get(f"{m}_ci95")) for m in SHOWN]
            table.add_row(*(_label(row[name]) for name in mine), *figures, str(row["n"]))
        print_whole(table, console)


def _label(label: str | float) -> str:
    return escape(label) if isinstance(label, str) else f"{label:g}"


def _figure(mean: float | None, half_width: float | None) -> str:
    if mean is None:
        return "–"
    return f"{mean:.3g}" if half_width is None else f"{mean:.3g} ± {half_width:.2g}"
