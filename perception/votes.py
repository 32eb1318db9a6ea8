"""Lowest point of each square metre: votes for the height of the ground.

Near a sensor a car's side holds more points than the road around it, so areas vote, not points.
There are few votes, and those of one chunk are taken before the other chunks arrive.
"""

from __future__ import annotations

import threading

import numpy as np
from numba import njit

from perception.arrays import Floats, Floats32, Ints32

VOTE_CELL_M = 1.0
BLOCK = 1024  # points: few enough to stay in a core's cache between two loops
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


def lowest(points: Floats32, base_m: Floats32, grid: Floats | None = None) -> Floats32:
    """Returns x, y and height over the base (V, 3) of the lowest point of each square metre.

    Of points (N, 3) over a base at the heights (N,). The result's own lowest points are itself. A
    `grid` of `squares` in which all of them lie saves a look at their span.
    """
    if len(points) == 0:
        return np.zeros((0, 3), np.float32)
    grid = squares(span(points), VOTE_CELL_M) if grid is None else grid
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
    assert points.shape[1] == 3
    low_x = low_y = np.float32(np.inf)
    high_x = high_y = np.float32(-np.inf)
    for index in range(points.shape[0]):
        x, y = points[index, 0], points[index, 1]
        low_x, high_x = x if x < low_x else low_x, x if x > high_x else high_x
        low_y, high_y = y if y < low_y else low_y, y if y > high_y else high_y
    return np.array([[low_x, low_y], [high_x, high_y]], np.float64)


@njit("int32[::1](float32[:,::1], float64[::1])", cache=True, nogil=True)
def squares_of(points: Floats32, grid: Floats) -> Ints32:
    """Returns the squares of a grid (B,) in which a block's points (B, 3) lie.

    The outermost ones reach to infinity. Choices of two values take no branch, so that a core works
    on several points at once.
    """
    assert points.shape[1] == 3
    found = np.empty(points.shape[0], np.int32)
    x_m, y_m, per_m, last_column, last_row = grid[0], grid[1], grid[2], grid[3] - 1, grid[4] - 1
    columns = np.int32(grid[3])
    for index in range(points.shape[0]):
        column, row = (points[index, 0] - x_m) * per_m, (points[index, 1] - y_m) * per_m
        column = column if column > 0.0 else 0.0
        column = column if column < last_column else last_column
        row = row if row > 0.0 else 0.0
        row = row if row < last_row else last_row
        found[index] = np.int32(row) * columns + np.int32(column)
    return found


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
    assert points.shape[1] == 3
    low_m, who, touched = table
    found, nowhere = np.uint64(0), np.float32(np.inf)
    for begin in range(0, points.shape[0], BLOCK):
        some = squares_of(points[begin : begin + BLOCK], cells)
        for place in range(some.size):
            index, cell = begin + place, np.uint64(some[place])
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
