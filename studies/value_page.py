"""The page of the study `value`: delay over limits of perception, and where it gets worse.

Each grid has one axis of a limit (a rate, a latency, a share of vehicles or junctions), its last
one beside the controllers. All differences are paired by seed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import polars as pl

from studies.control_study import paired
from studies.page.model import Cell, Column, Page, Section, Table
from studies.study_page import plain_page
from studies.study_tables import StudyResults, label_of

CONTROLLER = "controller"
_STUDIED, _OTHER = "predictive", "max pressure"
LESS_IS_MORE = "latency"  # begins the name of an axis of which the least is the best
SUFFERS_SHARE = 0.05  # more delay than with the best, from which on it suffers


def value_page(findings: StudyResults, sections: Sequence[Section] = ()) -> Page:
    """Returns where delay gets worse, the paired controllers, and all of a plain page."""
    grids = [grid.name for grid in findings.study.grids]
    found = [
        Section(title, tuple(table for name in grids if (table := of(findings, name)) is not None))
        for title, of in (
            ("Where delay begins to suffer", _suffering),
            (f"{_STUDIED} against {_OTHER}, seed by seed", _pairs),
        )
    ]
    return plain_page(findings, (*(part for part in found if part.blocks), *sections))


def _suffering(findings: StudyResults, grid: str) -> Table | None:
    """Returns a line for each curve: its delay with the best, and the first point that is worse."""
    part = findings.frame.filter((pl.col("grid") == grid) & pl.col("delay_s").is_not_null())
    axes = findings.axes(grid)
    given = next((axis for axis in reversed(axes) if axis != CONTROLLER), None)
    if given is None:
        return None
    others = [axis for axis in axes if axis != given]
    rows: list[tuple[Cell, ...]] = []
    for key, curve in part.group_by(others, maintain_order=True):
        delays_s = {
            value: dict(point.select("seed", "delay_s").iter_rows())
            for (value,), point in curve.group_by([given], maintain_order=True)
        }
        best_first = list(delays_s) if given.startswith(LESS_IS_MORE) else list(delays_s)[::-1]
        best, *rest = best_first
        steps = ((value, _more(delays_s[value], delays_s[best])) for value in rest)
        worse = next(((value, one) for value, one in steps if one is not None), None)
        mean_s = sum(delays_s[best].values()) / len(delays_s[best])
        cells = (None, None) if worse is None else (label_of(worse[0]), worse[1])
        rows.append((*map(label_of, key), label_of(best), round(mean_s, 2), *cells))
    if not rows:
        return None
    heads = (f"best {given}", "delay there, s", f"suffers from {given}", "by, s")
    caption = (
        f"{grid}: the first {given}, from the best on, at which delay is more than "
        f"{100 * SUFFERS_SHARE:g} % above that with the best, and by more than half the width of "
        "the 95 % interval of the difference. Empty: none was tried at which it is."
    )
    return Table(tuple(map(Column, (*others, *heads))), tuple(rows), caption)


def _more(delays_s: Mapping[int, float], best_s: Mapping[int, float]) -> str | None:
    """Returns by how much a point's delays, by seed, are above those of the best; None if not."""
    seeds = sorted(set(delays_s) & set(best_s))
    if not seeds:
        return None
    found = paired([delays_s[seed] for seed in seeds], [best_s[seed] for seed in seeds])
    mean_s = sum(best_s[seed] for seed in seeds) / len(seeds)
    if found.mean <= max(SUFFERS_SHARE * mean_s, found.half or 0.0):
        return None
    half = "" if found.half is None else f" ± {found.half:.2f}"
    return f"{found.mean:.2f}{half}"


def _pairs(findings: StudyResults, grid: str) -> Table | None:
    """Returns a line for each point of a grid that both controllers have driven."""
    axes = [axis for axis in findings.axes(grid) if axis != CONTROLLER]
    if CONTROLLER not in findings.axes(grid) or not axes:
        return None
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
