"""The clusters of a cloud as runs of neighbouring points: a sensor scans a cluster run by run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from perception.arrays import Floats, Floats32, Ints, Ints32
from perception.cluster import NOISE


@dataclass(frozen=True, slots=True, eq=False)
class Clusters:
    """So many clusters, numbered from 0 by their first points.

    `runs` (R, 3) are, by index of the points, those of neighbouring points that are in one cluster:
    the cluster, the first index, the end. Points in no run are noise.
    """

    runs: Ints
    count: int

    @classmethod
    def of(cls, labels: Ints32) -> Clusters:
        """Takes the cluster of each point (N,), so numbered; -1 is noise."""
        return cls(*_runs(labels))

    def joined(self, owner: Ints) -> Clusters:
        """Returns the clusters when each is part of another, its owner (C,), or of itself."""
        return Clusters(*_joined(self.runs, owner))

    def means(self, points: Floats32) -> tuple[Ints, Floats]:
        """Returns how many points each cluster has (C,), and their means (C, 3)."""
        members, means = _sums(points, self.runs, self.count)
        return members, means / members[:, None]

    def labels(self, points: int) -> Ints32:
        """Returns the cluster of each of so many points (N,); -1 is noise."""
        labels = np.full(points, NOISE, np.int32)
        for label, first, end in self.runs:
            labels[first:end] = label
        return labels


@njit("Tuple((int64[:,::1], int64))(int32[::1])", cache=True, nogil=True)
def _runs(labels: Ints32) -> tuple[Ints, int]:
    most, before = 0, NOISE
    for label in labels:
        most += label not in (before, NOISE)
        before = label
    runs = np.empty((most, 3), np.int64)
    run = first = highest = 0
    while first < labels.size:
        label, end = labels[first], first + 1
        while end < labels.size and labels[end] == label:
            end += 1
        if label != NOISE:
            runs[run, 0], runs[run, 1], runs[run, 2] = label, first, end
            run, highest = run + 1, max(highest, label + 1)
        first = end
    return runs, highest


@njit("Tuple((int64[:,::1], int64))(int64[:,::1], int64[::1])", cache=True, nogil=True)
def _joined(runs: Ints, owner: Ints) -> tuple[Ints, int]:
    """Numbers owners by their first points; runs that meet in one of them are one."""
    new = np.full(owner.size, NOISE)
    joined = np.empty_like(runs)
    following = last = 0
    for run in range(runs.shape[0]):
        whole = owner[runs[run, 0]]
        if new[whole] == NOISE:
            new[whole], following = following, following + 1
        if last and joined[last - 1, 0] == new[whole] and joined[last - 1, 2] == runs[run, 1]:
            joined[last - 1, 2] = runs[run, 2]
            continue
        joined[last, 0], joined[last, 1], joined[last, 2] = new[whole], runs[run, 1], runs[run, 2]
        last += 1
    return joined[:last].copy(), following


@njit(
    "Tuple((int64[::1], float64[:,::1]))(float32[:,::1], int64[:,::1], int64)",
    cache=True,
    nogil=True,
)
def _sums(points: Floats32, runs: Ints, count: int) -> tuple[Ints, Floats]:
    """Returns how many points each of so many clusters has (C,), and the sums of them (C, 3)."""
    assert points.shape[1] == 3
    members, sums = np.zeros(count, np.int64), np.zeros((count, 3))
    for run in range(runs.shape[0]):
        label, first, end = runs[run, 0], runs[run, 1], runs[run, 2]
        x = y = z = 0.0
        for index in range(first, end):
            x, y, z = x + points[index, 0], y + points[index, 1], z + points[index, 2]
        members[label] += end - first
        sums[label, 0], sums[label, 1] = sums[label, 0] + x, sums[label, 1] + y
        sums[label, 2] += z
    return members, sums
