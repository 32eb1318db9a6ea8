"""Thinning of beams: near surfaces are hit far more densely than detection needs.

At a range r, neighbouring columns of a spinning LiDAR are r times its azimuth step apart. Every
2nd, 4th, ... is kept, the most that leaves them no farther apart than a given spacing; what is kept
is the same raster in every scan. Rings stay: on bonnets and roofs, which lie nearly along the beam,
they are far apart already.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from perception.arrays import Bytes, Floats32

MOST = 64  # columns


def thin(range_m: Floats32, spacing_m: float, keep: Bytes) -> None:
    """Sets `keep` (channels, columns) to 0 where a return is not needed for the spacing.

    Args:
        range_m: (channels, columns) of one revolution, 0 for no return.
        spacing_m: how far apart kept neighbours of a ring may lie, across the beam; 0 keeps all.
        keep: as large as range_m; what is 0 already stays so.
    """
    _thin(np.ascontiguousarray(range_m), 2 * math.pi / range_m.shape[1], spacing_m, keep)


@njit("void(float32[:,::1], float64, float64, uint8[:,::1])", cache=True)
def _thin(range_m: Floats32, column_rad: float, spacing_m: float, keep: Bytes) -> None:
    for ring in range(range_m.shape[0]):
        for column in range(range_m.shape[1]):
            metres = np.float64(range_m[ring, column])
            stride = 1
            while 0 < 2 * stride * metres * column_rad <= spacing_m and stride < MOST:
                stride *= 2
            if column & (stride - 1):
                keep[ring, column] = 0
