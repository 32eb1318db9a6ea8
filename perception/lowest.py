"""The lowest point of each square metre: votes for where the ground lies.

Near a sensor a car's side holds more points than the road around it, so areas vote, not points.
Votes are few, and those of a part of a cloud can be taken before the other parts are there.
"""

from __future__ import annotations

import threading

import numpy as np
from numba import njit

from perception.arrays import Floats, Floats32, Ints32

CELL_M = 1.0
MOST_SQUARES = 1 << 22  # of a table; points that lie farther apart have larger squares
TABLE = "Tuple((float32[::1], int32[::1], int32[::1]))"


def _table(size: int) -> tuple[Floats32, Ints32, Ints32]:
    indices = np.empty(size, np.int32), np.empty(size + 1, np.int32)
    return np.full(size, np.inf, np.float32), *indices


class _Tables(threading.local):
    """Each thread's table of squares, kept from one cloud to the next."""

    def __init__(self) -> None:
        self.arrays = _table(0)


_tables = _Tables()


def lowest(points: Floats32, base_m: Floats32) -> Floats32:
    """Returns x, y and height over the base (V, 3) of the lowest point of each square metre.

    Of points (N, 3) over a base at the heights (N,). The result's own lowest points are itself.
    """
    if len(points) == 0:
        return np.zeros((0, 3), np.float32)
    grid = squares(span(points), CELL_M)
    return np.asarray(_lowest(points, base_m, grid, table(int(grid[3] * grid[4]))))


def table(size: int) -> tuple[Floats32, Ints32, Ints32]:
    """Returns this thread's table of at least so many squares (S,), clean; leave it so.

    Clean is that the first array, the height of the lowest point so far, is infinite all over. The
    second has room for the points' indices, the third (S + 1,) for the squares that were touched:
    one is written before it is known to be new.
    """
    if len(_tables.arrays[0]) < size:
        _tables.arrays = _table(size)
    return _tables.arrays


@njit("float64[:,::1](float32[:,::1])", cache=True, nogil=True)
def span(points: Floats32) -> Floats:
    """Returns the lowest and the highest x and y of points (N, 3) as (2, 2)."""
    low_x = low_y = np.float32(np.inf)
    high_x = high_y = np.float32(-np.inf)
    for index in range(points.shape[0]):
        x, y = points[index, 0], points[index, 1]
        low_x, high_x = x if x < low_x else low_x, x if x > high_x else high_x
        low_y, high_y = y if y < low_y else low_y, y if y > high_y else high_y
    return np.array([[low_x, low_y], [high_x, high_y]], np.float64)


@njit("uint64(float32, float32, float64[::1])", cache=True, nogil=True, inline="always")
def square(x: float, y: float, grid: Floats) -> np.uint64:
    """Returns the square of a grid in which a point lies; the outermost ones reach to infinity."""
    column, row = (x - grid[0]) * grid[2], (y - grid[1]) * grid[2]
    column = column if column > 0.0 else 0.0  # as a choice of two values this takes no branch
    column = column if column < grid[3] - 1.0 else grid[3] - 1.0
    row = row if row > 0.0 else 0.0
    row = row if row < grid[4] - 1.0 else grid[4] - 1.0
    return np.uint64(row) * np.uint64(grid[3]) + np.uint64(column)


@njit("float64[::1](float64[:,::1], float64)", cache=True, nogil=True)
def squares(low_high: Floats, side_m: float) -> Floats:
    """Returns a grid (5,) over a span (2, 2): origin x and y, squares per metre, columns, rows.

    Its lines are fixed in the map. Where there were too many squares they are larger by a power of
    two; an infinite side gives one.
    """
    if np.isinf(side_m) or not np.isfinite(low_high).all():
        return np.array([0.0, 0.0, 0.0, 1.0, 1.0])
    while True:
        first_x, first_y = np.floor(low_high[0, 0] / side_m), np.floor(low_high[0, 1] / side_m)
        columns = np.floor(low_high[1, 0] / side_m) - first_x + 1
        rows = np.floor(low_high[1, 1] / side_m) - first_y + 1
        if columns * rows <= MOST_SQUARES:
            return np.array([first_x * side_m, first_y * side_m, 1 / side_m, columns, rows])
        side_m *= 2


@njit(
    f"float32[:,::1](float32[:,::1], float32[::1], float64[::1], {TABLE})", cache=True, nogil=True
)
def _lowest(
    points: Floats32, base_m: Floats32, cells: Floats, table: tuple[Floats32, Ints32, Ints32]
) -> Floats32:
    low_m, who, touched = table
    found, nowhere = np.uint64(0), np.float32(np.inf)
    for index in range(points.shape[0]):
        cell = square(points[index, 0], points[index, 1], cells)
        over_m = points[index, 2] - base_m[index]
        if over_m < low_m[cell]:
            touched[found] = cell
            found += np.uint64(low_m[cell] == nowhere)
            low_m[cell], who[cell] = over_m, index
    votes = np.empty((int(found), 3), np.float32)
    for vote in range(found):
        cell = np.uint64(touched[vote])
        point = np.uint64(who[cell])
        votes[vote, 0], votes[vote, 1] = points[point, 0], points[point, 1]
        votes[vote, 2], low_m[cell] = low_m[cell], nowhere
    return votes
