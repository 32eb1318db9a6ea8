"""Vehicles on ground that is hidden and may lie lower than what is taken for the road.

Where there is no road map, the ground behind a hedge or a wall is extrapolated from what is seen
before it, and a car park there may lie half a metre lower. A car in it, half a metre too low, is no
car to a network that knows heights over the road. So it is asked again with the heights of lower
ground; what it finds then counts only where little ground is seen at the expected height.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from perception.arrays import Floats, Floats32, Ints
from perception.boxes import overlaps
from perception.detector import Vehicles

LOWER_M = 0.5
WEIGHT = 0.95  # of scores on lower ground, for it is seldom
SQUARE_M, LEVEL_M = 1.0, 0.15  # of which all points lie so near the road: ground is seen
AROUND_M, MOST_SEEN = 2.0, 4  # of a box: more such squares, and vehicles stand on that ground
SAME_IOU, SAME_M = 0.1, 1.0  # boxes from above, or their middles: one vehicle
STANDS = 0.5  # of the score on lower ground: the box on the road is taken


def with_lower(found: Vehicles, lower: Vehicles, points: Floats32, height_m: Floats32) -> Vehicles:
    """Adds vehicles on lower ground to those on the road, where that is hidden.

    Of a vehicle found on both, the box on the road is taken unless its score is much lower, with
    the better score. Points (P, 3), map frame, lie at heights over the road (P,).
    """
    hidden = ground_squares(lower.boxes, points, height_m) <= MOST_SEEN
    lower = lower.take(hidden)
    lower = replace(lower, scores=WEIGHT * lower.scores)
    bev, _ = overlaps(found.boxes, lower.boxes)
    apart_m = np.hypot(*(found.boxes[:, None, :2] - lower.boxes[None, :, :2]).transpose(2, 0, 1))
    same = (bev > SAME_IOU) | (apart_m < SAME_M)
    rivals = np.where(same, found.scores[:, None], 0.0)
    stands = rivals.max(axis=0, initial=0.0) >= STANDS * lower.scores
    scores = found.scores.copy()
    if stands.any():
        np.maximum.at(scores, rivals.argmax(axis=0)[stands], lower.scores[stands])
    standing = replace(found, scores=scores).take(~same[:, ~stands].any(axis=1))
    return standing + lower.take(~stands)


def ground_squares(boxes: Floats, points: Floats32, height_m: Floats32) -> Ints:
    """Counts the squares in and around boxes (N, 7) in which nothing but ground is seen (N,)."""
    flat = _flat_squares(points, height_m)
    off = flat[None] - boxes[:, None, :2]
    cos, sin = np.cos(boxes[:, 6, None]), np.sin(boxes[:, 6, None])
    along = np.abs(cos * off[..., 0] + sin * off[..., 1])
    across = np.abs(cos * off[..., 1] - sin * off[..., 0])
    reach = boxes[:, None, 3:5] / 2 + AROUND_M
    near = (along < reach[..., 0]) & (across < reach[..., 1])
    return np.asarray(near.sum(axis=1))


def _flat_squares(points: Floats32, height_m: Floats32) -> Floats:
    """Returns the middles (K, 2) of the squares whose points all lie near the road's height."""
    if not len(points):
        return np.zeros((0, 2))
    cell = np.floor(points[:, :2] / SQUARE_M).astype(np.int64)
    squares, of_point = np.unique(cell, axis=0, return_inverse=True)
    stands = np.bincount(of_point, np.abs(height_m) >= LEVEL_M) > 0
    return np.asarray((squares[~stands] + 0.5) * SQUARE_M)
