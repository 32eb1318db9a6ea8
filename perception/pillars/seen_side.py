"""Moves boxes behind their points, as seen from the sensors.

A network knows of no sensor. Of the strip of a parked car that the geofence leaves, it may make
the far side of a car on the road, through which the sensor would have looked.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from perception.arrays import Floats, Floats32, Ints

LOW_M = 0.3  # over the road: lower points are of the ground
AROUND_M = 0.3  # points so near a box are its own
BESIDE_M = 1.0  # a sensor so far beside a box sees that side
SQUARE_M = 4.0  # of the grid in which a point's boxes are looked up
NEAR_SHARE = 0.1  # of the points, on the half of the box that faces the sensor: fewer are none


def behind_their_points(
    boxes: Floats, points: Floats32, height_m: Floats32, sizes: Ints, sensors: Floats
) -> Floats:
    """Returns boxes (N, 7), those moved whose points lie on the side turned from the sensor alone.

    Args:
        boxes: x, y, z, length, width, height, yaw.
        points: map frame (P, 3), part by part.
        height_m: of the points over the road (P,).
        sizes: how many points each part has (K,).
        sensors: the place that each part was seen from (K, 3).
    """
    starts = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    members = np.zeros((len(boxes), len(sizes)), np.int64)
    to_left = np.zeros(len(boxes), np.int64)
    edges_m = np.tile([np.inf, -np.inf], (len(boxes), 1))
    if len(points) and len(boxes):
        _measure(boxes, points, height_m, starts, members, to_left, edges_m)
    seen = np.flatnonzero(members.sum(axis=1))
    moved = boxes.copy()
    if not len(seen):
        return moved
    members, to_left, edges_m = members[seen], to_left[seen], edges_m[seen]
    cos, sin, half_m = np.cos(boxes[seen, 6]), np.sin(boxes[seen, 6]), boxes[seen, 4] / 2
    sensor = sensors[members.argmax(axis=1), :2] - boxes[seen, :2]
    beside_m = cos * sensor[:, 1] - sin * sensor[:, 0]
    on_left, total = beside_m > 0, members.sum(axis=1)
    near = np.where(on_left, to_left, total - to_left)
    wrong = (np.abs(beside_m) > half_m + BESIDE_M) & (near <= NEAR_SHARE * total)
    shift_m = wrong * np.where(on_left, edges_m[:, 1] - half_m, edges_m[:, 0] + half_m)
    moved[seen, 0] -= sin * shift_m
    moved[seen, 1] += cos * shift_m
    return moved


@njit(cache=True, nogil=True)
def _by_square(boxes: Floats, reach_m: Floats) -> tuple[float, float, Ints, Ints, Ints]:
    """Lists the boxes that reach into each square of a grid around all of them.

    Returns the grid's origin, each square's first entry (rows, columns), and by entry the box and
    the next one (E,); -1 is none.
    """
    low_x, low_y = (boxes[:, 0] - reach_m).min(), (boxes[:, 1] - reach_m).min()
    columns = int(((boxes[:, 0] + reach_m).max() - low_x) / SQUARE_M) + 1
    rows = int(((boxes[:, 1] + reach_m).max() - low_y) / SQUARE_M) + 1
    first = np.full((rows, columns), -1)
    box_of, following = [0][:0], [0][:0]
    for box in range(boxes.shape[0]):
        x, y, reach = boxes[box, 0] - low_x, boxes[box, 1] - low_y, reach_m[box]
        for row in range(int((y - reach) / SQUARE_M), int((y + reach) / SQUARE_M) + 1):
            for column in range(int((x - reach) / SQUARE_M), int((x + reach) / SQUARE_M) + 1):
                following.append(first[row, column])
                first[row, column] = len(box_of)
                box_of.append(box)
    return low_x, low_y, first, np.array(box_of), np.array(following)


@njit(
    "void(float64[:,::1], float32[:,::1], float32[::1], int64[::1], int64[:,::1], int64[::1], "
    "float64[:,::1])",
    cache=True,
    nogil=True,
)
def _measure(
    boxes: Floats,
    points: Floats32,
    height_m: Floats32,
    starts: Ints,
    members: Ints,
    to_left: Ints,
    edges_m: Floats,
) -> None:
    """Counts each box's points by part (N, K) and left of its middle (N,), finds the outermost."""
    cos, sin = np.cos(boxes[:, 6]), np.sin(boxes[:, 6])
    half = boxes[:, 3:5] / 2 + AROUND_M
    low_x, low_y, first, box_of, following = _by_square(boxes, np.hypot(half[:, 0], half[:, 1]))
    rows, columns = first.shape
    for part in range(members.shape[1]):
        for index in range(starts[part], starts[part + 1]):
            column = (points[index, 0] - low_x) / SQUARE_M
            row = (points[index, 1] - low_y) / SQUARE_M
            if not (0 <= column < columns and 0 <= row < rows and height_m[index] >= LOW_M):
                continue
            entry = first[int(row), int(column)]
            while entry >= 0:
                box, entry = box_of[entry], following[entry]
                dx, dy = points[index, 0] - boxes[box, 0], points[index, 1] - boxes[box, 1]
                across = cos[box] * dy - sin[box] * dx
                along = cos[box] * dx + sin[box] * dy
                if abs(along) <= half[box, 0] and abs(across) <= half[box, 1]:
                    members[box, part] += 1
                    to_left[box] += across > 0
                    edges_m[box, 0] = min(edges_m[box, 0], across)
                    edges_m[box, 1] = max(edges_m[box, 1], across)
