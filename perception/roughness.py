"""Roughness of what is boxed: leaves scatter, sheet metal does not.

The points of one scan around a place on a vehicle's side lie within a few centimetres of a plane;
those on a bush or a tree's crown lie nearly as deep as they lie wide (eigenvalues of the
neighbours' covariance, by which Weinmann et al. 2015 tell vegetation). A trimmed hedge is smoother,
but as high as its box at both ends, which of vehicles only smooth ones are.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit

from perception.arrays import Bools, Floats, Floats32, Ints

REACH_M = 0.4  # of a neighbourhood
LEAST_NEIGHBOURS, LEAST_PLACES, LEAST_POINTS = 6, 16, 60  # fewer tell nothing
PLACES, MOST_POINTS = 48, 1024  # of a box, evenly: at least so many are looked at, and at most
LEAVES = (0.07, 0.5), (0.055, 0.6)
"""Standard deviation off the plane in m, and its share of that along the plane, the lesser one."""
HEDGE = ((0.045, 0.3),)  # of what is as high as its box at both ends
END_M, END_HEIGHT = 0.8, 0.85  # of an end, and of the box's height
LOW_M, OWN_M = 0.4, 0.2  # over the road, where a box's points begin; around it, where they end


def are_leafy(boxes: Floats, points: Floats32, height_m: Floats32, sizes: Ints) -> Bools:
    """Marks the boxes (N,) whose points scatter as those on leaves do.

    Args:
        boxes: x, y, z over the road, length, width, height, yaw (N, 7).
        points: map frame (P, 3), part by part.
        height_m: of the points over the road (P,).
        sizes: how many points each part has (K,); of a box's, the part with most of them tells.
    """
    starts = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    result = np.zeros((len(boxes), 4))
    _measure(np.ascontiguousarray(boxes), points, height_m, starts, result)
    thick_m, share, rear_m, front_m = result.T
    top_m = boxes[:, 2] + boxes[:, 5] / 2
    is_block = np.minimum(rear_m, front_m) >= END_HEIGHT * top_m
    is_leafy = _reach(thick_m, share, LEAVES) | (is_block & _reach(thick_m, share, HEDGE))
    return np.asarray(is_leafy)


def _reach(thick_m: Floats, share: Floats, least: Sequence[tuple[float, float]]) -> Bools:
    """Marks where both (N,) reach one of the pairs."""
    pairs = [(thick_m >= one_m) & (share >= part) for one_m, part in least]
    return np.asarray(np.any(pairs, axis=0))


@njit("int64(float64[::1], float32[:,::1], float32[::1], int64, int64, int64[::1])", cache=True,
      nogil=True)  # fmt: skip
def _own(box: Floats, points: Floats32, height_m: Floats32, first: int, end: int, own: Ints) -> int:
    """Lists a part's points in a box; returns how many there are."""
    cos, sin, top_m = np.cos(box[6]), np.sin(box[6]), box[2] + box[5] / 2 + OWN_M
    count = 0
    for index in range(first, end):
        x, y = points[index, 0] - box[0], points[index, 1] - box[1]
        along, across = abs(cos * x + sin * y), abs(cos * y - sin * x)
        is_in = along <= box[3] / 2 + OWN_M and across <= box[4] / 2 + OWN_M
        if is_in and LOW_M < height_m[index] <= top_m:
            own[count] = index
            count += 1
    return count


@njit("void(float64[:,::1], float64[::1])", cache=True, nogil=True)
def _about(near: Floats, result: Floats) -> None:
    step = max(1, len(near) // PLACES)
    thick_m, share = np.empty(len(near)), np.empty(len(near))
    places = 0
    for place in range(0, len(near), step):
        total, squares, count = np.zeros(3), np.zeros((3, 3)), 0
        for other in range(len(near)):
            off = near[other] - near[place]
            if off[0] ** 2 + off[1] ** 2 + off[2] ** 2 <= REACH_M**2:
                total += off
                squares += np.outer(off, off)
                count += 1
        if count >= LEAST_NEIGHBOURS:
            mean = total / count
            spread = np.linalg.eigvalsh(squares / count - np.outer(mean, mean))
            thick_m[places] = np.sqrt(max(spread[0], 0.0))
            share[places] = thick_m[places] / np.sqrt(max(spread[1], 1e-9))
            places += 1
    if places >= LEAST_PLACES:
        result[0], result[1] = np.median(thick_m[:places]), np.median(share[:places])


@njit("void(float64[::1], float32[:,::1], float32[::1], int64[::1], float64[::1])", cache=True,
      nogil=True)  # fmt: skip
def _ends(box: Floats, points: Floats32, height_m: Floats32, own: Ints, result: Floats) -> None:
    cos, sin = np.cos(box[6]), np.sin(box[6])
    for index in own:
        along = cos * (points[index, 0] - box[0]) + sin * (points[index, 1] - box[1])
        if abs(along) >= box[3] / 2 - END_M:
            end = 3 if along > 0 else 2
            result[end] = max(result[end], height_m[index])


@njit("void(float64[:,::1], float32[:,::1], float32[::1], int64[::1], float64[:,::1])", cache=True,
      nogil=True)  # fmt: skip
def _measure(
    boxes: Floats, points: Floats32, height_m: Floats32, starts: Ints, result: Floats
) -> None:
    """Fills what is known of each box (N, 4): medians over places, and the heights of its ends.

    The medians are of the deviation off the plane and of its share, as `LEAVES` has them.
    """
    own, best = np.empty(len(points), np.int64), np.empty(len(points), np.int64)
    for number in range(len(boxes)):
        most = 0
        for part in range(len(starts) - 1):
            count = _own(boxes[number], points, height_m, starts[part], starts[part + 1], own)
            if count > most:
                most = count
                best[:count] = own[:count]
        if most < LEAST_POINTS:
            continue
        _ends(boxes[number], points, height_m, best[:most], result[number])
        step = max(1, -(-most // MOST_POINTS))
        near = np.empty((-(-most // step), 3))
        for place in range(len(near)):
            near[place] = points[best[place * step]]
        _about(near, result[number])
