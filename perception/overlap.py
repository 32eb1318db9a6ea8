"""How much boxes overlap: seen from above, and as volumes.

One rectangle is cut along the four sides of the other (Sutherland and Hodgman 1974), in the frame
of the other, where its sides are the axes'.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from perception.arrays import Floats, Ints

MAX_CORNERS = 12  # a rectangle cut by four lines has 8; the rest is room


def near_pairs(first: Floats, second: Floats) -> Ints:
    """Returns all (i, j), as (K, 2), of boxes (N, 7) and (M, 7) whose footprints may touch."""
    gaps_m = np.linalg.norm(first[:, None, :2] - second[None, :, :2], axis=2)
    reach_m = [np.hypot(boxes[:, 3], boxes[:, 4]) / 2 for boxes in (first, second)]
    return np.argwhere(gaps_m < reach_m[0][:, None] + reach_m[1][None, :])


def intersection_over_union(first: Floats, second: Floats) -> tuple[Floats, Floats]:
    """Returns the IoU of footprints (K,) and of volumes (K,) of boxes (K, 7), pair by pair.

    Boxes are x, y, z of the centre, length, width, height, yaw; they stand upright.
    """
    shared_m2 = np.empty(len(first))
    _intersect(np.ascontiguousarray(first, np.float64), np.ascontiguousarray(second), shared_m2)
    areas = first[:, 3] * first[:, 4], second[:, 3] * second[:, 4]
    top_m = np.minimum(first[:, 2] + first[:, 5] / 2, second[:, 2] + second[:, 5] / 2)
    floor_m = np.maximum(first[:, 2] - first[:, 5] / 2, second[:, 2] - second[:, 5] / 2)
    shared_m3 = shared_m2 * np.maximum(top_m - floor_m, 0.0)
    volumes = areas[0] * first[:, 5], areas[1] * second[:, 5]
    return _share(shared_m2, *areas), _share(shared_m3, *volumes)


def _share(shared: Floats, first: Floats, second: Floats) -> Floats:
    union = first + second - shared
    return np.divide(shared, union, out=np.zeros_like(shared), where=union > 0)


@njit("int64(float64[:,::1], int64, float64[:,::1], int64, float64, float64)", cache=True)
def _cut(polygon: Floats, corners: int, left: Floats, axis: int, sign: float, end: float) -> int:
    """Writes the part of a polygon where sign * coordinate <= end; returns its corners."""
    kept = 0
    for index in range(corners):
        following = (index + 1) % corners
        here = end - sign * polygon[index, axis]
        there = end - sign * polygon[following, axis]
        if here >= 0.0:
            left[kept, 0], left[kept, 1] = polygon[index, 0], polygon[index, 1]
            kept += 1
        if (here >= 0.0) != (there >= 0.0):
            part = here / (here - there)
            for side in range(2):
                step = polygon[following, side] - polygon[index, side]
                left[kept, side] = polygon[index, side] + part * step
            kept += 1
    return kept


@njit("float64(float64[:,::1], int64)", cache=True)
def _area(polygon: Floats, corners: int) -> float:
    doubled = 0.0
    for index in range(corners):
        following = (index + 1) % corners
        doubled += polygon[index, 0] * polygon[following, 1]
        doubled -= polygon[following, 0] * polygon[index, 1]
    return abs(doubled) / 2.0


@njit("void(float64[:,::1], float64[:,::1], float64[::1])", cache=True)
def _intersect(first: Floats, second: Floats, shared_m2: Floats) -> None:
    """Writes the area (K,) that the footprints of each pair share."""
    polygon = np.empty((MAX_CORNERS, 2))
    left = np.empty((MAX_CORNERS, 2))
    for pair in range(first.shape[0]):
        cos, sin = np.cos(second[pair, 6]), np.sin(second[pair, 6])
        off_x, off_y = first[pair, 0] - second[pair, 0], first[pair, 1] - second[pair, 1]
        x, y = cos * off_x + sin * off_y, cos * off_y - sin * off_x
        turn = first[pair, 6] - second[pair, 6]
        cos, sin = np.cos(turn), np.sin(turn)
        for corner in range(4):
            u = first[pair, 3] * (0.5 if corner in (0, 3) else -0.5)
            v = first[pair, 4] * (0.5 if corner in (0, 1) else -0.5)
            polygon[corner, 0], polygon[corner, 1] = x + cos * u - sin * v, y + sin * u + cos * v
        corners = 4
        for axis in range(2):
            end = second[pair, 3 + axis] / 2.0
            corners = _cut(polygon, corners, left, axis, 1.0, end)
            corners = _cut(left, corners, polygon, axis, -1.0, end)
        shared_m2[pair] = _area(polygon, corners)
