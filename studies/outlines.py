"""Outlines in the map frame, for drawing: boxes, lane borders, the road's surface."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt

from perception.arrays import Floats
from protocol.roadmap import Lane, RoadMap
from studies.page.model import Ring

_CORNERS = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)]) / 2
GROUND_BAND_M = 0.35
_CELL_M = 1.5


def footprints(boxes: Floats) -> Floats:
    """Returns the corners (N, 4, 2) of boxes (N, 7); the first and the last are the front."""
    cos, sin = np.cos(boxes[:, 6, None]), np.sin(boxes[:, 6, None])
    along, across = _CORNERS[:, 0] * boxes[:, 3, None], _CORNERS[:, 1] * boxes[:, 4, None]
    x = boxes[:, 0, None] + along * cos - across * sin
    y = boxes[:, 1, None] + along * sin + across * cos
    return np.stack([x, y], -1)


def borders(lane: Lane) -> tuple[Floats, Floats]:
    """Returns a lane's left and right border, each (K, 3) in driving direction."""
    points = lane.points
    heading = np.gradient(points[:, :2], axis=0)
    heading /= np.maximum(np.linalg.norm(heading, axis=1, keepdims=True), 1e-9)
    left = np.column_stack([-heading[:, 1], heading[:, 0], np.zeros(len(points))])
    return points + left * lane.width_m / 2, points - left * lane.width_m / 2


def resampled(points: Floats, step_m: float = 1.0) -> Floats:
    """Returns a line (K, 2 or 3) with points at about every step, its ends included."""
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    at = np.concatenate([[0.0], np.cumsum(lengths)])
    steps = np.linspace(0, at[-1], max(2, int(at[-1] / step_m)))
    return np.column_stack([np.interp(steps, at, column) for column in points.T])


def stands_out(points: Floats) -> npt.NDArray[np.bool_]:
    """Marks the points (N, 3) that are clearly above the lowest one nearby: objects, not ground."""
    if not len(points):
        return np.zeros(0, np.bool_)
    cells = np.floor((points[:, :2] - points[:, :2].min(axis=0)) / _CELL_M).astype(np.int64)
    keys = cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1]
    _, cell = np.unique(keys, return_inverse=True)
    lowest = np.full(cell.max() + 1, np.inf)
    np.minimum.at(lowest, cell, points[:, 2])
    above: npt.NDArray[np.bool_] = points[:, 2] > lowest[cell] + GROUND_BAND_M
    return above


def view_azimuth(road_map: RoadMap) -> float:
    """Returns the azimuth of the view, in rad: towards the arms, so that a T's stem leads away."""
    centre = np.array(road_map.centre[:2])
    ends = [
        road_map.by_id[n].points[0, :2] - centre for n in road_map.incoming if n in road_map.by_id
    ]
    edges = {tuple(np.round(end / max(np.linalg.norm(end), 1e-9), 1)) for end in ends}
    x, y = np.sum([*edges, (0.0, 0.02)], axis=0)
    return float(np.arctan2(y, x))


def road_rings(road_map: RoadMap) -> tuple[tuple[Ring, ...], tuple[Ring, ...]]:
    """Returns the surfaces of lanes and junction, and the lines between lanes."""
    sides = [(lane, *borders(lane)) for lane in road_map.lanes]
    surfaces = [ring([*left, *right[::-1]]) for _, left, right in sides]
    surfaces += [ring(one.outline) for one in road_map.intersections if len(one.outline) > 2]
    lines = [
        ring(side) for lane, left, right in sides if not lane.internal for side in (left, right)
    ]
    return tuple(surfaces), tuple(lines)


def ring(points: Iterable[Sequence[float]]) -> Ring:
    """Returns points (N, 2 or more) as x, y in m, to the centimetre."""
    return tuple((round(float(p[0]), 2), round(float(p[1]), 2)) for p in points)
