"""Duplicate boxes: which boxes lie so close together that they are of one vehicle."""

from __future__ import annotations

import numpy as np
from numba import njit

from perception.arrays import Bools, Floats, Ints
from perception.object_classes import LONGEST_VEHICLE_M

SAME_ALONG, SAME_ACROSS_M = 0.6, 1.2  # boxes nearer, of their mean length, are of one vehicle


@njit("boolean(float64[:], float64[:])", cache=True)
def is_same(box: Floats, other: Floats) -> bool:
    """Whether a box (7,) lies so much in the place of another that both are of one vehicle.

    The distance is measured along and across the other one.
    """
    x, y = box[0] - other[0], box[1] - other[1]
    if abs(x) >= LONGEST_VEHICLE_M:
        return False
    cos, sin = np.cos(other[6]), np.sin(other[6])
    reach_m = SAME_ALONG * (box[3] + other[3]) / 2
    return bool(abs(cos * x + sin * y) < reach_m and abs(cos * y - sin * x) < SAME_ACROSS_M)


@njit("boolean(float64[:], float64[:])", cache=True)
def is_inside(box: Floats, other: Floats) -> bool:
    """Whether the middle of a box (7,) lies in another one, from above."""
    x, y = box[0] - other[0], box[1] - other[1]
    cos, sin = np.cos(other[6]), np.sin(other[6])
    along_m, across_m = abs(cos * x + sin * y), abs(cos * y - sin * x)
    return bool(along_m < other[3] / 2 and across_m < other[4] / 2)


@njit("boolean[::1](float64[:,:], float64[:,:])", cache=True)
def overlapping(boxes: Floats, others: Floats) -> Bools:
    """Whether each box (N, 7) lies where any of the others (M, 7) is."""
    result = np.zeros(boxes.shape[0], np.bool_)
    for n in range(boxes.shape[0]):
        for m in range(others.shape[0]):
            if abs(boxes[n, 0] - others[m, 0]) < LONGEST_VEHICLE_M and is_same(boxes[n], others[m]):
                result[n] = True
                break
    return result


@njit("float64[:,::1](float64[:,:], float64[:,:])", cache=True)
def apart_of_same(boxes: Floats, others: Floats) -> Floats:
    """Returns how far apart boxes (N, 7) and others (M, 7) are, from above (N, M).

    Infinite where neither lies in the place of the other, so that they are of two vehicles.
    """
    result = np.full((boxes.shape[0], others.shape[0]), np.inf)
    for n in range(boxes.shape[0]):
        for m in range(others.shape[0]):
            if abs(boxes[n, 0] - others[m, 0]) >= LONGEST_VEHICLE_M:
                continue
            if is_same(boxes[n], others[m]) or is_same(others[m], boxes[n]):
                result[n, m] = np.hypot(boxes[n, 0] - others[m, 0], boxes[n, 1] - others[m, 1])
    return result


@njit("boolean[::1](float64[:,:])", cache=True)
def first_of_each(boxes: Floats) -> Bools:
    """Marks the boxes (N, 7) that lie where none before them does that is marked."""
    result = np.zeros(boxes.shape[0], np.bool_)
    for n in range(boxes.shape[0]):
        result[n] = True
        for m in range(n):
            if result[m] and is_same(boxes[n], boxes[m]):
                result[n] = False
                break
    return result


def nearest(apart: Floats, most: float) -> Ints:
    """Returns for each row (N, M) the column that is its own by pairs, nearest first, or -1."""
    result = np.full(len(apart), -1, np.int64)
    free = np.ones(apart.shape[1], np.bool_)
    rows, columns = np.nonzero(apart < most)
    for pair in np.argsort(apart[rows, columns], kind="stable"):
        row, column = rows[pair], columns[pair]
        if result[row] < 0 and free[column]:
            result[row], free[column] = column, False
    return result
