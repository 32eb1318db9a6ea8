"""The junction from above: lanes, counts, clouds, boxes."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection

from perception.arrays import Floats
from protocol.roadmap import Lane, RoadMap
from studies import palette
from studies.outlines import borders, footprints, resampled, stands_out
from studies.snapshot import Boxes, Snapshot

_REACH_M = 58.0
_VERGE_M = 13.0
_LABEL_INSET_M = 4.0


def draw_plan(axes: Axes, snapshot: Snapshot, colours: dict[str, str], aspect: float) -> None:
    """Draws the junction and its arms; `aspect` is the picture's width over its height."""
    low, high = _window(snapshot.road_map, aspect)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    _draw_road(axes, snapshot.road_map)
    for cloud in snapshot.clouds:
        inside = ((cloud.points[:, :2] > low) & (cloud.points[:, :2] < high)).all(axis=1)
        _draw_points(axes, cloud.points[inside], colours[cloud.agent])
    _draw_truth(axes, snapshot.truth)
    _draw_boxes(axes, snapshot.detections, colours)
    _draw_signal(axes, snapshot)
    _draw_sensors(axes, snapshot, colours)
    _draw_counts(axes, snapshot, low, high)


def _window(road_map: RoadMap, aspect: float) -> tuple[Floats, Floats]:
    """Returns the corners of the smallest picture with all road near the centre, and a verge."""
    points = np.concatenate([resampled(lane.points[:, :2]) for lane in road_map.lanes])
    centre = np.array(road_map.centre[:2])
    near = points[np.abs(points - centre).max(axis=1) <= _REACH_M]
    near = near if len(near) else centre[None]
    low, high = near.min(axis=0) - _VERGE_M, near.max(axis=0) + _VERGE_M
    # towards an arm the picture ends with the reach, so that no verge is needed there
    low, high = np.maximum(low, centre - _REACH_M), np.minimum(high, centre + _REACH_M)
    width, height = high - low
    half = np.array([max(width, height * aspect), max(height, width / aspect)]) / 2
    middle = (low + high) / 2
    return middle - half, middle + half


def _draw_road(axes: Axes, road_map: RoadMap) -> None:
    sides = [borders(lane) for lane in road_map.lanes]
    surfaces = [np.concatenate([left, right[::-1]])[:, :2] for left, right in sides]
    if len(road_map.junction) > 2:
        surfaces.append(np.array(road_map.junction))
    axes.add_collection(PolyCollection(surfaces, facecolors=palette.ASPHALT, zorder=1))
    lines = [
        side[:, :2]
        for lane, both in zip(road_map.lanes, sides, strict=True)
        if not lane.internal
        for side in both
    ]
    axes.add_collection(LineCollection(lines, colors=palette.MARKING, linewidths=0.6, zorder=2))


def _draw_points(axes: Axes, points: Floats, colour: str) -> None:
    high = stands_out(points)
    for part, size, alpha in ((~high, 0.45, 0.25), (high, 1.0, 0.75)):
        x, y = points[part, :2].T
        axes.scatter(x, y, s=size, color=colour, alpha=alpha, linewidths=0, zorder=3)


def _draw_truth(axes: Axes, truth: Boxes) -> None:
    outlines = PolyCollection(
        list(footprints(truth.values)),
        facecolors="none",
        edgecolors=palette.TRUTH,
        linewidths=0.8,
        linestyles=[(0, (2, 1.5))],
        zorder=6,
    )
    axes.add_collection(outlines)


def _draw_boxes(axes: Axes, boxes: Boxes, colours: dict[str, str]) -> None:
    shapes = list(footprints(boxes.values))
    edges = [colours.get(source, palette.BOX) for source in boxes.sources]
    filled = PolyCollection(shapes, facecolors=edges, edgecolors="none", alpha=0.16, zorder=5)
    drawn = PolyCollection(shapes, facecolors="none", edgecolors=edges, linewidths=1.5, zorder=7)
    axes.add_collection(filled)
    axes.add_collection(drawn)


def _draw_signal(axes: Axes, snapshot: Snapshot) -> None:
    """Draws each stop bar in the colour that its lane is shown; green if any of its links is."""
    road = snapshot.road_map
    for name in road.incoming:
        if name in road.by_id:
            left, right = (side[-1, :2] for side in borders(road.by_id[name]))
            ends = np.array([left + 0.12 * (right - left), right + 0.12 * (left - right)])
            colour = palette.SIGNAL.get(_letter(snapshot, name), palette.FAINT)
            axes.plot(*ends.T, color=colour, lw=4, solid_capstyle="butt", zorder=8)


def _letter(snapshot: Snapshot, lane: str) -> str:
    links = [link.index for link in snapshot.road_map.signal.links if link.from_lane == lane]
    letters = [snapshot.shown[index] for index in links if index < len(snapshot.shown)]
    return min(letters, key="Ggyr".find, default="")


def _draw_sensors(axes: Axes, snapshot: Snapshot, colours: dict[str, str]) -> None:
    for cloud in snapshot.clouds:
        x, y = cloud.sensor_m[:2]
        for size, alpha in ((190, 0.25), (40, 1.0)):
            axes.scatter(
                x, y, s=size, color=colours[cloud.agent], alpha=alpha, linewidths=0, zorder=9
            )


def _draw_counts(axes: Axes, snapshot: Snapshot, low: Floats, high: Floats) -> None:
    """Writes each lane's count where the lane enters or leaves the picture."""
    for (name, side), count in snapshot.counts.items():
        if name in snapshot.road_map.by_id:
            upstream = side == "upstream"
            place = _label_place(snapshot.road_map.by_id[name], low, high, upstream)
            axes.annotate(
                str(count),
                (float(place[0]), float(place[1])),
                color=palette.TEXT if upstream else palette.FAINT,
                fontsize=9,
                fontweight="bold" if upstream else "normal",
                ha="center",
                va="center",
                zorder=11,
                annotation_clip=True,
                bbox={
                    "boxstyle": "round,pad=0.22",
                    "facecolor": palette.BACKGROUND,
                    "edgecolor": palette.MARKING,
                    "linewidth": 0.7,
                    "alpha": 0.85,
                },
            )


def _label_place(lane: Lane, low: Floats, high: Floats, upstream: bool) -> Floats:
    points = resampled(lane.points[:, :2] if upstream else lane.points[::-1, :2])
    inside = ((points > low + _LABEL_INSET_M) & (points < high - _LABEL_INSET_M)).all(axis=1)
    place: Floats = points[int(np.argmax(inside))] if inside.any() else points[-1]
    return place
