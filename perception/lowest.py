"""The lowest point of each square metre: votes for where the ground lies.

Near a sensor a car's side holds more points than the road around it, so areas vote, not points.
Votes are few, and those of a part of a cloud can be taken before the other parts are there.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from perception.arrays import Floats, Floats32

CELL_M = 1.0
MAX_CELLS = 16_000_000  # 8 bytes each


def lowest(points: Floats32, base_m: Floats32) -> Floats32:
    """Returns x, y and height over the base (V, 3) of the lowest point of each square metre.

    Of points (N, 3) over a base at the heights (N,). The result's own lowest points are itself.
    """
    if len(points) == 0:
        return np.zeros((0, 3), np.float32)
    return np.asarray(_lowest(points, base_m, _grid(span(points))))


def _grid(low_high: Floats) -> Floats:
    """Returns a grid of square metres, or of larger squares if points lie too far apart."""
    grid = squares(low_high, CELL_M)
    if not grid[3] * grid[4] > MAX_CELLS:
        return grid
    side_m = float(np.sqrt(np.prod(low_high[1] - low_high[0] + 1.0) / MAX_CELLS))
    return squares(low_high, max(side_m, np.max(low_high[1] - low_high[0]) / MAX_CELLS) * 2)


def squares(low_high: Floats, side_m: float) -> Floats:
    """Returns a grid (5,) over a span (2, 2): origin x and y, squares per metre, columns, rows.

    Its lines are fixed in the map. An infinite side gives one square.
    """
    low, high = low_high
    if np.isinf(side_m):
        return np.array([*low, 0, 1, 1], np.float64)
    first = np.floor(low / side_m)
    return np.array([*(first * side_m), 1 / side_m, *(np.floor(high / side_m) - first + 1)])


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


@njit("float32[:,::1](float32[:,::1], float32[::1], float64[::1])", cache=True, nogil=True)
def _lowest(points: Floats32, base_m: Floats32, cells: Floats) -> Floats32:
    low_m = np.full(int(cells[3] * cells[4]), np.float32(np.inf))
    who = np.full(low_m.size, -1, np.int32)
    for index in range(points.shape[0]):
        cell = square(points[index, 0], points[index, 1], cells)
        over_m = points[index, 2] - base_m[index]
        if over_m < low_m[cell]:
            low_m[cell], who[cell] = over_m, index
    votes = np.empty((min(low_m.size, points.shape[0]), 3), np.float32)
    count = 0
    for cell in range(low_m.size):
        if who[cell] >= 0:
            votes[count, 0], votes[count, 1] = points[who[cell], 0], points[who[cell], 1]
            votes[count, 2] = low_m[cell]
            count += 1
    return votes[:count].copy()
