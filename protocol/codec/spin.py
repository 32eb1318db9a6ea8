"""Loops over the beams of a spinning LiDAR whose rings were found in a cloud."""

from __future__ import annotations

import numpy as np
from numba import njit

from protocol.codec.tokens import I8
from protocol.scans import Floats, Floats32

_NEAREST_M = 1e-3


@njit("void(float64[:,::1], float64[:,::1], float32[:,:,::1])", cache=True, nogil=True)
def turn_rings(turns: Floats, azimuths: Floats, directions: Floats32) -> None:
    """Fills unit vectors (channels, columns, 3).

    Args:
        turns: (channels, 3), of each ring: how far out, how far round and how far up it points.
        azimuths: (columns, 2), cosine and sine of each column's azimuth from the first.
        directions: filled.
    """
    for ring in range(len(turns)):
        out, side, up = turns[ring, 0], turns[ring, 1], turns[ring, 2]
        for column in range(len(azimuths)):
            a, b = azimuths[column, 0], azimuths[column, 1]
            directions[ring, column, 0] = out * a - side * b
            directions[ring, column, 1] = side * a + out * b
            directions[ring, column, 2] = up


@njit(
    "void(float64[:,::1], float32[:,::1], int64[::1], float64[::1], float64[::1])",
    cache=True,
    nogil=True,
)
def measure_beams(
    points: Floats, directions: Floats32, beam: I8, range_m: Floats, beside_m: Floats
) -> None:
    """Fills how far along its beam and how far beside it each point (N, 3) lies."""
    for n in range(len(points)):
        along = directions[beam[n]]
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        # What the decoder multiplies is float32, and so is what the image holds.
        metres = np.float64(np.float32(x * along[0] + y * along[1] + z * along[2]))
        range_m[n] = metres
        x, y, z = x - along[0] * metres, y - along[1] * metres, z - along[2] * metres
        beside_m[n] = np.sqrt(x * x + y * y + z * z)


@njit(
    "int64(int64[::1], float64[::1], float64[::1], float64, float32[::1], int64[::1], int64[::1])",
    cache=True,
    nogil=True,
)
def claim_beams(
    beam: I8,
    range_m: Floats,
    beside_m: Floats,
    reach_m: float,
    image: Floats32,
    owner: I8,
    misfits: I8,
) -> int:
    """Gives each beam to the first point within reach; returns the number of points without.

    Args:
        beam: of each point (N,).
        range_m: of each point.
        beside_m: of each point.
        reach_m: how far beside its beam a point may lie.
        image: zeros (beams,), filled with ranges.
        owner: -1 (beams,), filled with indices of points.
        misfits: (N,), filled with the indices of points without a beam.
    """
    count = 0
    for n in range(len(beam)):
        at = beam[n]
        if beside_m[n] <= reach_m and range_m[n] > _NEAREST_M and owner[at] < 0:
            owner[at] = n
            image[at] = range_m[n]
        else:
            misfits[count] = n
            count += 1
    return count
