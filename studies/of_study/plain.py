"""The page of any study: a section for each grid."""

from __future__ import annotations

from collections.abc import Sequence

from studies.of_study.blocks import COUNT_ERROR, DELAY, E_CVPR, Shown, bars, curves, grid_table
from studies.of_study.findings import Findings, Known, number
from studies.of_study.origin import origin_section
from studies.page.model import Block, Page, Section

_DRAWN = (DELAY, E_CVPR, COUNT_ERROR)


def plain_page(findings: Findings, sections: Sequence[Section] = ()) -> Page:
    """Returns further sections, then tables and charts of all grids."""
    study = findings.study
    grids = (_grid_section(findings, grid.name) for grid in study.grids)
    lead = f"Study {study.name}: {len(findings.frame)} runs, seeds {_listed(study.seeds)}."
    lead += findings.gaps()
    return Page(study.title or study.name, lead, (*sections, *grids, origin_section(findings)))


def _grid_section(findings: Findings, grid: str) -> Section:
    axes, rows = findings.axes(grid), findings.rows(grid)
    caption = "Means over seeds ± half the width of the 95 % confidence interval."
    blocks: list[Block] = [grid_table(rows, axes, caption)]
    drawn = [one for one in _DRAWN if any(number(r, f"{one.value}_mean") for r in rows)]
    blocks += [_chart(rows, axes, one) for one in drawn if len(rows) > 1]
    return Section(grid, tuple(blocks))


def _chart(rows: list[Known], axes: list[str], shown: Shown) -> Block:
    """Draws over the numeric axis with most values; bars where there is none."""
    numeric = {a: len({r[a] for r in rows}) for a in axes if not isinstance(rows[0][a], str)}
    longest = max(numeric, key=lambda axis: numeric[axis], default=None)
    if longest is None or numeric[longest] < 2:
        return bars(rows, axes, shown)
    return curves(rows, longest, [axis for axis in axes if axis != longest], shown)


def _listed(seeds: list[int]) -> str:
    return ", ".join(map(str, seeds))
