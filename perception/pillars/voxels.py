"""From points to pillars: which column of a window a point falls into, and where in it it lies."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numba import njit

from perception.arrays import Floats, Floats32, Ints, Ints32
from perception.cells import grouped
from perception.parallel import each, threads
from perception.pillars.config import FEATURES, PillarsConfig


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """A part of the map's plane, so many pillars wide and high; `low` (2,) is its lowest corner."""

    low: Floats
    columns: int
    rows: int

    @property
    def size(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.rows, self.columns


@dataclass(frozen=True, slots=True, eq=False)
class Pillars:
    """What the network takes of a window.

    `features` (N, 6) are of points, in the order of pillars: height over the road, offsets from the
    pillar's mean x, y, z and from its middle x, y, in m. Pillar p has those from `starts[p]` to
    `starts[p + 1]` and stands at `cell[p]` (P,), rows of y first.
    """

    features: Floats32
    starts: Ints32
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
    kept, keys = _keep(points, height_m, frame, np.array(window.size))
    ordered, _, cell, starts = grouped(kept, keys, False)
    features = np.empty((len(ordered), FEATURES), np.float32)

    def describe(span: tuple[int, int]) -> None:
        _describe(ordered, starts, cell, *span, config.cell_m, window.columns, features)

    each(describe, _spans(len(cell)))
    return Pillars(features, starts, cell)


def encode(pillars: Pillars, weight: Floats32, bias: Floats32) -> Floats32:
    """Returns what is known of each pillar (P, C): the most that any of its points says, from 0.

    A point says its features (6,) times `weight` (6, C), and `bias` (C,).
    """
    known = np.empty((len(pillars.cell), len(bias)), np.float32)

    def ask(span: tuple[int, int]) -> None:
        _encode(pillars.features, pillars.starts, *span, weight, bias, known)

    each(ask, _spans(len(known)))
    return known


def _spans(count: int) -> list[tuple[int, int]]:
    """Divides so many pillars between the threads."""
    return list(pairwise(np.linspace(0, count, threads() + 1).astype(np.int64).tolist()))


@njit(
    "Tuple((float32[:,::1], int64[::1]))(float32[:,::1], float32[::1], float64[::1], int64[::1])",
    cache=True,
    nogil=True,
)
def _keep(points: Floats32, height_m: Floats32, frame: Floats, size: Ints) -> tuple[Floats32, Ints]:
    """Returns the points inside the window, relative to its corner, and their cells."""
    low_x, low_y, cell_m, low_m, high_m = frame
    rows, columns = size
    kept, keys = np.empty((points.shape[0], 3), np.float32), np.empty(points.shape[0], np.int64)
    count = 0
    for index in range(points.shape[0]):
        if not low_m <= height_m[index] < high_m:
            continue
        x, y = points[index, 0] - low_x, points[index, 1] - low_y
        column, row = int(np.floor(x / cell_m)), int(np.floor(y / cell_m))
        if column < 0 or column >= columns or row < 0 or row >= rows:
            continue
        kept[count, 0], kept[count, 1], kept[count, 2] = x, y, height_m[index]
        keys[count] = row * columns + column
        count += 1
    return kept[:count], keys[:count]


@njit(
    "void(float32[:,::1], int32[::1], int64[::1], int64, int64, float64, int64, float32[:,::1])",
    cache=True,
    nogil=True,
)
def _describe(
    points: Floats32,
    starts: Ints32,
    cells: Ints,
    first: int,
    end: int,
    cell_m: float,
    columns: int,
    features: Floats32,
) -> None:
    """Fills the features of the pillars from `first` to `end`."""
    for pillar in range(first, end):
        begin, size = starts[pillar], starts[pillar + 1] - starts[pillar]
        x, y, z = 0.0, 0.0, 0.0
        for index in range(begin, begin + size):
            x, y, z = x + points[index, 0], y + points[index, 1], z + points[index, 2]
        x, y, z = x / size, y / size, z / size
        middle_x = (cells[pillar] % columns + 0.5) * cell_m
        middle_y = (cells[pillar] // columns + 0.5) * cell_m
        for index in range(begin, begin + size):
            features[index, 0] = points[index, 2]
            features[index, 1] = points[index, 0] - x
            features[index, 2] = points[index, 1] - y
            features[index, 3] = points[index, 2] - z
            features[index, 4] = points[index, 0] - middle_x
            features[index, 5] = points[index, 1] - middle_y


@njit(
    "void(float32[:,::1], int32[::1], int64, int64, float32[:,::1], float32[::1], float32[:,::1])",
    cache=True,
    nogil=True,
    fastmath=True,
)
def _encode(
    features: Floats32,
    starts: Ints32,
    first: int,
    end: int,
    weight: Floats32,
    bias: Floats32,
    known: Floats32,
) -> None:
    """Fills the pillars from `first` to `end`."""
    channels = bias.size
    most = np.empty(channels, np.float32)
    for pillar in range(first, end):
        most[:] = np.float32(0)
        for index in range(starts[pillar], starts[pillar + 1]):
            f0, f1, f2 = features[index, 0], features[index, 1], features[index, 2]
            f3, f4, f5 = features[index, 3], features[index, 4], features[index, 5]
            for c in range(channels):
                said = bias[c] + f0 * weight[0, c] + f1 * weight[1, c] + f2 * weight[2, c]
                said += f3 * weight[3, c] + f4 * weight[4, c] + f5 * weight[5, c]
                most[c] = max(most[c], said)
        known[pillar] = most
