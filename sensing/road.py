"""The road's area: distance to it, and its edges, along which kerbs and buildings stand."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from numba import njit

from protocol.geometry import Floats
from protocol.roadmap import Lane, RoadMap
from sensing.limits import MAX_ROAD_CELLS
from sensing.mesh import signed_area_m2

EDGE_STEP_M = 3.0
_PROBE_M = 0.2  # a place this far outside an edge decides whether the road ends there


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """A stretch of the road's border.

    Points (K, 2), unit vectors (K, 2) away from the road, and the height of the lane (K,), m.
    """

    points: Floats
    outward: Floats
    level_m: Floats


class RoadArea:
    """All lanes and junctions, as an area of the plane."""

    def __init__(self, road_map: RoadMap) -> None:
        self._lanes = road_map.lanes
        self._outlines = _outlines(road_map)
        self._levels_m = [one.centre[2] for one in road_map.intersections]
        self._index = _Index.of(road_map.lanes, self._outlines)

    def clearance_m(self, xy: npt.ArrayLike, most_m: float = math.inf) -> Floats:
        """Returns the distance of places (N, 2) from the road; 0 or less on it.

        A place farther away than `most_m` has any number above it: such a search ends early.
        """
        places = np.ascontiguousarray(np.asarray(xy, np.float64).reshape(-1, 2))
        result = np.empty(len(places))
        index = self._index
        grid = index.frame, index.shape
        _clearances(places, grid, index.strips, index.outlines, most_m, result)
        return result

    def edges(self) -> list[Edge]:
        """Returns the road's borders, cut where other lanes or a junction join."""
        found: list[Edge] = []
        for lane in self._lanes:
            line = resample(lane.points[:, :2], EDGE_STEP_M)
            left, level_m = _left_normals(line), heights_along(line, lane.points)
            for outward in (left, -left):
                found += self._outer(line + outward * (lane.width_m / 2), outward, level_m)
        for outline, level in zip(self._outlines, self._levels_m, strict=True):
            if len(outline) >= 3:
                found += self._around(outline, level)
        return found

    def _around(self, outline: Floats, level_m: float) -> list[Edge]:
        line = resample(np.vstack([outline, outline[:1]]), EDGE_STEP_M / 2)
        outward = _left_normals(line)
        if signed_area_m2(outline) > 0:  # counter-clockwise: left is inside
            outward = -outward
        return self._outer(line, outward, np.full(len(line), level_m))

    def _outer(self, points: Floats, outward: Floats, level_m: Floats) -> list[Edge]:
        inside_m = np.maximum(-self.clearance_m(points), 0.0)
        free = (self.clearance_m(points + outward * _PROBE_M) > 0) & (inside_m < _PROBE_M)
        points = points + outward * inside_m[:, None]  # at bends, where the offset falls short
        cuts = np.flatnonzero(np.diff(np.concatenate([[False], free, [False]]).astype(np.int8)))
        return [
            Edge(points[start:end], outward[start:end], level_m[start:end])
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


def heights_along(flat: Floats, line: Floats) -> Floats:
    """Returns the heights (N,) at points (N, 2) that were resampled from a polyline (K, 3)."""
    along_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line[:, :2], axis=0).T))])
    here = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(flat, axis=0).T))])
    return np.asarray(np.interp(here, along_m, line[:, 2]))


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


def _outlines(road_map: RoadMap) -> list[Floats]:
    """Returns the outline (K, 2) of each intersection."""
    return [np.array(one.outline, np.float64).reshape(-1, 2) for one in road_map.intersections]


_CELL_M = 16.0
_SLACK_M = 1e-3  # of boxes and bounds, far above rounding

_Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class _Index:
    """The lanes' strips and the junctions' outlines, each listed in the grid cells it touches.

    A cell's members are `members[starts[cell] : starts[cell + 1]]`; cells count along x first.

    Attributes:
        frame: x, y of the grid's corner, the cells' size, what to subtract from a distance to a
            strip's middle for a lower bound of the distance to its edge (4,), all m.
        shape: columns and rows (2,).
        strips: x, y of both ends and half the width (S, 5), then starts and members.
        outlines: all corners (C, 2), each outline's first corner (J + 1,), starts and members.
    """

    frame: Floats
    shape: _Ints
    strips: tuple[Floats, _Ints, _Ints]
    outlines: tuple[Floats, _Ints, _Ints, _Ints]

    @classmethod
    def of(cls, lanes: Sequence[Lane], outlines: Sequence[Floats]) -> _Index:
        """Builds the index; its cells grow on a map too large for it."""
        strips = np.concatenate([_strips(lane) for lane in lanes])
        corners = np.concatenate([np.empty((0, 2)), *outlines])
        everything = np.concatenate([*(lane.points[:, :2] for lane in lanes), corners])
        low, high = everything.min(axis=0) - _SLACK_M, everything.max(axis=0) + _SLACK_M
        cell_m = _CELL_M
        while np.prod((high - low) / cell_m + 1) > MAX_ROAD_CELLS:
            cell_m *= 2
        frame = np.array([*low, cell_m, strips[:, 4].max(initial=0.0) + _SLACK_M])
        shape = np.floor((high - low) / cell_m).astype(np.int64) + 1
        first = np.cumsum([0, *(len(outline) for outline in outlines)], dtype=np.int64)
        kept = [k for k, outline in enumerate(outlines) if len(outline)]
        around = np.array([_box(outlines[k]) for k in kept]).reshape(-1, 4)
        return cls(
            frame,
            shape,
            (strips, *_listed(*_cut(strips, cell_m), frame, shape)),
            (corners, first, *_listed(around, np.array(kept, np.int64), frame, shape)),
        )


def _box(outline: Floats) -> Floats:
    return np.concatenate([outline.min(axis=0), outline.max(axis=0)])


def _cut(strips: Floats, most_m: float) -> tuple[Floats, _Ints]:
    """Cuts strips (S, 5) into pieces; returns their boxes (N, 4) and their strips (N,)."""
    start, step = strips[:, :2], strips[:, 2:4] - strips[:, :2]
    pieces = np.maximum(np.ceil(np.hypot(step[:, 0], step[:, 1]) / most_m), 1).astype(np.int64)
    strip = np.repeat(np.arange(len(strips)), pieces)
    nth = count_up(pieces)[:, None]
    a = start[strip] + step[strip] * (nth / pieces[strip, None])
    b = start[strip] + step[strip] * ((nth + 1) / pieces[strip, None])
    return np.hstack([np.minimum(a, b), np.maximum(a, b)]), strip


def _listed(boxes: Floats, owners: _Ints, frame: Floats, shape: _Ints) -> tuple[_Ints, _Ints]:
    """Returns starts (cells + 1,) and members of the cells that boxes (N, 4) touch."""
    low = (boxes[:, :2] - _SLACK_M - frame[:2]) / frame[2]
    high = (boxes[:, 2:] + _SLACK_M - frame[:2]) / frame[2]
    first = np.clip(np.floor(low).astype(np.int64), 0, shape - 1)
    size = np.clip(np.floor(high).astype(np.int64), 0, shape - 1) - first + 1
    touched = size[:, 0] * size[:, 1]
    box, nth = np.repeat(np.arange(len(boxes)), touched), count_up(touched)
    row, column = np.divmod(nth, size[box, 0])
    cell = (first[box, 1] + row) * shape[0] + first[box, 0] + column
    count = int(owners.max(initial=0)) + 1
    cell, member = np.divmod(np.unique(cell * count + owners[box]), count)
    return np.searchsorted(cell, np.arange(shape[0] * shape[1] + 1)), member


def count_up(counts: _Ints) -> _Ints:
    """Returns 0, 1, ... up to each count (N,), one after the other."""
    first = np.cumsum(counts) - counts
    return np.arange(counts.sum()) - np.repeat(first, counts)


