"""Clusters that are too long for one vehicle, parted: a queue in a dense cloud is one cluster."""

from __future__ import annotations

import numpy as np
from numba import njit

from perception.arrays import Bools, Floats32, Ints, Ints32
from perception.cluster import NOISE, cluster, renumber
from perception.config import ClusterConfig

TALL_M = 3.5  # a cluster that is this high is a building or a tree, not several vehicles


def split(points: Floats32, labels: Ints32, *, config: ClusterConfig, longest_m: float) -> Ints32:
    """Clusters anew, with `split_eps_m`, what is longer than a vehicle.

    Takes and returns the clusters of points (N, 3) as labels (N,), numbered by their first points;
    -1 is noise.
    """
    if config.split_eps_m is None or len(labels) == 0 or labels.max() < 0:
        return labels
    too_long = np.zeros(int(labels.max()) + 1, np.bool_)
    again = _to_part(points, labels, longest_m, too_long)
    if len(again) == 0:
        return labels
    closer = config.model_copy(update={"eps_m": config.split_eps_m})
    parts = cluster(points[again], config=closer)
    result = labels.copy()
    result[again] = np.where(parts >= 0, parts + len(too_long), NOISE)
    renumber(result)
    return result


@njit("int64[::1](float32[:,::1], int32[::1], float64, boolean[::1])", cache=True)
def _to_part(points: Floats32, labels: Ints32, longest_m: float, too_long: Bools) -> Ints:
    """Marks the clusters (C,) that are too long, and returns the indices of their points."""
    low = np.full((too_long.size, 3), np.float32(np.inf))
    high = np.full((too_long.size, 3), np.float32(-np.inf))
    for index in range(labels.size):
        label = labels[index]
        if label != NOISE:
            for axis in range(3):
                low[label, axis] = min(low[label, axis], points[index, axis])
                high[label, axis] = max(high[label, axis], points[index, axis])
    for label in range(too_long.size):
        sides_m = high[label] - low[label]
        is_long = sides_m[0] ** 2 + sides_m[1] ** 2 > longest_m**2
        too_long[label] = is_long and sides_m[2] < TALL_M
    again = np.empty(labels.size, np.int64)
    count = 0
    for index in range(labels.size):
        if labels[index] != NOISE and too_long[labels[index]]:
            again[count] = index
            count += 1
    return again[:count].copy()
