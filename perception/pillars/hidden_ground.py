"""Vehicles on ground that is hidden and may lie lower than what is taken for the road.

Where there is no road map, the ground behind a hedge or a wall is extrapolated from what is seen
before it, and a car park there may lie half a metre lower. A car in it, half a metre too low, is no
car to a network that knows heights over the road. So it is asked again with the heights of lower
ground; what it finds then counts only where little ground is seen at the expected height.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numba import njit

from perception.arrays import Bools, Bytes, Floats, Floats32, Ints
from perception.boxes import overlaps
from perception.detector import Vehicles
from perception.votes import span, squares, squares_of
from protocol.messages import ObjectClass

LOWER_M = 0.5
WEIGHT = 0.95  # of scores on lower ground, for it is seldom
SQUARE_M, LEVEL_M = 1.0, 0.15  # whose points all lie so near the road's height: ground is seen
AROUND_M, MOST_SEEN = 2.0, 4  # of a box: more such squares, and vehicles stand on that ground
SAME_IOU = 0.3  # from above, of boxes on the road and on lower ground: one vehicle
STANDS = 0.5  # of the score on lower ground, from which on the box on the road is taken


def with_lower(found: Vehicles, lower: Vehicles, points: Floats32, height_m: Floats32) -> Vehicles:
    """Adds vehicles on lower ground to those on the road, where that is hidden.

    Of a vehicle found on both, the box on the road is taken unless its score is much lower, with
    the better score. Both are to hold boxes of scores down to `STANDS` of the least that counts.
    Boxes that overlap less are left. Points (P, 3), map frame, lie at heights over the road (P,).
    """
    hidden = ground_squares(lower.boxes, points, height_m) <= MOST_SEEN
    lower = lower.take(hidden)
    lower = replace(lower, scores=WEIGHT * lower.scores)
    bev, _ = overlaps(found.boxes, lower.boxes)
    same = (bev > SAME_IOU) & (_groups(found)[:, None] == _groups(lower))
    rivals = np.where(same, found.scores[:, None], -1.0)
    on_road = rivals.max(axis=0, initial=-1.0) >= STANDS * lower.scores
    scores = found.scores.copy()
    if on_road.any():
        np.maximum.at(scores, rivals.argmax(axis=0)[on_road], lower.scores[on_road])
    return replace(found, scores=scores) + lower.take(~on_road)


def _groups(vehicles: Vehicles) -> Bytes:
    """Returns their classes (N,), cars and lorries as one: which of them is often unclear."""
    return np.where(vehicles.classes == ObjectClass.TRUCK, ObjectClass.CAR, vehicles.classes)


def ground_squares(boxes: Floats, points: Floats32, height_m: Floats32) -> Ints:
    """Counts the squares in and around boxes (N, 7) in which ground is seen and nothing else."""
    if not len(points):
        return np.zeros(len(boxes), np.int64)
    grid = squares(span(points), SQUARE_M)
    return _count(np.ascontiguousarray(boxes), _are_ground(points, height_m, grid), grid)


@njit("boolean[::1](float32[:,::1], float32[::1], float64[::1])", cache=True, nogil=True)
def _are_ground(points: Floats32, height_m: Floats32, grid: Floats) -> Bools:
    """Marks the squares of a grid with points (P, 3), all of them near the road's height."""
    square = squares_of(points, grid)
    is_seen = np.zeros(int(grid[3] * grid[4]), np.bool_)
    stands = np.zeros_like(is_seen)
    for index in range(points.shape[0]):
        is_seen[square[index]] = True
        stands[square[index]] |= not abs(height_m[index]) < LEVEL_M
    return is_seen & ~stands


@njit("int64[::1](float64[:,::1], boolean[::1], float64[::1])", cache=True, nogil=True)
def _count(boxes: Floats, are_ground: Bools, grid: Floats) -> Ints:
    """Counts the squares that are ground, with their middles in and around each box."""
    counts = np.zeros(boxes.shape[0], np.int64)
    side_m, columns, rows = 1 / grid[2], int(grid[3]), int(grid[4])
    for box in range(boxes.shape[0]):
        half_m, half_width_m = boxes[box, 3] / 2 + AROUND_M, boxes[box, 4] / 2 + AROUND_M
        cos, sin, reach_m = np.cos(boxes[box, 6]), np.sin(boxes[box, 6]), half_m + half_width_m
        x_m, y_m = boxes[box, 0] - grid[0], boxes[box, 1] - grid[1]
        first, end = max(int((x_m - reach_m) / side_m), 0), int((x_m + reach_m) / side_m) + 1
        low, high = max(int((y_m - reach_m) / side_m), 0), int((y_m + reach_m) / side_m) + 1
        for row in range(low, min(high, rows)):
            for column in range(first, min(end, columns)):
                x, y = (column + 0.5) * side_m - x_m, (row + 0.5) * side_m - y_m
                is_near = abs(cos * x + sin * y) < half_m and abs(cos * y - sin * x) < half_width_m
                counts[box] += is_near and are_ground[row * columns + column]
    return counts
