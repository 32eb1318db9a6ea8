"""The pages of a plain study and of the study `bandwidth`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from studies.page.model import Block, Cell, Column, Page, Section, Table, Text
from studies.study_tables import (
    COUNT_ERROR,
    DELAY,
    E_CVPR,
    GridRow,
    Measure,
    StudyResults,
    bars,
    curves,
    figure_of,
    grid_table,
    label_of,
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
    caption = "Means over seeds ± half the width of the 95 % confidence interval."
    blocks: list[Block] = [grid_table(rows, axes, caption)]
    drawn = [one for one in _DRAWN if any(figure_of(r, f"{one.value}_mean") for r in rows)]
    blocks += [_chart(rows, axes, one) for one in drawn if len(rows) > 1]
    return Section(grid, tuple(blocks))


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
_LONG_S = 1800.0
ENOUGH = 0.99  # of the E-CVPR that the fastest uplink gives
_TITLES = {
    "every-second": "Perception once a second",
    "ten-a-second": "Perception ten times a second",
    "latency": "Latency",
}


def bandwidth_page(findings: StudyResults, sections: Sequence[Section] = ()) -> Page:
    """Returns what is enough first, then further sections, then each grid."""
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
    names = [grid.name for grid in findings.study.grids if RATE in grid.axes]
    rows = tuple(row for name in names for row in _answers(findings, name))
    columns = (
        Column("perception"), Column("upload"), Column("enough, Mbit/s an agent"),
        Column("E-CVPR there, %", ".1f"), Column("mean delay there, s", ".1f"),
        Column("sent by all, Mbit/s", ".2f"),
    )  # fmt: skip
    text = (
        f"Enough is the slowest uplink studied with which E-CVPR is at least {100 * ENOUGH:g} % of "
        "what the fastest gives with the same upload."
    )
    return Section("How much is enough", (Text(text), Table(columns, rows)))


def _answers(findings: StudyResults, grid: str) -> Iterator[tuple[Cell, ...]]:
    groups: dict[str, list[GridRow]] = {}
    for row in findings.rows(grid):
        groups.setdefault(label_of(row[UPLOAD]), []).append(row)
    for upload, rows in groups.items():
        rows.sort(key=lambda row: figure_of(row, RATE) or 0.0)
        goal = ENOUGH * (figure_of(rows[-1], "e_cvpr_mean") or 0.0)
        first = next(row for row in rows if (figure_of(row, "e_cvpr_mean") or 0.0) >= goal)
        figures = (rounded_mean(first, shown) for shown in (E_CVPR, DELAY))
        sent = figure_of(first, "uplink_mbps_mean")
        yield (_TITLES.get(grid, grid), upload, label_of(first[RATE]), *figures, sent)


def _uplink_grid_section(findings: StudyResults, grid: Grid) -> Section:
    axes, rows = findings.axes(grid.name), findings.rows(grid.name)
    axis = axes[-1]
    blocks: list[Block] = [
        curves(rows, axis, [other for other in axes if other != axis], shown)
        for shown in (E_CVPR, COUNT_ERROR, DELAY)
    ]
    caption = "Means over seeds ± half the width of the 95 % confidence interval."
    settings = {**findings.scenario, **findings.study.settings, **grid.settings}
    if settings.get("duration_s", _LONG_S) < _LONG_S:
        caption += (
            f" In runs of {settings['duration_s']:g} s delays tell little; counts and E-CVPR are "
            "of every frame."
        )
    return Section(_TITLES.get(grid.name, grid.name), (*blocks, grid_table(rows, axes, caption)))
