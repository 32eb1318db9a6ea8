"""Whether two sets of points come as near to each other as neighbours do, in bounded time."""

from __future__ import annotations

import numpy as np
from numba import njit

from perception.arrays import Bytes, Floats32, Ints

FEW = 32  # points of a set: fewer are compared, not parted
LIMIT = 256  # looks at a point, all in all


@njit("float64(float32[:,::1], int64, int64)", cache=True, nogil=True)
def apart(points: Floats32, i: int, j: int) -> float:
    """Returns the squared distance between two points."""
    x = np.float64(points[i, 0]) - points[j, 0]
    y = np.float64(points[i, 1]) - points[j, 1]
    z = np.float64(points[i, 2]) - points[j, 2]
    return float(x * x + y * y + z * z)


@njit("int64[::1](uint8[::1], int64, int64)", cache=True, nogil=True)
def _chosen(core: Bytes, first: int, end: int) -> Ints:
    """Returns which points of a range are core points."""
    result = np.empty(end - first, np.int64)
    count = 0
    for index in range(first, end):
        result[count] = index
        count += core[index]
    return result[:count].copy()


@njit("void(float32[:,::1], int64[::1], float32[::1])", cache=True, nogil=True)
def _span(points: Floats32, some: Ints, bounds: Floats32) -> None:
    """Writes the lowest and highest x, y and z (6,) of some points."""
    bounds[:3], bounds[3:] = np.inf, -np.inf
    for index in some:
        for axis in range(3):
            at = points[index, axis]
            bounds[axis], bounds[3 + axis] = min(bounds[axis], at), max(bounds[3 + axis], at)


@njit("UniTuple(float64, 2)(float32[::1], float32[::1])", cache=True, nogil=True)
def _gap(a: Floats32, b: Floats32) -> tuple[float, float]:
    """Returns the squares of how near and how far apart points within two bounds (6,) can be."""
    near_m2 = far_m2 = 0.0
    for axis in range(3):
        above, below = np.float64(b[axis]) - a[3 + axis], np.float64(a[axis]) - b[3 + axis]
        near_m = max(max(above, below), 0.0)
        far_m = max(np.float64(b[3 + axis]) - a[axis], np.float64(a[3 + axis]) - b[axis])
        near_m2, far_m2 = near_m2 + near_m * near_m, far_m2 + far_m * far_m
    return near_m2, far_m2


@njit("int64(float32[:,::1], int64[::1], float32[::1])", cache=True, nogil=True)
def _part(points: Floats32, some: Ints, bounds: Floats32) -> int:
    """Sorts some points by which half of their bounds they lie in; returns how many come first."""
    axis, widest_m = 0, -1.0
    for candidate in range(3):
        side_m = np.float64(bounds[3 + candidate]) - bounds[candidate]
        if side_m > widest_m:
            axis, widest_m = candidate, side_m
    middle = (np.float64(bounds[axis]) + bounds[3 + axis]) / 2
    count = 0
    for place in range(some.size):
        if points[some[place], axis] <= middle:
            some[place], some[count] = some[count], some[place]
            count += 1
    return count


@njit("boolean(float32[:,::1], int64[::1], int64[::1], float64)", cache=True, nogil=True)
def _compare(points: Floats32, a: Ints, b: Ints, square_m2: float) -> bool:
    for i in a:
        for j in b:
            if apart(points, i, j) <= square_m2:
                return True
    return False


@njit("boolean(float32[:,::1], int64[::1], int64[::1], float64)", cache=True, nogil=True)
def _by_parts(points: Floats32, a: Ints, b: Ints, square_m2: float) -> bool:
    """Parts the wider of two sets until bounds, or a few comparisons, tell.

    Sets that nobody meets by chance, all of whose points are neighbours by a hair or not, are taken
    for near once that took too long.
    """
    left = LIMIT * (a.size + b.size)
    bounds_a, bounds_b = np.empty(6, np.float32), np.empty(6, np.float32)
    todo = [(0, a.size, 0, b.size)]
    while todo:
        first_a, end_a, first_b, end_b = todo.pop()
        some_a, some_b = a[first_a:end_a], b[first_b:end_b]
        _span(points, some_a, bounds_a)
        _span(points, some_b, bounds_b)
        left -= some_a.size + some_b.size
        near_m2, far_m2 = _gap(bounds_a, bounds_b)
        if near_m2 > square_m2:
            continue
        if far_m2 <= square_m2 or left < 0:
            return True
        if some_a.size <= FEW and some_b.size <= FEW:
            if _compare(points, some_a, some_b, square_m2):
                return True
            left -= some_a.size * some_b.size
        elif (bounds_a[3:] - bounds_a[:3]).max() >= (bounds_b[3:] - bounds_b[:3]).max():
            middle = first_a + _part(points, some_a, bounds_a)
            todo.append((first_a, middle, first_b, end_b))
            todo.append((middle, end_a, first_b, end_b))
        else:
            middle = first_b + _part(points, some_b, bounds_b)
            todo.append((first_a, end_a, first_b, middle))
            todo.append((first_a, end_a, middle, end_b))
    return False


@njit(
    "boolean(float32[:,::1], uint8[::1], UniTuple(int64, 2), UniTuple(int64, 2), float64)",
    cache=True,
    nogil=True,
)
def near(
    points: Floats32, core: Bytes, one: tuple[int, int], other: tuple[int, int], square_m2: float
) -> bool:
    """Whether two ranges have core points that are neighbours."""
    a, b = _chosen(core, one[0], one[1]), _chosen(core, other[0], other[1])
    return bool(_by_parts(points, a, b, square_m2))
