"""The pages of a plain study and of the study `bandwidth`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import polars as pl

from studies.page.model import Block, Cell, Column, Page, Section, Table, Text
from studies.study_tables import (
    CAPTION,
    COUNT_ERROR,
    DELAY,
    E_CVPR,
    UPLINK,
    WIRE_DOWN,
    WIRE_UP,
    GridRow,
    Measure,
    StudyResults,
    bars,
    curves,
    difference_of,
    figure_of,
    grid_table,
    label_of,
    mean_of,
    origin_section,
    rounded_mean,
)
from studies.sweep.study_file import Grid

_DRAWN = (DELAY, E_CVPR, COUNT_ERROR)


def plain_page(findings: StudyResults, sections: Sequence[Section] = ()) -> Page:
    """Returns further sections, then tables and charts of all grids."""
    study = findings.study
    grids = (_grid_section(findings, grid.name) for grid in study.grids)
    lead = f"Study {study.name}: {len(findings.frame)} runs, seeds {_listed(study.seeds)}."
    lead += findings.gaps()
    return Page(
        study.title or study.name,
        lead,
        (*sections, *grids, *findings.networks, origin_section(findings)),
    )


def _grid_section(findings: StudyResults, grid: str) -> Section:
    axes, rows = findings.axes(grid), findings.rows(grid)
    blocks: list[Block] = [grid_table(rows, axes, CAPTION)]
    drawn = [one for one in _DRAWN if any(figure_of(r, f"{one.value}_mean") for r in rows)]
    blocks += [_chart(rows, axes, one) for one in drawn if len(rows) > 1]
    blocks += _differences(findings, grid, rows, axes)
    return Section(grid, tuple(blocks))


def _differences(
    findings: StudyResults, grid: str, rows: list[GridRow], axes: list[str]
) -> list[Block]:
    """Returns the differences of all cells from the first one, paired by seed."""
    if len(rows) < 2 or len(findings.study.seeds) < 2:
        return []
    frame, first = findings.frame.filter(pl.col("grid") == grid), _cell(rows[0], axes)
    shown = [one for one in _DRAWN if one.value in frame.columns]
    columns = (*(Column(axis) for axis in axes), *(Column(one.name) for one in shown))
    cells = tuple(
        (
            *(label_of(row[axis]) for axis in axes),
            *(difference_of(frame, one, _cell(row, axes), first) for one in shown),
        )
        for row in rows[1:]
    )
    return [Table(columns, cells, f"Less the first line's, paired by seed. {CAPTION}")]


def _cell(row: GridRow, axes: Sequence[str]) -> pl.Expr:
    """Returns the filter of a cell's rows, one a seed."""
    return pl.all_horizontal([pl.col(axis).eq_missing(pl.lit(row[axis])) for axis in axes])


def _chart(rows: list[GridRow], axes: list[str], shown: Measure) -> Block:
    """Draws over the numeric axis with most values; bars where there is none."""
    numeric = {a: len({r[a] for r in rows}) for a in axes if not isinstance(rows[0][a], str)}
    longest = max(numeric, key=lambda axis: numeric[axis], default=None)
    if longest is None or numeric[longest] < 2:
        return bars(rows, axes, shown)
    return curves(rows, longest, [axis for axis in axes if axis != longest], shown)


def _listed(seeds: list[int]) -> str:
    return ", ".join(map(str, seeds))


UPLOAD, RATE = "upload", "uplink in Mbit/s"
_LONG_S = 900.0
ENOUGH = 0.99  # of the E-CVPR that the fastest uplink gives
_TITLES = {
    "every-second": "Perception once a second",
    "whole-scans": "Ten times a second: whole scans",
    "foreground": "Ten times a second: without ground and background",
    "each-its-part": "Ten times a second: each its part of that (EMP)",
    "boxes": "Ten times a second: boxes",
    "latency": "Latency, once a second",
    "loss": "Loss of packets, whole scans ten times a second on 10 Mbit/s",
}


