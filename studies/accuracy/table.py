"""Table 1 of Chen et al. 2022, ours beside the paper's."""

from __future__ import annotations

from studies.average_precision import View
from studies.ecvpr import VISIBLE_POINTS
from studies.evaluate import EVERYTHING, VIEWS, EvalRow, Truth
from studies.evaluate_table import PAPER
from studies.page.model import Cell, Column, Section, Table, Text

SHOWN_IOUS = (0.01, 0.1, 0.5)
_CLOUDS = {"none": "one scan", "early": "merged", "late": "each scan, then fused"}
_TRUTHS: dict[Truth, str] = {"visible": "visible", "all": "all"}
_VIEW_NAMES: dict[View, str] = {"bev": "BEV", "3d": "3D"}
_COLUMNS = (
    Column("detector"),
    Column("cloud"),
    Column("vehicles"),
    *(Column(f"{_VIEW_NAMES[view]} {iou:g}", ".1f") for view in VIEWS for iou in SHOWN_IOUS),
)


def accuracy_section(rows: list[EvalRow]) -> Section:
    """Returns AP40 with and without geofence, the paper's figures first."""
    title = "Table 1: average precision"
    whole = [row for row in rows if row.part == EVERYTHING and row.iou in SHOWN_IOUS]
    if not whole:
        return Section(title, (Text("No sample had a scan, so that there is nothing to rank."),))
    tables = (
        _table(whole, geofence=False, caption="Without geofence, as in the paper: AP40, %"),
        _table(whole, geofence=True, caption="With geofence, as the edge works: AP40, %"),
    )
    return Section(title, (Text(_said(whole)), *tables))


def _table(rows: list[EvalRow], *, geofence: bool, caption: str) -> Table:
    lines: dict[tuple[str, str, str], dict[tuple[View, float], float | None]] = {}
    for row in rows:
        if row.geofence == geofence:
            key = (row.detector, _CLOUDS[row.fusion], _TRUTHS[row.truth])
            lines.setdefault(key, {})[row.view, row.iou] = row.ap40
    order = {truth: place for place, truth in enumerate(_TRUTHS.values())}
    own = sorted(lines.items(), key=lambda line: order[line[0][2]])
    ours = tuple((*key, *_figures(cells, 100.0)) for key, cells in own)
    return Table(_COLUMNS, (*_paper_rows(geofence=geofence), *ours), caption)


def _paper_rows(*, geofence: bool) -> tuple[tuple[Cell, ...], ...]:
    """Returns the paper's figures; beside ours with geofence, they say that they have none."""
    note = ", no geofence" if geofence else ""
    names = dict.fromkeys(name for name, _ in PAPER)
    return tuple(
        (
            f"{name}, Chen et al.{note}",
            "merged",
            "visible",
            *_figures({(v, i): a for v in VIEWS for i, a in PAPER[name, v].items()}, 1.0),
        )
        for name in names
    )


def _figures(cells: dict[tuple[View, float], float | None], factor: float) -> tuple[Cell, ...]:
    """Returns AP40 in percent in the order of the columns."""
    found = [cells.get((view, iou)) for view in VIEWS for iou in SHOWN_IOUS]
    return tuple(None if one is None else round(factor * one, 2) for one in found)


def _said(rows: list[EvalRow]) -> str:
    """Returns what the figures are of, and what the paper's differ in."""
    scenes = {row.fusion: row.scenes for row in rows}
    of = {row.truth: row.vehicles for row in rows if row.fusion == "early" and not row.geofence}
    return (
        f"{scenes['early']} samples with {scenes['none']} scans, some seconds apart, each scan one "
        "revolution of a tenth of a second, as at 10 Hz: those of the posts and of up to five CAVs "
        "near the junction, drawn anew each time. Of "
        f"{of['all']} vehicles within 80 m of the junction's centre {of['visible']} are visible: "
        f"{VISIBLE_POINTS} points or more lie on them, of all scans together. A column is the IoU "
        "above which a box counts, from above (BEV) or as a volume (3D). The paper's clouds come "
        "from CARLA and were not geofenced; ours come from this LiDAR model, at this junction."
    )
