"""The road's area: how far a place is from it, and the edges along which things stand."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from numba import njit

from protocol.geometry import Floats
from protocol.roadmap import Lane, RoadMap
from sensing.mesh import signed_area_m2

EDGE_STEP_M = 3.0
_PROBE_M = 0.2  # a place this far outside an edge decides whether the road ends there


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """A stretch of the road's border: points (K, 2) and unit vectors (K, 2) away from the road."""

    points: Floats
    outward: Floats


class RoadArea:
    """All lanes and the junction, as an area of the plane."""

    def __init__(self, road_map: RoadMap) -> None:
        self._strips = np.concatenate([_strips(lane) for lane in road_map.lanes])
        outline = road_map.intersections[0].outline
        self._junction = np.array(outline, np.float64).reshape(-1, 2)
        self._lanes = road_map.lanes

    def clearance_m(self, xy: npt.ArrayLike) -> Floats:
        """Returns how far places (N, 2) are from the road; 0 or less upon it."""
        places = np.ascontiguousarray(np.asarray(xy, np.float64).reshape(-1, 2))
        result = np.empty(len(places))
        _clearances(places, self._strips, self._junction, result)
        return result

    def edges(self) -> list[Edge]:
        """Returns the road's borders, cut where other lanes or the junction join."""
        found: list[Edge] = []
        for lane in self._lanes:
            line = resample(lane.points[:, :2], EDGE_STEP_M)
            left = _left_normals(line)
            for outward in (left, -left):
                found += self._outer(line + outward * (lane.width_m / 2), outward)
        if len(self._junction) >= 3:
            found += self._around_junction()
        return found

    def _around_junction(self) -> list[Edge]:
        ring = np.vstack([self._junction, self._junction[:1]])
        line = resample(ring, EDGE_STEP_M / 2)
        outward = _left_normals(line)
        if signed_area_m2(self._junction) > 0:  # counter-clockwise: left is inside
            outward = -outward
        return self._outer(line, outward)

    def _outer(self, points: Floats, outward: Floats) -> list[Edge]:
        inside_m = np.maximum(-self.clearance_m(points), 0.0)
        free = (self.clearance_m(points + outward * _PROBE_M) > 0) & (inside_m < _PROBE_M)
        points = points + outward * inside_m[:, None]  # at bends, where the offset falls short
        cuts = np.flatnonzero(np.diff(np.concatenate([[False], free, [False]]).astype(np.int8)))
        return [
            Edge(points[start:end], outward[start:end])
            for start, end in cuts.reshape(-1, 2)
            if end - start >= 2
        ]


def resample(line: Floats, step_m: float) -> Floats:
    """Returns points on a polyline (K, 2), at most `step_m` apart, its bends kept."""
    parts = [line[:1]]
    for a, b in pairwise(line):
        pieces = max(1, int(np.ceil(np.hypot(*(b - a)) / step_m)))
        share = np.arange(1, pieces + 1)[:, None] / pieces
        parts.append(a + (b - a) * share)
    points = np.concatenate(parts)
    moved = np.concatenate([[True], np.hypot(*np.diff(points, axis=0).T) > 1e-6])
    return np.asarray(points[moved])


def _strips(lane: Lane) -> Floats:
    line = lane.points[:, :2]
    half = np.full((len(line) - 1, 1), lane.width_m / 2)
    return np.hstack([line[:-1], line[1:], half])


def _left_normals(line: Floats) -> Floats:
    if len(line) < 2:
        return np.zeros_like(line)
    along = np.gradient(line, axis=0)
    along /= np.maximum(np.hypot(along[:, 0], along[:, 1]), 1e-9)[:, None]
    return np.column_stack([-along[:, 1], along[:, 0]])


@njit(
    "void(Array(float64, 2, 'C', readonly=True), float64[:,::1], float64[:,::1], float64[::1])",
    cache=True,
)
def _clearances(places: Floats, strips: Floats, junction: Floats, result: Floats) -> None:
    for n in range(len(places)):
        x, y = places[n, 0], places[n, 1]
        nearest = 1e9
        for s in range(len(strips)):
            ax, ay = strips[s, 0], strips[s, 1]
            ux, uy = strips[s, 2] - ax, strips[s, 3] - ay
            length2 = ux * ux + uy * uy
            t = 0.0
            if length2 > 0.0:
                t = min(1.0, max(0.0, ((x - ax) * ux + (y - ay) * uy) / length2))
            dx, dy = x - ax - t * ux, y - ay - t * uy
            nearest = min(nearest, np.sqrt(dx * dx + dy * dy) - strips[s, 4])
        inside = False
        corners = len(junction)
        for k in range(corners):
            x0, y0 = junction[k, 0], junction[k, 1]
            x1, y1 = junction[(k + 1) % corners, 0], junction[(k + 1) % corners, 1]
            if (y0 > y) != (y1 > y) and x < (x1 - x0) * (y - y0) / (y1 - y0) + x0:
                inside = not inside
        result[n] = min(nearest, 0.0) if inside else nearest
