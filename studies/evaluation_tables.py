"""Tables of `cpnet eval`: AP40 by view and by class, recall by distance and by points."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from studies.average_precision import View
from studies.bench import empty_table
from studies.evaluate import BY_DISTANCE, BY_POINTS, EVERYTHING, IOUS, VEHICLE, VIEWS, EvalRow

PAPER: dict[tuple[str, View], dict[float, float]] = {
    ("DBSCAN", "bev"): {0.01: 23.3, 0.1: 15.2},
    ("DBSCAN", "3d"): {0.01: 16.7, 0.1: 7.8},
    ("PointPillars", "bev"): {0.01: 84.9, 0.1: 84.8},
    ("PointPillars", "3d"): {0.01: 84.9, 0.1: 84.8},
}
"""AP40 in Table 1 of Chen et al. 2022, in CARLA."""

_BLANK = "–"
_PART_IOU = 0.1
_NAMES = {"bev": "seen from above (BEV)", "3d": "as volumes (3D)"}
_CLOUD_NAMES = {"none": "single", "early": "merged", "late": "late"}


def print_evaluation(rows: list[EvalRow], console: Console) -> None:
    """Prints AP40 by view and by class, then recall by distance and by points."""
    vehicles = [row for row in rows if row.objects == VEHICLE]
    whole = [row for row in vehicles if row.part == EVERYTHING]
    for view in VIEWS:
        for geofence in (True, False):
            here = [row for row in whole if row.view == view and row.geofence == geofence]
            console.print(_view_table(view, here, geofence=geofence))
    console.print(_class_table(rows))
    console.print(_part_table(vehicles))
    console.print(
        "merged: detection in all points together (early fusion); late: in each scan alone, "
        "duplicates removed. Recall, precision and ms (the median of a cloud) "
        f"at IoU {_PART_IOU:g}. visible: vehicles with 5 points or more.",
        style="dim",
    )


def print_kitti(rows: list[EvalRow], console: Console) -> None:
    """Prints AP40 by object and level of difficulty, of files with labels in KITTI's form.

    Levels are left out where labels have no difficulty.
    """
    seen = [row for row in rows if row.truth == "visible"]
    for detector in dict.fromkeys(row.detector for row in seen):
        for view in VIEWS:
            here = [row for row in seen if row.detector == detector and row.view == view]
            console.print(_kitti_table(here, f"{detector}: AP40 by IoU, boxes {_NAMES[view]}"))
    console.print(
        f"{rows[0].scenes if rows else 0} frames. Labels with 5 points or more; recall and "
        f"precision at IoU {_PART_IOU:g}. Levels are KITTI's.",
        style="dim",
    )


def _kitti_table(rows: list[EvalRow], title: str) -> Table:
    heads = ["objects", "level", "number", *(f"{iou:g}" for iou in _CLASS_IOUS), "recall", "prec"]
    table = empty_table(heads, title=title, left=2)
    cells = {(row.objects, row.part, row.iou): row for row in rows}
    for objects, part in dict.fromkeys(key[:2] for key in cells):
        at, whole = cells[objects, part, _PART_IOU], cells[objects, EVERYTHING, _PART_IOU]
        is_told = part == EVERYTHING or at.vehicles != whole.vehicles
        if is_told and (at.vehicles or at.precision is not None):
            figures = [_percent(cells[objects, part, iou].ap40) for iou in _CLASS_IOUS]
            shares = [_percent(at.recall), _percent(at.precision)]
            table.add_row(objects, part, str(at.vehicles), *figures, *shares)
    return table


def _view_table(view: View, rows: list[EvalRow], *, geofence: bool) -> Table:
    ious = [f"{iou:g}" for iou in IOUS]
    heads = ["detector", "cloud", "truth", *ious, "recall", "prec", "ms"]
    fence = "with" if geofence else "without"
    table = empty_table(
        heads,
        title=f"AP40 by IoU, boxes {_NAMES[view]}, {fence} geofence",
        left=3,
        padding=(0, 0),
    )
    for key, cells in _lines(rows).items():
        at = cells[_PART_IOU]
        figures = [_percent(cells[iou].ap40) for iou in IOUS]
        figures += [_percent(at.recall), _percent(at.precision), f"{at.detect_ms:.0f}"]
        table.add_row(*key, *figures)
    table.add_section()
    for (name, of), values in PAPER.items():
        if of == view:
            figures = [f"{values[iou]:.1f}" if iou in values else _BLANK for iou in IOUS]
            table.add_row(f"Chen {name}", "merged", "visible", *figures, *[_BLANK] * 3)
    return table


def _class_table(rows: list[EvalRow]) -> Table:
    """AP40 by class with geofence, seen from above, of what is visible."""
    chosen = [
        row
        for row in rows
        if row.geofence and row.view == "bev" and row.truth == "visible"
        and row.part == EVERYTHING and row.vehicles and row.iou in _CLASS_IOUS
    ]  # fmt: skip
    lines: dict[tuple[str, str, str], dict[float, EvalRow]] = {}
    for row in chosen:
        key = row.detector, _CLOUD_NAMES[row.fusion], row.objects
        lines.setdefault(key, {})[row.iou] = row
    title = "AP40 by class, 95 % interval over networks; BEV, with geofence, visible"
    heads = ["detector", "cloud", "objects", "number", *(f"{iou:g}" for iou in _CLASS_IOUS)]
    table = empty_table([*heads, "recall", "prec"], title=title, left=3, padding=(0, 0))
    for key, cells in lines.items():
        at = cells[_PART_IOU]
        figures = [_with_half(cells[iou]) for iou in _CLASS_IOUS]
        table.add_row(*key, str(at.vehicles), *figures, _percent(at.recall), _percent(at.precision))
    return table


_CLASS_IOUS = (0.1, 0.5, 0.7)


def _with_half(row: EvalRow) -> str:
    half = "" if row.ap40_half is None else f"±{100 * row.ap40_half:.1f}"
    return f"{_percent(row.ap40)}{half}"


def _part_table(rows: list[EvalRow]) -> Table:
    """Recall with geofence, seen from above."""
    names = [part.name for part in (*BY_DISTANCE, *BY_POINTS)]
    chosen = [
        row
        for row in rows
        if row.geofence and row.view == "bev" and row.iou == _PART_IOU and row.part in names
    ]
    title = f"recall with geofence, BEV, IoU {_PART_IOU:g}, by distance (visible) and points"
    heads = [part.name for part in BY_DISTANCE] + [part.name.split()[0] for part in BY_POINTS]
    table = empty_table(["detector", "cloud", *heads], title=title, left=2, padding=(0, 0))
    lines: dict[tuple[str, str], dict[str, EvalRow]] = {}
    for row in chosen:
        lines.setdefault((row.detector, _CLOUD_NAMES[row.fusion]), {})[row.part] = row
    for key, cells in lines.items():
        table.add_row(*key, *[_percent(cells[name].recall) for name in names])
    return table


def _lines(rows: list[EvalRow]) -> dict[tuple[str, str, str], dict[float, EvalRow]]:
    lines: dict[tuple[str, str, str], dict[float, EvalRow]] = {}
    for row in rows:
        key = (row.detector, _CLOUD_NAMES[row.fusion], row.truth)
        lines.setdefault(key, {})[row.iou] = row
    return lines


def _percent(share: float | None) -> str:
    """Returns at most four characters, so that a line keeps within 80."""
    return _BLANK if share is None else f"{100 * share:.1f}".replace("100.0", "100")
