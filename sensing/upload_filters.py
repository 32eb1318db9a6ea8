"""Upload filters: foreground segmentation by road map, ground height and learnt background.

A sensor that drives removes what is ground by the road map, corrected tile by tile by the height at
which most of its low points lie, and what is off the road. A stationary sensor also learns how far
each of its beams goes when nothing is in its way: the farthest range that came back again and
again, unless it ended high over the road, for nothing static stands there. That is far sharper than
a height: it leaves a car its wheels, and knows poles and house fronts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from perception.arrays import Bytes, Floats, Floats32, Ints32
from perception.roadway import Roadway, road_below
from protocol.geometry import SE3
from protocol.scans import RangeScan

BELOW_M, ABOVE_M = -2.0, 5.0  # what lies lower or higher over the road is not on it


@dataclass(frozen=True, slots=True, eq=False)
class Located:
    """Beams, ring by ring: x, y in the map frame (B, 2) and height over the road (B,).

    The height is NaN off the road; where nothing came back, neither means anything.
    """

    xy: Floats32
    above_m: Floats32


def locate(scan: RangeScan, map_SE3_sensor: SE3, roadway: Roadway) -> Located:
    """Locates every return of a scan by the agent's estimated pose."""
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
        (roadway.height_m, roadway.decks_m),
        located.xy,
        located.above_m,
    )
    return located


@njit(
    "void(float32[::1], Array(float32, 2, 'C', readonly=True), float32[:,::1], float64[::1], "
    "Tuple((float32[:,::1], float32[:,:,::1])), float32[:,::1], float32[::1])",
    cache=True,
)
def _locate(
    range_m: Floats32,
    directions: Floats32,
    motion: Floats32,
    grid: Floats,
    roads: tuple[Floats32, Floats32],
    xy: Floats32,
    above_m: Floats32,
) -> None:
    height_m, decks_m = roads
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
        over = z - road_below(z, np.uint64(row), np.uint64(column), height_m, decks_m)
        if BELOW_M <= over <= ABOVE_M:  # never off the road: there it is NaN
            above_m[beam] = over


GROUND_M = 0.2  # over the ground; lower returns are the ground's
TILE_M = 10.0
SAME_M = 0.15  # two ranges of one surface: seven standard deviations of a LiDAR's noise
LEARNT_FRAMES = 5  # so often a range must come back
RAISED_M = 0.3  # over the road: higher returns are never background
_MEMORY = 60  # frames over which a background range is averaged
_LOW_M, _BIN_M, _BINS = -0.6, 0.05, 24  # heights over the map at which the ground is looked for
_LEAST_POINTS = 8  # of a tile's ground; with fewer the map's height is taken


def driving_foreground(located: Located) -> Bytes:
    """Returns 1 for the beams (B,) that ended over the road, higher than the ground."""
    keep = np.zeros(len(located.above_m), np.uint8)
    _raised(located.xy, located.above_m, keep)
    return keep


class Background:
    """Background that a stationary sensor has learnt, beam by beam."""

    def __init__(self, beams: int) -> None:
        self._range_m = np.zeros(beams, np.float32)
        self._frames = np.zeros(beams, np.uint8)

    def foreground(self, range_m: Floats32, located: Located) -> Bytes:
        """Learns from a scan's ranges (B,); returns 1 for the beams (B,) that hit foreground.

        Until a beam's background is learnt, low returns count as the ground.
        """
        keep = np.zeros(range_m.size, np.uint8)
        _raised(located.xy, located.above_m, keep)
        _learn(range_m, located.above_m, self._range_m, self._frames, keep)
        return keep


@njit("float32[::1](float32[:,::1], float32[::1])", cache=True)
def _span(xy: Floats32, above_m: Floats32) -> Floats32:
    """Returns the least and the greatest x and y of the returns on the road; NaN without any."""
    span = np.full(4, np.float32(np.nan))
    for beam in range(above_m.size):
        if not np.isnan(above_m[beam]):
            span[0], span[1] = np.fmin(span[0], xy[beam, 0]), np.fmin(span[1], xy[beam, 1])
            span[2], span[3] = np.fmax(span[2], xy[beam, 0]), np.fmax(span[3], xy[beam, 1])
    return span


@njit("int64(float32[:,::1], int64, float32[::1], int64)", cache=True)
def _tile(xy: Floats32, beam: int, span: Floats32, columns: int) -> int:
    per_m = np.float32(1 / TILE_M)
    row, column = int((xy[beam, 1] - span[1]) * per_m), int((xy[beam, 0] - span[0]) * per_m)
    return row * columns + column


@njit("float32[::1](int32[:,::1])", cache=True)
def _ground(counts: Ints32) -> Floats32:
    """Returns the tiles' ground (T,) over the map from counts (T, bins + 2) of heights."""
    ground_m = np.zeros(counts.shape[0], np.float32)
    for tile in range(counts.shape[0]):
        most, best = _LEAST_POINTS - 1, -1
        for slot in range(1, _BINS + 1):
            total = counts[tile, slot - 1] + counts[tile, slot] + counts[tile, slot + 1]
            if total > most:
                most, best = total, slot
        if best > 0:
            lean = (counts[tile, best + 1] - counts[tile, best - 1]) / most
            ground_m[tile] = _LOW_M + (best - 0.5 + lean) * _BIN_M
    return ground_m


@njit("void(float32[:,::1], float32[::1], uint8[::1])", cache=True)
def _raised(xy: Floats32, above_m: Floats32, keep: Bytes) -> None:
    """Marks the beams that ended over the road and over the ground of their tile."""
    span = _span(xy, above_m)
    if np.isnan(span[0]):
        return
    columns, rows = int((span[2] - span[0]) / TILE_M) + 2, int((span[3] - span[1]) / TILE_M) + 2
    counts = np.zeros((rows * columns, _BINS + 2), np.int32)
    for beam in range(above_m.size):
        above = above_m[beam]
        if above > _LOW_M:
            slot = int((above - np.float32(_LOW_M)) * np.float32(1 / _BIN_M))
            if slot < _BINS:
                counts[_tile(xy, beam, span, columns), slot + 1] += 1
    ground_m = _ground(counts)
    for beam in range(above_m.size):
        if not np.isnan(above_m[beam]):
            over_m = above_m[beam] - ground_m[_tile(xy, beam, span, columns)]
            keep[beam] = over_m > GROUND_M


@njit("void(float32[::1], float32[::1], float32[::1], uint8[::1], uint8[::1])", cache=True)
def _learn(
    range_m: Floats32, above_m: Floats32, background_m: Floats32, frames: Bytes, keep: Bytes
) -> None:
    for beam in range(range_m.size):
        metres = range_m[beam]
        if metres <= 0:
            continue
        off_m = metres - background_m[beam]
        on_road = not np.isnan(above_m[beam])
        raised = on_road and above_m[beam] > RAISED_M
        if frames[beam] > 0 and abs(off_m) <= SAME_M:
            frames[beam] = min(frames[beam] + 1, _MEMORY)
            background_m[beam] += off_m / frames[beam]
            if frames[beam] > LEARNT_FRAMES and not raised:
                keep[beam] = 0
                continue
        elif off_m > 0 and not raised:
            background_m[beam], frames[beam] = metres, 1
        elif frames[beam] > LEARNT_FRAMES:
            keep[beam] = 1  # in front of the background
            continue
        if not on_road:
            keep[beam] = 1
