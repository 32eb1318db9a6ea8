"""Completion of boxes: what nobody sees of a vehicle lies behind what is seen, or before it.

A cluster's extents hold its points. The side turned to its sensor stays in place, unless only a
window or the roof of it is seen: then a bonnet or a boot lies before it. Away from the sensor the
box gets the usual size of its class; a narrow car that is seen from side to side is a short one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from perception.arrays import Bools, Floats, Floats32, Ints
from perception.object_classes import Shapes, car_sizes_m, is_car, is_van, usual_m

OVER_M = 0.8  # over the ground: what begins higher is seen over something else
EXTENDED_M = 5.0  # no hidden end makes a car longer
BUMPER_M = 0.5  # over the ground: what is seen of an end so low is its bumper
END_M = 0.3  # this close to a box's end, points belong to it
WHOLE_M, WHOLE_RANGE_M = 3.6, 18.0  # a car so long and so near is seen whole ...
WHOLE_VAN_M, LONGEST_CAR_M = 4.3, 5.5  # ... or a van; no longer than that, though
# Height of the lowest that is seen of an end (bumper; foot of a window; roof), length of what lies
# before a rear and before a front that begins so high.
HIDDEN_OF_CARS_M = np.array([[OVER_M, 0.0, 0.0], [0.95, 0.55, 1.45], [1.5, 1.2, 1.9]])
HIDDEN_OF_VANS_M = np.array([[1.1, 0.0, 0.0], [1.3, 0.1, 1.1], [1.8, 0.2, 1.8]])
WIDTH_RANGE_M, WIDTH_POINTS = 35.0, 30  # so near and of so many points, a width is known
CUT = 0.0043  # of the range: of a width, between the outermost points and the sides


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """Boxes (C,) around clusters: what is seen of them, and from where.

    Attributes:
        extents: their bounds (C, 2, 3) about the clusters' middles, along their own axes.
        shapes: their sizes.
        kinds: what they are, as of `Shapes.kinds`.
        members: how many points each has.
        over_m: how high the lowest points of their rears and fronts are over the ground (C, 2).
        seen_from_m: their sensors (C, 2) about the middles, along the boxes' own axes.
        is_across: which are turned across the road.
    """

    extents: Floats
    shapes: Shapes
    kinds: Ints
    members: Ints
    over_m: Floats
    seen_from_m: Floats
    is_across: Bools

    @property
    def away_m(self) -> Floats:
        """How far away each sensor is (C,)."""
        return np.asarray(np.linalg.norm(self.seen_from_m, axis=1))


def complete(fitted: Fitted) -> Floats:
    """Widens extents to the vehicles that are seen in part.

    Returns:
        Where their rears and fronts were seen (C, 2), along from the middles of the boxes; NaN
        where that is unknown.
    """
    extents = fitted.extents
    seen_m = extents[:, :, 0].copy()
    ahead = _share_ahead(fitted)
    low, high, hidden_m = extents[:, 0, :2], extents[:, 1, :2], _hidden_m(fitted)
    low[:, 0] -= (ahead[:, 0] == 1.0) * hidden_m[:, 0]
    high[:, 0] += (ahead[:, 0] == 0.0) * hidden_m[:, 1]
    missing_m = np.maximum(_usual_m(fitted) - (high - low), 0.0)
    high += ahead * missing_m
    low -= (1.0 - ahead) * missing_m
    return np.where(_is_end(fitted, ahead[:, 0]), seen_m - _middles_m(extents), np.nan)


def _middles_m(extents: Floats) -> Floats:
    return np.asarray(extents[:, :, 0].mean(axis=1, keepdims=True))


def _share_ahead(fitted: Fitted) -> Floats:
    """Returns which share of what boxes lack lies ahead, and which to the left (C, 2).

    The side turned to the sensor stays in place, so that all lies on the other one. Those stay in
    the middle of which that side is hidden by what they are seen over; cars only across.
    """
    ahead = np.where(fitted.seen_from_m > fitted.extents[:, 1, :2], 0.0, 0.5)
    ahead = np.where(fitted.seen_from_m < fitted.extents[:, 0, :2], 1.0, ahead)
    is_over = fitted.shapes.bottom_m > OVER_M
    return np.where(np.column_stack([is_over & ~is_car(fitted.kinds), is_over]), 0.5, ahead)


def _hidden_m(fitted: Fitted) -> Floats:
    """Returns how much of cars is hidden at their rears and fronts (C, 2), seen from so high on.

    Where the lowest that is seen of an end is a window or the roof, boot or bonnet lie before it,
    hidden by another vehicle or between two beams. A vehicle is taken to look the way that the road
    leads; of those across the road, whose front is unknown, no end has more than a boot.
    """
    over_m, vans = fitted.over_m, is_van(fitted.kinds)
    hidden_m = np.zeros_like(over_m)
    for some, table in (
        (is_car(fitted.kinds) & ~vans, HIDDEN_OF_CARS_M),
        (vans, HIDDEN_OF_VANS_M),
    ):
        heights_m, rear_m, front_m = table.T
        hidden_m[some, 0] = np.interp(over_m[some, 0], heights_m, rear_m)
        hidden_m[some, 1] = np.interp(over_m[some, 1], heights_m, front_m)
        turned = some & fitted.is_across
        hidden_m[turned, 1] = np.interp(over_m[turned, 1], heights_m, rear_m)
    room_m = np.clip(EXTENDED_M - fitted.shapes.along_m, 0.0, None)
    return np.minimum(hidden_m, room_m[:, None])


def _usual_m(fitted: Fitted) -> Floats:
    """Returns usual lengths and widths (C, 2); of cars near by those of the width that is seen.

    What is seen of a car over another one is its cabin, which is narrower.
    """
    size_m, away_m = usual_m(fitted.kinds)[:, :2], fitted.away_m
    told = is_car(fitted.kinds) & ~is_van(fitted.kinds) & (fitted.shapes.bottom_m < OVER_M)
    told &= (away_m < WIDTH_RANGE_M) & (fitted.members >= WIDTH_POINTS)
    size_m[told] = car_sizes_m((fitted.shapes.across_m + CUT * away_m)[told])
    return size_m


def _is_end(fitted: Fitted, ahead: Floats) -> Bools:
    """Marks rears and fronts (C, 2) of vehicles that end where the last of them was seen.

    So does the end turned to the sensor if a bumper was seen, that is something so low over the
    ground; and so does the other one of what was seen whole: of a car near by so much that it must
    be all.
    """
    turned_to = np.column_stack([ahead == 1.0, ahead == 0.0])
    along_m = fitted.shapes.along_m
    least_m = np.where(is_van(fitted.kinds), WHOLE_VAN_M, WHOLE_M)
    is_whole = is_car(fitted.kinds) & (along_m >= least_m) & (along_m <= LONGEST_CAR_M)
    is_whole &= fitted.away_m < WHOLE_RANGE_M
    return np.asarray((fitted.over_m < BUMPER_M) & (turned_to | is_whole[:, None]))


@njit(
    "float64[:,::1](float32[:,::1], int64[:,::1], float64[:,::1], float64[::1], float64[:,:,::1])",
    cache=True,
    nogil=True,
)
def lowest_at_ends(
    points: Floats32, runs: Ints, middles: Floats, yaws: Floats, extents: Floats
) -> Floats:
    """Returns the height of the lowest point at the rear and at the front of each box (C, 2)."""
    assert points.shape[1] == 3
    lowest_m = np.full((middles.shape[0], 2), np.inf)
    for run in range(runs.shape[0]):
        label, first, end = runs[run, 0], runs[run, 1], runs[run, 2]
        cos, sin = np.cos(yaws[label]), np.sin(yaws[label])
        rear_m, front_m = extents[label, 0, 0] + END_M, extents[label, 1, 0] - END_M
        for index in range(first, end):
            x_m, y_m = points[index, 0] - middles[label, 0], points[index, 1] - middles[label, 1]
            along_m, z_m = cos * x_m + sin * y_m, np.float64(points[index, 2])
            if along_m <= rear_m:
                lowest_m[label, 0] = min(lowest_m[label, 0], z_m)
            if along_m >= front_m:
                lowest_m[label, 1] = min(lowest_m[label, 1], z_m)
    return lowest_m