@njit("float64(float64, float64, float64[:,::1], int64)", cache=True)
def _distance(x: float, y: float, strips: Floats, s: int) -> float:
    ax, ay = strips[s, 0], strips[s, 1]
    ux, uy = strips[s, 2] - ax, strips[s, 3] - ay
    length2 = ux * ux + uy * uy
    t = 0.0
    if length2 > 0.0:
        t = min(1.0, max(0.0, ((x - ax) * ux + (y - ay) * uy) / length2))
    dx, dy = x - ax - t * ux, y - ay - t * uy
    return float(np.sqrt(dx * dx + dy * dy) - strips[s, 4])


_GRID = "float64[::1], int64[::1]"


@njit(f"UniTuple(float64, 3)(float64, float64, {_GRID})", cache=True)
def _cell(x: float, y: float, frame: Floats, shape: _Ints) -> tuple[float, float, float]:
    """Returns column and row, counted in cells, of the grid's place nearest to one, and how far."""
    u, v = (x - frame[0]) / frame[2], (y - frame[1]) / frame[2]
    column = min(u, float(shape[0])) if u > 0.0 else 0.0
    row = min(v, float(shape[1])) if v > 0.0 else 0.0
    return column, row, np.hypot(u - column, v - row) * frame[2]


_PLACES = "Array(float64, 2, 'C', readonly=True)"
_STRIPS = "Tuple((float64[:,::1], int64[::1], int64[::1]))"
_OUTLINES = "Tuple((float64[:,::1], int64[::1], int64[::1], int64[::1]))"


@njit(f"float64(float64, float64, {_GRID}, {_STRIPS}, float64)", cache=True)
def _nearest(
    x: float,
    y: float,
    frame: Floats,
    shape: _Ints,
    lanes: tuple[Floats, _Ints, _Ints],
    most_m: float,
) -> float:
    """Searches rings of cells around a place until no strip farther out can be nearer."""
    strips, starts, members = lanes
    u, v, outside_m = _cell(x, y, frame, shape)
    columns, rows = shape
    column, row = min(int(u), columns - 1), min(int(v), rows - 1)
    within = min(u - column, column + 1 - u, v - row, row + 1 - v)
    nearest = 1e9
    for ring in range(max(columns, rows)):
        for i in range(max(row - ring, 0), min(row + ring, rows - 1) + 1):
            step = 1 if abs(i - row) == ring else 2 * ring
            for j in range(column - ring, column + ring + 1, step):
                if 0 <= j < columns:
                    cell = i * columns + j
                    for n in range(starts[cell], starts[cell + 1]):
                        nearest = min(nearest, _distance(x, y, strips, members[n]))
        beyond_m = np.hypot((ring + within) * frame[2], outside_m) - frame[3]
        if min(nearest, most_m) <= beyond_m:
            break
    return nearest


@njit("boolean(float64, float64, float64[:,::1], int64, int64)", cache=True)
def _is_inside(x: float, y: float, corners: Floats, first: int, end: int) -> bool:
    inside = False
    for k in range(first, end):
        after = k + 1 if k + 1 < end else first
        x0, y0, x1, y1 = corners[k, 0], corners[k, 1], corners[after, 0], corners[after, 1]
        if (y0 > y) != (y1 > y) and x < (x1 - x0) * (y - y0) / (y1 - y0) + x0:
            inside = not inside
    return inside


@njit(
    f"void({_PLACES}, Tuple(({_GRID})), {_STRIPS}, {_OUTLINES}, float64, float64[::1])", cache=True
)
def _clearances(
    places: Floats,
    grid: tuple[Floats, _Ints],
    lanes: tuple[Floats, _Ints, _Ints],
    junctions: tuple[Floats, _Ints, _Ints, _Ints],
    most_m: float,
    result: Floats,
) -> None:
    frame, shape = grid
    corners, first_corner, starts, members = junctions
    for n in range(len(places)):
        x, y = places[n, 0], places[n, 1]
        result[n] = _nearest(x, y, frame, shape, lanes, most_m)
        u, v, _ = _cell(x, y, frame, shape)
        cell = min(int(v), shape[1] - 1) * shape[0] + min(int(u), shape[0] - 1)
        for m in members[starts[cell] : starts[cell + 1]]:
            if _is_inside(x, y, corners, first_corner[m], first_corner[m + 1]):
                result[n] = min(result[n], 0.0)
