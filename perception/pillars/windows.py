"""Windows over a cloud and the pillars in them.

`cover` lays windows over the points; the rest sorts points into the columns ("pillars") of a window
and encodes where in its pillar each point lies.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numba import njit

from perception.arrays import Floats, Floats32, Ints, Ints32
from perception.cells import grouped, numbered, runs
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
    kept, keys = _keep(points, height_m, _frame(window, config), np.array(window.size))
    ordered, _, cell, starts = grouped(kept, keys, False)
    features = np.empty((len(ordered), FEATURES), np.float32)

    def describe(span: tuple[int, int]) -> None:
        _describe(ordered, starts, cell, *span, config.cell_m, window.columns, features)

    each(describe, _spans(len(cell)))
    return Pillars(features, starts, cell)


def known_of(
    points: Floats32,
    height_m: Floats32,
    window: Window,
    config: PillarsConfig,
    weight: Floats32,
    bias: Floats32,
) -> tuple[Floats32, Ints]:
    """Encodes each pillar from the features of `pillars_of`, but without sorting points.

    Returns:
        The highest output of any of a pillar's points (P, C), from 0, and the pillars' cells (P,).
        A point's output is its features (6,) times `weight` (6, C), plus `bias` (C,).
    """
    kept, keys = _keep(points, height_m, _frame(window, config), np.array(window.size))
    first = runs(keys)
    pillar_of, cells = numbered(keys, first[:-1])
    places = _places(kept, first, pillar_of, cells, config.cell_m, window.columns)
    known = np.zeros((len(cells), len(bias)), np.float32)

    def ask(span: tuple[int, int]) -> None:
        _ask(kept, first, pillar_of, places, (weight, bias), span, known)

    each(ask, _spans(len(bias)))
    return known, cells


def _frame(window: Window, config: PillarsConfig) -> Floats:
    return np.array([*window.low, config.cell_m, config.low_m, config.high_m], np.float64)


def _spans(count: int) -> list[tuple[int, int]]:
    """Divides so many pillars, or channels, between the threads."""
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
    "float32[:,::1](float32[:,::1], int32[::1], int32[::1], int64[::1], float64, int64)",
    cache=True,
    nogil=True,
)
def _places(
    points: Floats32,
    first: Ints32,
    pillar_of: Ints32,
    cells: Ints,
    cell_m: float,
    columns: int,
) -> Floats32:
    """Returns the mean of each pillar's points, which come in runs, and its middle x, y (P, 5)."""
    sums, sizes = np.zeros((cells.size, 3)), np.zeros(cells.size, np.int64)
    for run in range(pillar_of.size):
        pillar = pillar_of[run]
        sizes[pillar] += first[run + 1] - first[run]
        for index in range(first[run], first[run + 1]):
            for axis in range(3):
                sums[pillar, axis] += points[index, axis]
    places = np.empty((cells.size, 5), np.float32)
    for pillar in range(cells.size):
        for axis in range(3):
            places[pillar, axis] = sums[pillar, axis] / sizes[pillar]
        places[pillar, 3] = (cells[pillar] % columns + 0.5) * cell_m
        places[pillar, 4] = (cells[pillar] // columns + 0.5) * cell_m
    return places


@njit(
    "void(float32[:,::1], int32[::1], int32[::1], float32[:,::1], "
    "Tuple((float32[:,::1], float32[::1])), UniTuple(int64, 2), float32[:,::1])",
    cache=True,
    nogil=True,
    fastmath=True,
)
def _ask(
    points: Floats32,
    first: Ints32,
    pillar_of: Ints32,
    places: Floats32,
    layer: tuple[Floats32, Floats32],
    span: tuple[int, int],
    known: Floats32,
) -> None:
    """Fills a span of channels; points come in runs, each with its pillar."""
    begin, end = span
    weight, bias = layer[0][:, begin:end].copy(), layer[1][begin:end].copy()
    most = np.empty(end - begin, np.float32)
    for run in range(pillar_of.size):
        pillar = pillar_of[run]
        mean_x, mean_y, mean_z = places[pillar, 0], places[pillar, 1], places[pillar, 2]
        middle_x, middle_y = places[pillar, 3], places[pillar, 4]
        for c in range(most.size):
            most[c] = known[pillar, begin + c]
        for index in range(first[run], first[run + 1]):
            x, y, z = points[index, 0], points[index, 1], points[index, 2]
            f1, f2, f3, f4, f5 = x - mean_x, y - mean_y, z - mean_z, x - middle_x, y - middle_y
            for c in range(most.size):
                output = bias[c] + z * weight[0, c] + f1 * weight[1, c] + f2 * weight[2, c]
                output += f3 * weight[3, c] + f4 * weight[4, c] + f5 * weight[5, c]
                most[c] = max(most[c], output)
        for c in range(most.size):
            known[pillar, begin + c] = most[c]


HALO_M = 6.0  # around a window's core: context for a vehicle at the core's edge
STRIP_M, LONG_M = 52.0, 116.0  # of a core at most, across and along
STEP_M = 16.0  # few different sizes, so that many windows are inferred at once
_COARSE_M = 2.0
_GAP_M = 3 * HALO_M  # a wider one is left out


def cover(points: Floats32, cell_m: float) -> list[Window]:
    """Returns windows whose cores hold all points (N, 2 or 3); one for each square metre will do.

    The core is the window less its halo. Windows stand in columns, or in rows if that is less area.
    Their corners lie on the lines of a grid of cells that is fixed in the map.
    """
    if len(points) == 0:
        return []
    places = _coarse(points)
    columns = _cores(places)
    rows = [core[:, ::-1] for core in _cores(places[:, ::-1])]
    cores = min(columns, rows, key=lambda cores: sum(_area_m2(core) for core in cores))
    return [_window(core, cell_m) for core in cores]


def _window(core: Floats, cell_m: float) -> Window:
    columns, rows = (round(side_m / cell_m) for side_m in _sides_m(core))
    return Window(np.floor((core[0] - HALO_M) / cell_m + 1e-6) * cell_m, columns, rows)


def _sides_m(core: Floats) -> Floats:
    return np.asarray(np.ceil((core[1] - core[0] + 2 * HALO_M) / STEP_M) * STEP_M)


def _area_m2(core: Floats) -> float:
    return float(np.prod(_sides_m(core)))


def _coarse(points: Floats32) -> Floats:
    """Returns the lower corners (K, 2) of the coarse squares that hold points."""
    squares = np.floor(points[:, :2] / _COARSE_M).astype(np.int64)
    low = squares.min(axis=0)
    span = squares.max(axis=0) - low + 1
    keys = (squares[:, 0] - low[0]) * span[1] + squares[:, 1] - low[1]
    known = np.unique(keys)
    return np.stack([known // span[1] + low[0], known % span[1] + low[1]], -1) * _COARSE_M


def _cores(places: Floats) -> list[Floats]:
    """Covers squares strip by strip across the first axis; each core is (2, 2): low and high."""
    cores = []
    places = places[np.argsort(places[:, 0], kind="stable")]
    while len(places):
        inside = places[:, 0] <= places[0, 0] + STRIP_M - _COARSE_M
        strip = places[inside]
        strip = strip[np.argsort(strip[:, 1], kind="stable")]
        for first, end in _stretches(strip[:, 1]):
            part = strip[first:end]
            cores.append(np.stack([part.min(axis=0), part.max(axis=0) + _COARSE_M]))
        places = places[~inside]
    return cores


def _stretches(along: Floats) -> list[tuple[int, int]]:
    """Divides sorted places into stretches without a wide gap, none longer than a core."""
    cuts = [0, *(np.flatnonzero(np.diff(along) > _GAP_M) + 1).tolist(), len(along)]
    stretches = []
    for first, end in pairwise(cuts):
        while first < end:
            longest = int(np.searchsorted(along, along[first] + LONG_M - _COARSE_M, "right"))
            stretches.append((first, min(end, longest)))
            first = min(end, longest)
    return stretches