def bandwidth_page(findings: StudyResults, sections: Sequence[Section] = ()) -> Page:
    """Returns the sufficient uplink rates, then further sections, then each grid."""
    study = findings.study
    lead = (
        "Every agent, vehicles and the roadside LiDAR alike, is on an uplink of its own. What does "
        "not arrive before the edge's deadline is left out of its frame. Links are virtual: bytes "
        f"are real, arrival is in simulated time. {len(findings.frame)} runs, "
        f"seeds of each cell: {len(study.seeds)}." + findings.gaps()
    )
    grids = (_uplink_grid_section(findings, grid) for grid in study.grids)
    return Page(
        study.title or study.name,
        lead,
        (
            _answer_section(findings),
            *sections,
            *grids,
            *findings.networks,
            origin_section(findings),
        ),
    )


def _answer_section(findings: StudyResults) -> Section:
    grids = [grid for grid in findings.study.grids if RATE in grid.axes]
    rows = tuple(row for grid in grids for row in _answers(findings, grid))
    columns = (
        Column("perception"), Column("upload or deadline"), Column("enough, Mbit/s an agent"),
        Column("E-CVPR there, %"), Column("difference from the fastest, points, paired"),
        Column("mean delay there, s"), Column(UPLINK.name), Column(f"{WIRE_UP.name}, Mbit/s"),
        Column(f"{WIRE_DOWN.name}, Mbit/s"),
    )  # fmt: skip
    text = (
        f"Enough is the slowest uplink studied with which E-CVPR is at least {100 * ENOUGH:g} % of "
        "what the fastest gives with the same upload and deadline. On the wire is all that agents "
        "sent and received: rosters, poses, plans, acknowledgements, all headers. Delays of runs "
        f"under {_LONG_S:g} s are left out: they tell little."
    )
    return Section("How much is enough", (Text(text), Table(columns, rows, CAPTION)))


def _answers(findings: StudyResults, grid: Grid) -> Iterator[tuple[Cell, ...]]:
    axes = findings.axes(grid.name)
    frame = findings.frame.filter(pl.col("grid") == grid.name)
    others = [axis for axis in axes if axis != RATE]
    groups: dict[str, list[GridRow]] = {}
    for row in findings.rows(grid.name):
        label = ", ".join(f"{label_of(row[axis])}{_unit(axis)}" for axis in others)
        groups.setdefault(label, []).append(row)
    for label, rows in groups.items():
        rows.sort(key=lambda row: figure_of(row, RATE) or 0.0)
        goal = ENOUGH * (figure_of(rows[-1], "e_cvpr_mean") or 0.0)
        first = next(row for row in rows if (figure_of(row, "e_cvpr_mean") or 0.0) >= goal)
        yield (
            _TITLES.get(grid.name, grid.name),
            label,
            label_of(first[RATE]),
            mean_of(first, E_CVPR),
            difference_of(frame, E_CVPR, _cell(first, axes), _cell(rows[-1], axes)),
            mean_of(first, DELAY) if _is_long(findings, grid) else None,
            *(rounded_mean(first, one) for one in (UPLINK, WIRE_UP, WIRE_DOWN)),
        )


def _unit(axis: str) -> str:
    return " ms" if axis.endswith(" in ms") else ""


def _is_long(findings: StudyResults, grid: Grid) -> bool:
    settings = {**findings.scenario, **findings.study.settings, **grid.settings}
    return bool(settings.get("duration_s", _LONG_S) >= _LONG_S)


def _uplink_grid_section(findings: StudyResults, grid: Grid) -> Section:
    axes, rows = findings.axes(grid.name), findings.rows(grid.name)
    axis, caption = axes[-1], CAPTION
    shown = [E_CVPR, COUNT_ERROR]
    if _is_long(findings, grid):
        shown.append(DELAY)
    else:
        caption += " Such short runs tell little of delays; counts and E-CVPR are of every frame."
    others = [other for other in axes if other != axis]
    blocks: list[Block] = [curves(rows, axis, others, one) for one in shown]
    return Section(_TITLES.get(grid.name, grid.name), (*blocks, grid_table(rows, axes, caption)))
