"""From points to pillars: which column of a window a point falls into, and where in it it lies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from perception.arrays import Floats, Floats32, Ints, Ints32
from perception.pillars.config import FEATURES, PillarsConfig


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """A square part of the map's plane, `cells` pillars wide; `low` (2,) is its lowest corner."""

    low: Floats
    cells: int


@dataclass(frozen=True, slots=True, eq=False)
class Pillars:
    """What the network takes of a window.

    `features` (N, 6) are of points, in the order of pillars: height over the road, offsets from the
    pillar's mean x, y, z and from its middle x, y, in m. Pillar p has those from `starts[p]` to
    `starts[p + 1]` and stands at `cell[p]` (P,), rows of y first.
    """

    features: Floats32
    starts: Ints
    cell: Ints

    @property
    def pillar(self) -> Ints:
        """Which pillar each point belongs to (N,)."""
        return np.repeat(np.arange(len(self.cell)), np.diff(self.starts))


def pillars_of(
    points: Floats32, height_m: Floats32, window: Window, config: PillarsConfig
) -> Pillars:
    """Sorts points (N, 3) with heights over the road (N,) into a window's pillars."""
    frame = np.array([*window.low, config.cell_m, config.low_m, config.high_m], np.float64)
    kept = np.empty((len(points), 3), np.float32)
    places = np.empty(len(points), np.int32)
    counts = np.zeros(window.cells**2, np.int32)
    count = _keep(points, height_m, frame, window.cells, kept, places, counts)
    features = np.empty((count, FEATURES), np.float32)
    cell = np.flatnonzero(counts)
    starts = np.concatenate([[0], np.cumsum(counts[cell], dtype=np.int64)])
    _describe(kept[:count], places[:count], counts, starts, config.cell_m, window.cells, features)
    return Pillars(features, starts, cell)


@njit(
    "int64(float32[:,:], float32[:], float64[::1], int64, float32[:,::1], int32[::1], int32[::1])",
    cache=True,
    nogil=True,
)
def _keep(
    points: Floats32,
    height_m: Floats32,
    frame: Floats,
    cells: int,
    kept: Floats32,
    places: Ints32,
    counts: Ints32,
) -> int:
    """Copies the points inside the window, relative to its corner; counts them by cell."""
    low_x, low_y, cell_m, low_m, high_m = frame
    count = 0
    for index in range(points.shape[0]):
        if not low_m <= height_m[index] < high_m:
            continue
        x, y = points[index, 0] - low_x, points[index, 1] - low_y
        column, row = int(np.floor(x / cell_m)), int(np.floor(y / cell_m))
        if column < 0 or column >= cells or row < 0 or row >= cells:
            continue
        kept[count, 0], kept[count, 1], kept[count, 2] = x, y, height_m[index]
        place = row * cells + column
        places[count] = place
        counts[place] += 1
        count += 1
    return count


@njit(
    "void(float32[:,::1], int32[::1], int32[::1], int64[::1], float64, int64, float32[:,::1])",
    cache=True,
    nogil=True,
)
def _describe(
    points: Floats32,
    places: Ints32,
    counts: Ints32,
    starts: Ints,
    cell_m: float,
    cells: int,
    features: Floats32,
) -> None:
    """Writes the features pillar by pillar; uses up the counts."""
    pillars = starts.size - 1
    sums = np.zeros((pillars, 3))
    number = 0
    for place in range(counts.size):
        if counts[place] > 0:
            counts[place] = number
            number += 1
    following = starts.copy()
    slots = np.empty(points.shape[0], np.int64)
    for index in range(points.shape[0]):
        pillar = counts[places[index]]
        slots[index] = following[pillar]
        following[pillar] += 1
        for axis in range(3):
            sums[pillar, axis] += points[index, axis]
    for index in range(points.shape[0]):
        pillar, place = counts[places[index]], places[index]
        size = starts[pillar + 1] - starts[pillar]
        row = features[slots[index]]
        row[0] = points[index, 2]
        for axis in range(3):
            row[1 + axis] = points[index, axis] - sums[pillar, axis] / size
        row[4] = points[index, 0] - (place % cells + 0.5) * cell_m
        row[5] = points[index, 1] - (place // cells + 0.5) * cell_m
