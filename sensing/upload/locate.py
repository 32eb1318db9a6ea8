"""Where a scan's beams end: places in the map's plane and heights over the road."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from perception.roadway import Roadway
from protocol.geometry import SE3
from protocol.scans import RangeScan

Floats = npt.NDArray[np.float64]
Floats32 = npt.NDArray[np.float32]

BELOW_M, ABOVE_M = -2.0, 5.0  # what lies lower or higher over the road is not on it


@dataclass(frozen=True, slots=True, eq=False)
class Located:
    """Beams, ring by ring: x, y in the map frame (B, 2) and height over the road (B,).

    The height is NaN off the road; where nothing came back, neither means anything.
    """

    xy: Floats32
    above_m: Floats32


def locate(scan: RangeScan, map_SE3_sensor: SE3, roadway: Roadway) -> Located:
    """Places every return of a scan, as the agent believes to stand."""
    beams = scan.range_m.size
    located = Located(np.empty((beams, 2), np.float32), np.empty(beams, np.float32))
    motion = np.column_stack([map_SE3_sensor.rotation, map_SE3_sensor.translation])
    # Seen from the raster's corner, so that float32 is exact to fractions of a millimetre.
    motion[:2, 3] -= roadway.origin_m
    _locate(
        scan.range_m.reshape(-1),
        scan.pattern.directions.reshape(-1, 3),
        motion.astype(np.float32),
        np.array([*roadway.origin_m, 1 / roadway.cell_m]),
        roadway.height_m,
        located.xy,
        located.above_m,
    )
    return located


@njit(
    "void(float32[::1], Array(float32, 2, 'C', readonly=True), float32[:,::1], float64[::1], "
    "float32[:,::1], float32[:,::1], float32[::1])",
    cache=True,
)
def _locate(
    range_m: Floats32,
    directions: Floats32,
    motion: Floats32,
    grid: Floats,
    height_m: Floats32,
    xy: Floats32,
    above_m: Floats32,
) -> None:
    rows, columns = height_m.shape
    x_m, y_m, per_m = np.float32(grid[0]), np.float32(grid[1]), np.float32(grid[2])
    for beam in range(range_m.size):
        metres = range_m[beam]
        above_m[beam] = np.nan
        if metres <= 0:
            continue
        u, v, w = (
            directions[beam, 0] * metres,
            directions[beam, 1] * metres,
            directions[beam, 2] * metres,
        )
        x = motion[0, 0] * u + motion[0, 1] * v + motion[0, 2] * w + motion[0, 3]
        y = motion[1, 0] * u + motion[1, 1] * v + motion[1, 2] * w + motion[1, 3]
        xy[beam, 0], xy[beam, 1] = x + x_m, y + y_m
        column, row = int(np.floor(x * per_m)), int(np.floor(y * per_m))
        if row < 0 or row >= rows or column < 0 or column >= columns:
            continue
        z = motion[2, 0] * u + motion[2, 1] * v + motion[2, 2] * w + motion[2, 3]
        over = z - height_m[row, column]
        if BELOW_M <= over <= ABOVE_M:  # never off the road: there it is NaN
            above_m[beam] = over
