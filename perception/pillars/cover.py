"""Which windows to look at: little more than the road, for it is long and thin."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from perception.arrays import Floats, Floats32
from perception.pillars.voxels import Window

HALO_M = 6.0  # around a window's core: what a vehicle at the core's edge is seen by
STRIP_M, LONG_M = 52.0, 116.0  # of a core at most, across and along
STEP_M = 16.0  # few different sizes, so that many windows are asked for at once
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
