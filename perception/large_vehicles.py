"""Joins clusters that are parts of one large vehicle: a tractor and its trailer, a bus's sides.

What is higher than a car may be up to 18 m long, and sensors see it in parts: the cab stands apart
from the trailer, rings lie far apart on a high side, windows have no returns. Parts in one line
along the road, closer together than vehicles queue, are one.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from perception.arrays import Floats, Floats32, Ints
from perception.clusters import Clusters
from perception.object_classes import HIGH_M, LONGEST_VEHICLE_M, TALL_M, WIDEST_VEHICLE_M
from perception.roadway import Roadway

GAP_M = 1.3  # between parts, along the road; vehicles that queue keep 2 m and more
HIGH_GAP_M = 3.0  # between a cab and a trailer of which little is seen; two lorries are too long


def join_parts(
    points: Floats32, ground_m: Floats32, parts: Clusters, *, roadway: Roadway
) -> Clusters:
    """Returns the clusters of points (N, 3) with parts of large vehicles joined.

    `ground_m` (N,) is the height of the ground below each point.
    """
    top_m = _top_m(points, ground_m, parts.runs, parts.count)
    if parts.count < 2 or not (top_m > TALL_M).any():
        return parts
    _, middles = parts.means(points)
    yaws = roadway.yaw_at(middles)
    extents = _extents(points, parts.runs, middles, yaws)
    return parts.joined(_join(middles, yaws, extents, top_m))


@njit(
    "float64[::1](float32[:,::1], float32[::1], int64[:,::1], int64)",
    cache=True,
    nogil=True,
)
def _top_m(points: Floats32, ground_m: Floats32, runs: Ints, count: int) -> Floats:
    """Returns how high so many clusters reach over the ground (C,)."""
    assert points.shape[1] == 3
    top_m = np.zeros(count, np.float32)
    for run in range(runs.shape[0]):
        label, first, end = runs[run, 0], runs[run, 1], runs[run, 2]
        highest_m = top_m[label]
        for place in range(first, end):
            index = np.uint64(place)
            over_m = points[index, 2] - ground_m[index]
            highest_m = over_m if over_m > highest_m else highest_m
        top_m[label] = highest_m
    return top_m.astype(np.float64)


@njit(
    "float64[:,::1](float32[:,::1], int64[:,::1], float64[:,::1], float64[::1])",
    cache=True,
    nogil=True,
)
def _extents(points: Floats32, runs: Ints, middles: Floats, yaws: Floats) -> Floats:
    """Returns how far clusters reach about their means, along and across the road (C, 4), m.

    Backward and forward, then to the right and to the left.
    """
    assert points.shape[1] == 3
    extents = np.zeros((middles.shape[0], 4))
    cos, sin = np.cos(yaws), np.sin(yaws)
    for run in range(runs.shape[0]):
        label, first, end = runs[run, 0], runs[run, 1], runs[run, 2]
        ahead, aside, middle_x, middle_y = (
            cos[label],
            sin[label],
            middles[label, 0],
            middles[label, 1],
        )
        back, front = extents[label, 0], extents[label, 1]
        right, left = extents[label, 2], extents[label, 3]
        for place in range(first, end):
            index = np.uint64(place)
            x, y = points[index, 0] - middle_x, points[index, 1] - middle_y
            along, across = ahead * x + aside * y, ahead * y - aside * x
            back, front = min(back, along), max(front, along)
            right, left = min(right, across), max(left, across)
        extents[label, 0], extents[label, 1] = back, front
        extents[label, 2], extents[label, 3] = right, left
    return extents


@njit("float64[::1](float64[:,::1], float64[:,::1], int64, int64, float64)", cache=True, nogil=True)
def _seen_from(middles: Floats, extents: Floats, one: int, other: int, yaw: float) -> Floats:
    """Returns how far a cluster reaches about the mean of another, along and across a yaw (4,)."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    x, y = middles[other, 0] - middles[one, 0], middles[other, 1] - middles[one, 1]
    along, across = cos * x + sin * y, cos * y - sin * x
    result: Floats = extents[other] + np.array([along, along, across, across])
    return result


@njit("boolean(float64[::1], float64[::1], float64)", cache=True, nogil=True)
def _are_one(whole: Floats, part: Floats, most_gap_m: float) -> bool:
    """Whether two extents (4,) are in line, near each other, and together a vehicle's size."""
    gap_m = max(part[0] - whole[1], whole[0] - part[1])
    aside_m = max(part[2] - whole[3], whole[2] - part[3])
    length_m = max(part[1], whole[1]) - min(part[0], whole[0])
    width_m = max(part[3], whole[3]) - min(part[2], whole[2])
    fits = length_m <= LONGEST_VEHICLE_M and width_m <= WIDEST_VEHICLE_M
    return bool(fits and gap_m <= most_gap_m and aside_m <= 0)


@njit(
    "int64[::1](float64[:,::1], float64[::1], float64[:,::1], float64[::1])",
    cache=True,
    nogil=True,
)
def _join(middles: Floats, yaws: Floats, extents: Floats, top_m: Floats) -> Ints:
    """Returns by cluster the one that it is part of (C,); tall ones take parts, highest first."""
    owner = np.arange(middles.shape[0])
    for one in np.argsort(-top_m):
        if top_m[one] <= TALL_M:
            break
        if owner[one] != one:
            continue
        whole, before = extents[one].copy(), np.zeros(4)
        while (whole != before).any():  # what was joined brings others near
            before = whole.copy()
            for other in range(owner.size):
                if other == one or owner[other] != other:
                    continue
                part = _seen_from(middles, extents, one, other, yaws[one])
                are_high = min(top_m[one], top_m[other]) > HIGH_M
                if _are_one(whole, part, HIGH_GAP_M if are_high else GAP_M):
                    owner[other] = one
                    whole[0::2] = np.minimum(whole[0::2], part[0::2])
                    whole[1::2] = np.maximum(whole[1::2], part[1::2])
    return owner
