"""Which windows to look at: as few as hold all points, for a road is long and thin."""

from __future__ import annotations

import numpy as np

from perception.arrays import Floats, Floats32
from perception.pillars.voxels import Window

HALO_M = 6.0  # around a window's core: what a vehicle at the core's edge is seen by
_COARSE_M = 2.0


def cover(points: Floats32, cells: int, cell_m: float) -> list[Window]:
    """Returns windows of `cells` a side whose cores hold all points (N, 2 or 3).

    The core is the window less its halo. Windows stand in columns, or in rows if those are fewer.
    """
    if len(points) == 0:
        return []
    core_m = cells * cell_m - 2 * HALO_M
    places = _coarse(points)
    columns = _strips(places, core_m)
    rows = [low[::-1] for low in _strips(places[:, ::-1], core_m)]
    lows = columns if len(columns) <= len(rows) else rows
    return [Window(low - HALO_M, cells) for low in lows]


def _coarse(points: Floats32) -> Floats:
    """Returns the lower corners (K, 2) of the coarse squares that hold points."""
    squares = np.floor(points[:, :2] / _COARSE_M).astype(np.int64)
    low = squares.min(axis=0)
    span = squares.max(axis=0) - low + 1
    keys = (squares[:, 0] - low[0]) * span[1] + squares[:, 1] - low[1]
    known = np.unique(keys)
    return np.stack([known // span[1] + low[0], known % span[1] + low[1]], -1) * _COARSE_M


def _strips(places: Floats, core_m: float) -> list[Floats]:
    """Covers squares strip by strip across the first axis, each from its lowest square on."""
    lows = []
    step_m = core_m - _COARSE_M
    places = places[np.argsort(places[:, 0], kind="stable")]
    while len(places):
        first = places[0, 0]
        inside = places[:, 0] <= first + step_m
        along = np.sort(places[inside, 1])
        while len(along):
            lows.append(np.array([first, along[0]]))
            along = along[along > along[0] + step_m]
        places = places[~inside]
    return lows
