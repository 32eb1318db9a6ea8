"""The page of the study `value`: delay over what perception is given, two controllers in pairs."""

from __future__ import annotations

from collections.abc import Sequence

import polars as pl

from studies.control_study import paired
from studies.page.model import Block, Cell, Column, Page, Section, Table
from studies.study_page import plain_page
from studies.study_tables import StudyResults, label_of

CONTROLLER = "controller"
_STUDIED, _OTHER = "predictive", "max pressure"


def value_page(findings: StudyResults, sections: Sequence[Section] = ()) -> Page:
    """Returns the paired differences of the controllers first, then all that a plain page has."""
    blocks: list[Block] = [
        table for grid in findings.study.grids if (table := _pairs(findings, grid.name)) is not None
    ]
    pairs = Section(f"{_STUDIED} against {_OTHER}, seed by seed", tuple(blocks))
    return plain_page(findings, (pairs, *sections) if blocks else sections)


def _pairs(findings: StudyResults, grid: str) -> Table | None:
    """Returns a line for each point of a grid that both controllers have driven."""
    axes = [axis for axis in findings.axes(grid) if axis != CONTROLLER]
    part = findings.frame.filter(pl.col("grid") == grid)
    rows: list[tuple[Cell, ...]] = []
    for key, point in part.group_by(axes, maintain_order=True):
        delays_s = [
            dict(point.filter(pl.col(CONTROLLER) == name).select("seed", "delay_s").iter_rows())
            for name in (_STUDIED, _OTHER)
        ]
        seeds = sorted(set(delays_s[0]) & set(delays_s[1]))
        if not seeds:
            continue
        own, other = ([one[seed] for seed in seeds] for one in delays_s)
        found = paired(own, other)
        mean_s = sum(other) / len(seeds)
        half = None if found.half is None else round(found.half, 2)
        share = round(100 * found.mean / mean_s, 1) if mean_s else None
        rows.append((*map(label_of, key), round(found.mean, 2), half, share, len(seeds)))
    if not rows:
        return None
    heads = (
        "difference of mean delay, s",
        "smallest that can be told, s",
        "difference, %",
        "seeds",
    )
    caption = (
        f"{grid}: delay under {_STUDIED} less that under {_OTHER}. A difference smaller than half "
        "the width of its 95 % interval (Student's t over the seeds) cannot be told from none."
    )
    return Table(tuple(map(Column, (*axes, *heads))), tuple(rows), caption)
