"""Maps of a view: clouds, detections before and after fusion, boxes over the truth."""

from __future__ import annotations

import numpy as np

from perception.arrays import Bools, Floats, Floats32
from studies import palette
from studies.accuracy.view import View
from studies.outlines import footprints, ring, road_rings, stands_out
from studies.page.model import MapChart, Outlines, Points

SHOWN_POINTS = 3000
_POINT_SIZE = 3.0


def cloud_maps(view: View) -> tuple[MapChart, MapChart]:
    """Returns the cloud of the first agent, and all agents' clouds by agent."""
    first = next(iter(view.clouds))
    count = sum(len(points) for points in view.clouds.values())
    single = f"Cloud of one scan, {first}"
    merged = f"Merged cloud of {len(view.clouds)} scans"
    return (
        _map(view, single, points=_clouds(view, [first]), notes=_points(len(view.clouds[first]))),
        _map(view, merged, points=_clouds(view, list(view.clouds)), notes=_points(count)),
    )


def fusion_maps(view: View) -> tuple[MapChart, MapChart]:
    """Returns the detections of each scan by agent, and what is left without duplicates."""
    colours = _colours(view)
    before = [_outlines(name, boxes, colours[name]) for name, boxes in view.singles.items()]
    count = sum(len(boxes) for boxes in view.singles.values())
    after = [_outlines("detected", view.fused, palette.PLAIN)]
    return (
        _map(
            view, "Detections before fusion", outlines=before,
            notes=f"{count} detections of {len(before)} scans, one box over another where several "
            "scans show a vehicle.",
        ),
        _map(
            view, "Detections after fusion", outlines=after,
            notes=f"{len(view.fused)} detections, duplicates removed.",
        ),
    )  # fmt: skip


def truth_map(view: View) -> MapChart:
    """Returns boxes found in the merged cloud over the vehicles."""
    true, found = view.matched()
    missed, hidden = view.visible & ~found, ~view.visible & ~found
    outlines = [
        _outlines("vehicle with too few points", view.vehicles[hidden], palette.QUIET),
        _outlines("vehicle, found", view.vehicles[found], palette.GOOD),
        _outlines("vehicle, visible but missed", view.vehicles[missed], palette.BAD),
        _outlines("detected", view.merged, palette.INK),
    ]
    points = [
        _crosses("missed", view.vehicles[missed], palette.BAD),
        _crosses("false detection", view.merged[~true], palette.INK),
    ]
    of_visible = int((found & view.visible).sum())
    notes = (
        f"Visible vehicles found: {of_visible} of {int(view.visible.sum())}; vehicles in all: "
        f"{len(view.vehicles)}. Boxes: {len(view.merged)}, of them false, second ones of a vehicle "
        f"included: {int((~true).sum())}."
    )
    return _map(
        view, "Detected boxes over true boxes",
        outlines=[one for one in outlines if one.rings],
        points=[one for one in points if one.x_m],
        notes=notes,
    )  # fmt: skip


def _map(
    view: View,
    title: str,
    *,
    points: list[Points] | None = None,
    outlines: list[Outlines] | None = None,
    notes: str,
) -> MapChart:
    surfaces, lines = road_rings(view.road_map)
    return MapChart(
        title, surfaces, lines, tuple(points or ()), tuple(outlines or ()), view.window, notes
    )


def _colours(view: View) -> dict[str, str]:
    return {a: palette.SERIES[n % len(palette.SERIES)] for n, a in enumerate(view.clouds)}


def _clouds(view: View, agents: list[str]) -> list[Points]:
    """Returns clouds without the ground, thinned together to about `SHOWN_POINTS`."""
    colours = _colours(view)
    clouds = {name: _standing(view.clouds[name]) for name in agents}
    total = sum(len(points) for points in clouds.values())
    share = min(1.0, SHOWN_POINTS / max(total, 1))
    return [_cloud(name, _thinned(cloud, share), colours[name]) for name, cloud in clouds.items()]


def _standing(points: Floats32) -> Floats:
    cloud = points.astype(np.float64)
    chosen: Bools = stands_out(cloud)
    return cloud[chosen]


def _thinned(points: Floats, share: float) -> Floats:
    """Returns a share of points, evenly drawn, always the same ones."""
    count = round(share * len(points))
    chosen = np.random.default_rng(0).choice(len(points), count, replace=False)
    return points[np.sort(chosen)]


def _cloud(name: str, points: Floats, colour: str) -> Points:
    x_m, y_m = (tuple(column.tolist()) for column in points[:, :2].round(2).T)
    return Points(name, x_m, y_m, _POINT_SIZE, "disc", colour)


def _crosses(name: str, boxes: Floats, colour: str) -> Points:
    x_m, y_m = (tuple(column.tolist()) for column in boxes[:, :2].round(2).T)
    return Points(name, x_m, y_m, 7.0, "cross", colour)


def _outlines(name: str, boxes: Floats, colour: str) -> Outlines:
    return Outlines(name, tuple(ring(corners) for corners in footprints(boxes)), colour)


def _points(count: int) -> str:
    return f"{count:,} points on the road here; drawn is a sample of those above the ground."
