"""What each agent's cloud shows to be taken and to be free, square metre by square metre of road.

Two agents that look at the same place from two sides see other faces of the same vehicle, and less
of what stands behind another. So nothing is said of what an agent does not see: a square is taken
where points lie at the height of a vehicle's body, free where the road itself is seen, or where a
beam passed low over it on its way to something farther off.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from perception.arrays import Bytes, Floats, Floats32, Ints32
from perception.roadway import Placed, Roadway

REACH_M = 45.0  # from the sensor: farther off, rings lie too far apart to show the road
DEEP_M, GROUND_M = -0.5, 0.25  # over the road: the road
BODY_LOW_M, BODY_HIGH_M = 0.4, 1.6  # over the road: a vehicle
MOST_POINTS = 20_000  # of a part that are looked at, every n-th: more show no more
LEAST_POINTS = 2  # in a square that is taken, of those looked at
LOW_BEAM_M = 0.7  # over the road: lower than any vehicle's roof
_CLOUD = "Tuple((float32[:,::1], float32[::1]))"
_RASTER = "Tuple((float64[::1], int32[::1], int32[::1], float32[::1]))"
_NOTES = "Tuple((int32[::1], uint8[::1], float32[:,::1]))"

Raster = tuple[Floats, Ints32, Ints32, Floats32]  # as of `Squares`
Notes = tuple[Ints32, Bytes, Floats32]  # by square: points of bodies, road, the lowest body point


@dataclass(frozen=True, slots=True, eq=False)
class Squares:
    """The squares of the road, numbered. `number` is a raster by row and column, -1 off the road.

    `at` (S,) is the place in the raster of each. The outermost of the raster lie off the road.
    """

    grid: Floats
    number: Ints32
    columns: int
    at: Ints32
    road_m: Floats32

    @classmethod
    def of(cls, roadway: Roadway) -> Squares:
        """Joins the roadway's cells by four."""
        height_m = roadway.height_m
        rows, columns = ((n + 1) // 2 + 2 for n in height_m.shape)
        padded = np.full((2 * rows, 2 * columns), np.nan, np.float32)
        padded[2 : 2 + height_m.shape[0], 2 : 2 + height_m.shape[1]] = height_m
        four = padded.reshape(rows, 2, columns, 2).transpose(0, 2, 1, 3).reshape(-1, 4)
        at = np.flatnonzero(~np.isnan(four).all(axis=1)).astype(np.int32)
        number = np.full(rows * columns, -1, np.int32)
        number[at] = np.arange(len(at), dtype=np.int32)
        side_m = 2 * roadway.cell_m
        low_x, low_y = (low_m - side_m for low_m in roadway.origin_m)
        grid = np.array([low_x, low_y, 1 / side_m, columns, rows])
        return cls(grid, number, columns, at, np.nanmean(four[at], axis=1).astype(np.float32))

    def __len__(self) -> int:
        return len(self.at)


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """The squares that one agent's cloud shows to be taken and to be free, none of them twice."""

    taken: Ints32
    free: Ints32


class Viewer(threading.local):
    """Looks at clouds, in each thread one at a time; each keeps the memory that it takes."""

    def __init__(self, squares: Squares) -> None:
        self._raster = squares.grid, squares.number, squares.at, squares.road_m
        size = len(squares)
        bodies, is_road = np.zeros(size, np.int32), np.zeros(size, np.uint8)
        self._notes = bodies, is_road, np.zeros((size, 3), np.float32)
        self._touched, self._taken, self._free = np.empty((3, size + 1), np.int32)

    def view(self, parts: Sequence[Placed], sensor_m: Floats) -> View:
        """Returns what a cloud in parts, seen from a place (3,) in the map frame, shows."""
        count, sensor_m = 0, np.array(sensor_m)  # messages hold arrays that cannot be written
        for part in parts:
            cloud = part.points, part.road_m
            count = _enter(cloud, sensor_m, self._raster, self._notes, self._touched, count)
        touched = self._touched[:count]
        takes = _list_taken(self._notes, touched, self._taken)
        seen = _list_road(self._notes, touched, self._free)
        taken = self._taken[:takes]
        seen = _look_through(taken, sensor_m, self._raster, self._notes, self._free, seen)
        kept = _leave_out_edges(self._raster, self._notes, self._free, seen)
        _clean(self._notes, touched)
        return View(taken.copy(), self._free[:kept].copy())


@njit(
    f"int64({_CLOUD}, float64[::1], {_RASTER}, {_NOTES}, int32[::1], int64)",
    cache=True,
    nogil=True,
)
def _enter(
    cloud: tuple[Floats32, Floats32],
    sensor_m: Floats,
    raster: Raster,
    notes: Notes,
    touched: Ints32,
    count: int,
) -> int:
    """Enters points within reach into their squares; returns how many squares were touched."""
    points, road_m = cloud
    grid, number = raster[0], raster[1]
    bodies, is_road, lowest = notes
    x0, y0 = np.float32(sensor_m[0]), np.float32(sensor_m[1])
    low_x, low_y, per_m = np.float32(grid[0]), np.float32(grid[1]), np.float32(grid[2])
    columns, reach_m2 = int(grid[3]), np.float32(REACH_M * REACH_M)
    last_column, last_row = np.float32(grid[3] - 1), np.float32(grid[4] - 1)
    every = points.shape[0] // MOST_POINTS + 1
    for index in range(0, points.shape[0], every):
        x, y, z = points[index, 0], points[index, 1], points[index, 2]
        if (x - x0) * (x - x0) + (y - y0) * (y - y0) > reach_m2:
            continue
        over_m = z - road_m[index]
        is_ground = DEEP_M <= over_m <= GROUND_M
        if not (is_ground or BODY_LOW_M <= over_m <= BODY_HIGH_M):
            continue
        column = min(max((x - low_x) * per_m, np.float32(0)), last_column)
        row = min(max((y - low_y) * per_m, np.float32(0)), last_row)
        square = number[int(row) * columns + int(column)]
        if square < 0:
            continue
        if bodies[square] == 0 and is_road[square] == 0:
            touched[count] = square
            count += 1
        if is_ground:
            is_road[square] = 1
            continue
        if bodies[square] == 0 or z < lowest[square, 2]:
            lowest[square, 0], lowest[square, 1], lowest[square, 2] = x, y, z
        bodies[square] += 1
    return count


@njit(f"int64({_NOTES}, int32[::1], int32[::1])", cache=True, nogil=True)
def _list_taken(notes: Notes, touched: Ints32, taken: Ints32) -> int:
    """Lists the squares with enough of a body; returns how many."""
    count = 0
    for place in range(touched.size):
        taken[count] = touched[place]
        count += int(notes[0][touched[place]] >= LEAST_POINTS)
    return count


@njit(f"int64({_NOTES}, int32[::1], int32[::1])", cache=True, nogil=True)
def _list_road(notes: Notes, touched: Ints32, free: Ints32) -> int:
    """Lists the squares where the road is seen; returns how many."""
    count = 0
    for place in range(touched.size):
        free[count] = touched[place]
        count += int(notes[1][touched[place]] == 1)
    return count


@njit(
    f"int64(int32[::1], float64[::1], {_RASTER}, {_NOTES}, int32[::1], int64)",
    cache=True,
    nogil=True,
)
def _look_through(
    taken: Ints32, sensor_m: Floats, raster: Raster, notes: Notes, free: Ints32, count: int
) -> int:
    """Adds the squares that beams passed low over, just before what they hit; returns how many."""
    grid, number, _, road_m = raster
    _, is_road, lowest = notes
    for place in range(taken.size):
        x, y, z = lowest[taken[place]]
        dx, dy, dz = sensor_m[0] - x, sensor_m[1] - y, sensor_m[2] - z
        far_m = max(np.hypot(dx, dy), 1e-3)
        for back_m in (1.0, 1.7, 2.4):
            share = min(back_m / far_m, 1.0)
            column = (x + share * dx - grid[0]) * grid[2]
            row = (y + share * dy - grid[1]) * grid[2]
            if not (0 <= column < grid[3] and 0 <= row < grid[4]):
                break
            square = number[int(row) * int(grid[3]) + int(column)]
            if square < 0 or is_road[square] != 0:
                continue
            if z + share * dz - road_m[square] > LOW_BEAM_M:
                break
            is_road[square] = 2
            free[count] = square
            count += 1
    return count


@njit(f"int64({_RASTER}, {_NOTES}, int32[::1], int64)", cache=True, nogil=True)
def _leave_out_edges(raster: Raster, notes: Notes, free: Ints32, count: int) -> int:
    """Leaves out free squares beside one with a point of a body; returns how many stay.

    What is seen there may be a vehicle's other end.
    """
    grid, number, at, _ = raster
    bodies, is_road, _ = notes
    kept, columns = 0, int(grid[3])
    for place in range(count):
        square, is_beside = free[place], False
        for step in range(9):
            beside = number[at[square] + (step // 3 - 1) * columns + step % 3 - 1]
            is_beside |= beside >= 0 and bodies[beside] > 0
        is_road[square] = 0
        free[kept] = square
        kept += int(not is_beside)
    return kept


@njit(f"void({_NOTES}, int32[::1])", cache=True, nogil=True)
def _clean(notes: Notes, touched: Ints32) -> None:
    """Leaves the notes as they were."""
    for place in range(touched.size):
        notes[0][touched[place]], notes[1][touched[place]] = 0, 0
