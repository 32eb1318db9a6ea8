"""Map height correction: estimates the map's height error from the ground in scans.

Maps are off by decimetres, and by a metre where they were drawn from another survey than the
agents' poses: the ground is then taken for vehicles, or vehicles for ground. Each square metre's
lowest point votes; in each tile the lowest height that many votes agree upon is the ground's.
Between tiles the error is interpolated, so that a slope that the map lacks is found, too. Where the
map is right to `TRUSTED_M`, nothing is changed.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from numba import njit

from perception.arrays import Floats, Floats32
from perception.detector import Cloud
from perception.parallel import each
from perception.roadway import Placed
from perception.votes import span

TILE_M = 20.0
MOST_M = 1.75  # that a map may be off; the geofence keeps points to 2 m below it
BIN_M = 0.1
LEAST_VOTES = 12  # of a tile, one for each square metre; with fewer its neighbours decide
LEAST_SHARE = 0.2  # of the votes, within two bins: walls and car roofs are fewer
TRUSTED_M = 0.15  # the ground's own undulation, and the noise of poses
_BINS = round(2 * MOST_M / BIN_M)
_NEIGHBOURS = 2  # tiles whose heights are averaged, each way


def on_the_ground(cloud: Cloud) -> Cloud:
    """Returns a cloud whose heights of the road are where its points have the ground.

    Parts without ground in them are moved as the others are; there must be one with ground.
    """
    votes = [part.lowest for part in cloud.near if len(part.lowest)]
    if not votes:
        return cloud
    every = np.concatenate(votes)
    low = np.floor(span(every)[0] / TILE_M) * TILE_M
    columns, rows = np.floor((span(every)[1] - low) / TILE_M).astype(int) + 1
    if columns * rows > _MOST_TILES:
        return cloud
    grid = np.array([*low, TILE_M])
    error_m = _smoothed(_ground_of_tiles(every, grid, int(rows), int(columns)))
    if not (np.abs(error_m) > TRUSTED_M).any():
        return cloud
    move = partial(_moved, error_m=_with_rim(error_m), grid=grid)
    return replace(cloud, near=each(move, cloud.near), bare=each(move, cloud.bare))


_MOST_TILES = 1 << 16


def _moved(part: Placed, error_m: Floats32, grid: Floats) -> Placed:
    road_m, lowest = part.road_m.copy(), part.lowest.copy()
    _add(part.points, error_m, grid.astype(np.float32), road_m)
    shift_m = np.zeros(len(lowest), np.float32)
    _add(lowest, error_m, grid.astype(np.float32), shift_m)
    lowest[:, 2] -= shift_m
    return replace(part, road_m=road_m, lowest=lowest)


def _with_rim(tiles: Floats32) -> Floats32:
    """Returns the tiles with a copy of the outermost ones around them."""
    return np.ascontiguousarray(np.pad(tiles, 1, mode="edge"))


@njit("float32[:,::1](float32[:,::1], float64[::1], int64, int64)", cache=True, nogil=True)
def _ground_of_tiles(votes: Floats32, grid: Floats, rows: int, columns: int) -> Floats32:
    """Returns the ground's height over the map in each tile (rows, columns); NaN if unknown."""
    counts = np.zeros((rows * columns, _BINS), np.int32)
    for vote in range(votes.shape[0]):
        level = int(np.floor((votes[vote, 2] + MOST_M) / BIN_M))
        if 0 <= level < _BINS:
            column = int((votes[vote, 0] - grid[0]) / grid[2])
            row = int((votes[vote, 1] - grid[1]) / grid[2])
            counts[row * columns + column, level] += 1
    found = np.full((rows, columns), np.float32(np.nan))
    for row in range(rows):
        for column in range(columns):
            tile = counts[row * columns + column]
            least = max(np.float64(LEAST_VOTES), LEAST_SHARE * tile.sum())
            for level in range(1, _BINS - 1):
                around = tile[level - 1] + tile[level] + tile[level + 1]
                is_peak = tile[level] >= tile[level - 1] and tile[level] >= tile[level + 1]
                if is_peak and around >= least:
                    middle = tile[level + 1] - tile[level - 1]
                    off = 0.5 + np.float64(middle) / around
                    found[row, column] = np.float32((level + off) * BIN_M - MOST_M)
                    break
    return found


@njit("float32[:,::1](float32[:,::1])", cache=True, nogil=True)
def _smoothed(tiles: Floats32) -> Floats32:
    """Returns the median of the known tiles around each; 0 where none is known."""
    rows, columns = tiles.shape
    result = np.zeros_like(tiles)
    near = np.empty((2 * _NEIGHBOURS + 1) ** 2, np.float32)
    for row in range(rows):
        for column in range(columns):
            for reach in range(1, _NEIGHBOURS + 1):
                count = 0
                for i in range(max(row - reach, 0), min(row + reach + 1, rows)):
                    for j in range(max(column - reach, 0), min(column + reach + 1, columns)):
                        if not np.isnan(tiles[i, j]):
                            near[count] = tiles[i, j]
                            count += 1
                if count >= 3 or (count > 0 and reach == _NEIGHBOURS):
                    result[row, column] = np.median(near[:count])
                    break
    return result


@njit("void(float32[:,::1], float32[:,::1], float32[::1], float32[::1])", cache=True, nogil=True)
def _add(points: Floats32, error_m: Floats32, grid: Floats32, height_m: Floats32) -> None:
    """Adds to heights (N,) the error at points (N, 3), interpolated between the tiles' middles.

    Around the tiles lies a rim of one more, see `_with_rim`.
    """
    last_u, last_v = np.float32(error_m.shape[1] - 1.001), np.float32(error_m.shape[0] - 1.001)
    zero, half, one = np.float32(0), np.float32(0.5), np.float32(1)
    low_x, low_y, per_m = grid[0], grid[1], one / grid[2]
    for index in range(points.shape[0]):
        u = (points[index, 0] - low_x) * per_m + half
        v = (points[index, 1] - low_y) * per_m + half
        u = u if u > zero else zero
        u = u if u < last_u else last_u
        v = v if v > zero else zero
        v = v if v < last_v else last_v
        column, row = np.uint64(u), np.uint64(v)
        a, b = u - np.float32(column), v - np.float32(row)
        low = (one - a) * error_m[row, column] + a * error_m[row, column + np.uint64(1)]
        row += np.uint64(1)
        high = (one - a) * error_m[row, column] + a * error_m[row, column + np.uint64(1)]
        height_m[index] += (one - b) * low + b * high
