"""The junction from above: lanes, counts, clouds, boxes."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.patheffects import withStroke

from protocol.roadmap import Lane
from studies import palette
from studies.shapes import Floats, borders, footprints, stands_out
from studies.snapshot import Boxes, Snapshot

_LABEL_INSET_M = 5.0
_BAR_M = 1.2


def draw_plan(axes: Axes, snapshot: Snapshot, colours: dict[str, str], half_m: float) -> None:
    """Draws everything within `half_m` of the junction's centre."""
    centre = np.array(snapshot.road_map.centre[:2])
    axes.set(
        xlim=(centre[0] - half_m, centre[0] + half_m),
        ylim=(centre[1] - half_m, centre[1] + half_m),
        aspect="equal",
        facecolor=palette.BACKGROUND,
    )
    axes.axis("off")
    _draw_road(axes, snapshot)
    for cloud in snapshot.clouds:
        near = np.abs(cloud.points[:, :2] - centre).max(axis=1) < half_m + 2
        _draw_points(axes, cloud.points[near], colours[cloud.agent])
    _draw_truth(axes, snapshot.truth)
    _draw_boxes(axes, snapshot.detections, colours)
    _draw_signal(axes, snapshot)
    _draw_sensors(axes, snapshot, colours)
    _draw_counts(axes, snapshot, centre, half_m)


def _draw_road(axes: Axes, snapshot: Snapshot) -> None:
    road = snapshot.road_map
    sides = [borders(lane) for lane in road.lanes]
    surfaces = [np.concatenate([left, right[::-1]])[:, :2] for left, right in sides]
    if len(road.junction) > 2:
        surfaces.append(np.array(road.junction))
    axes.add_collection(PolyCollection(surfaces, facecolors=palette.ASPHALT, zorder=1))
    lines = [
        side[:, :2]
        for lane, both in zip(road.lanes, sides, strict=True)
        if not lane.internal
        for side in both
    ]
    axes.add_collection(LineCollection(lines, colors=palette.MARKING, linewidths=0.6, zorder=2))


def _draw_points(axes: Axes, points: Floats, colour: str) -> None:
    high = stands_out(points)
    style = {"color": colour, "linewidths": 0, "marker": "o"}
    axes.scatter(*points[~high, :2].T, s=0.35, alpha=0.22, zorder=3, **style)
    axes.scatter(*points[high, :2].T, s=0.9, alpha=0.75, zorder=4, **style)


def _draw_truth(axes: Axes, truth: Boxes) -> None:
    outlines = PolyCollection(
        footprints(truth.values),
        facecolors="none",
        edgecolors=palette.TRUTH,
        linewidths=0.7,
        linestyles=(0, (2, 1.5)),
        alpha=0.75,
        zorder=6,
    )
    axes.add_collection(outlines)


def _draw_boxes(axes: Axes, boxes: Boxes, colours: dict[str, str]) -> None:
    shapes = footprints(boxes.values)
    edges = [colours.get(source, palette.BOX) for source in boxes.sources]
    axes.add_collection(
        PolyCollection(shapes, facecolors=edges, edgecolors="none", alpha=0.16, zorder=5)
    )
    axes.add_collection(
        PolyCollection(shapes, facecolors="none", edgecolors=edges, linewidths=1.5, zorder=7)
    )


def _draw_signal(axes: Axes, snapshot: Snapshot) -> None:
    """Draws each stop bar in the colour that its lane is shown; green if any of its links is."""
    road, shown = snapshot.road_map, snapshot.shown
    for name in road.incoming:
        letters = [
            shown[link.index]
            for link in road.signal.links
            if link.from_lane == name and link.index < len(shown)
        ]
        letter = min(letters, key="GgyrR".find, default="")
        if name in road.by_id:
            left, right = (side[-1, :2] for side in borders(road.by_id[name]))
            colour = palette.SIGNAL.get(letter, palette.FAINT)
            ends = np.array([left + 0.12 * (right - left), right + 0.12 * (left - right)])
            axes.plot(*ends.T, color=colour, lw=4, solid_capstyle="butt", zorder=8)


def _draw_sensors(axes: Axes, snapshot: Snapshot, colours: dict[str, str]) -> None:
    for cloud in snapshot.clouds:
        colour = colours[cloud.agent]
        x, y = cloud.sensor_m[:2]
        axes.scatter(x, y, s=170, color=colour, alpha=0.25, linewidths=0, zorder=9)
        axes.scatter(
            x, y, s=34, color=colour, edgecolors=palette.BACKGROUND, linewidths=1, zorder=10
        )


def _draw_counts(axes: Axes, snapshot: Snapshot, centre: Floats, half_m: float) -> None:
    road = snapshot.road_map
    sides = (("upstream", road.incoming, -1, "▸"), ("downstream", road.outgoing, 1, ""))
    for side, lanes, _, _ in sides:
        for name in lanes:
            count = snapshot.counts.get((name, side))
            if count is not None and name in road.by_id:
                place = _label_place(road.by_id[name], centre, half_m, side == "upstream")
                colour = palette.TEXT if side == "upstream" else palette.FAINT
                text = axes.text(*place, str(count), color=colour, ha="center", va="center")
                text.set(fontsize=9.5, fontweight="bold", zorder=11, clip_on=True)
                text.set_path_effects([withStroke(linewidth=3, foreground=palette.BACKGROUND)])


def _label_place(lane: Lane, centre: Floats, half_m: float, upstream: bool) -> Floats:
    """Returns where the lane enters or leaves the picture, a little inside."""
    points = lane.points[:, :2] if upstream else lane.points[::-1, :2]
    steps = np.linspace(0, 1, 400)
    at = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    fine = np.column_stack([np.interp(steps, at / at[-1], points[:, i]) for i in (0, 1)])
    inside = np.abs(fine - centre).max(axis=1) < half_m - _LABEL_INSET_M
    place: Floats = fine[int(np.argmax(inside))] if inside.any() else fine[-1]
    return place
