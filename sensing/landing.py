"""Where rays that go down steeply meet the ground, from the terrain itself and without Embree.

A ray that falls faster than the ground does anywhere near meets it once, and the ray beside it
meets it nearly there: one or two steps from triangle to triangle find the exact place.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from perception.arrays import Floats32
from protocol.geometry import Floats
from sensing.terrain import Terrain

REACH_M = 60.0
_TILE_M = 64.0  # at least the reach, so that a tile and its neighbours hold all of it
_STEEPER = 1.5  # than the steepest ground around, so that few steps suffice


class Landing:
    """The ground for steep rays."""

    def __init__(self, terrain: Terrain) -> None:
        self._terrain = terrain
        self._tile = math.ceil(_TILE_M / terrain.cell_m)
        self._slopes = _widest(_steepest(terrain.nodes, self._tile)) / terrain.cell_m

    def steepness(self, position: Floats) -> float:
        """Returns the fall per metre that a ray from here needs, or infinity.

        One that falls so fast meets the ground once, and within `REACH_M`.
        """
        above_m = float(position[2] - self._terrain.height_m(position[:2])[0])
        cells = (position[:2] - self._terrain.origin) / self._terrain.cell_m / self._tile
        column, row = (int(n) for n in np.floor(cells))
        inside = 0 <= row < self._slopes.shape[0] and 0 <= column < self._slopes.shape[1]
        if above_m <= 0 or not inside:
            return math.inf
        slope = float(self._slopes[row, column])
        return max(_STEEPER * slope, slope + above_m / REACH_M) + 1e-3

    def cast(self, position: Floats, directions: Floats32, limits: Floats32) -> None:
        """Lowers the limits (N,) of steep rays to where they meet the ground.

        Args:
            position: (3,) in the map frame.
            directions: (N, 3) in the map frame, each at least as steep as `steepness` says.
            limits: overwritten.
        """
        terrain = self._terrain
        _land(terrain.nodes, terrain.origin, terrain.cell_m, position.copy(), directions, limits)


def _steepest(nodes: Floats, tile: int) -> Floats:
    """Returns the largest gradient of any triangle in each tile, per cell."""
    along_x, along_y = np.abs(np.diff(nodes, axis=1)), np.abs(np.diff(nodes, axis=0))
    upper = np.hypot(along_x[1:], along_y[:, :-1])
    lower = np.hypot(along_x[:-1], along_y[:, 1:])
    slope = np.maximum(upper, lower)
    rows, columns = (-(-n // tile) for n in slope.shape)
    padded = np.zeros((rows * tile, columns * tile))
    padded[: slope.shape[0], : slope.shape[1]] = slope
    return np.asarray(padded.reshape(rows, tile, columns, tile).max(axis=(1, 3)))


def _widest(tiles: Floats) -> Floats:
    """Returns each tile's largest value among its neighbours and itself."""
    padded = np.pad(tiles, 1)
    rows, columns = tiles.shape
    shifts = [padded[i : i + rows, j : j + columns] for i in range(3) for j in range(3)]
    return np.asarray(np.max(shifts, axis=0))


@njit(
    "void(Array(float64, 2, 'C', readonly=True), float64[::1], float64, float64[::1], "
    "float32[:,::1], float32[::1])",
    cache=True,
)
def _land(
    nodes: Floats,
    origin: Floats,
    cell_m: float,
    position: Floats,
    directions: Floats32,
    limits: Floats32,
) -> None:
    """Newton's method from the hit before, kept within a bracket that each step narrows."""
    rows, columns = nodes.shape
    u0, v0 = (position[0] - origin[0]) / cell_m, (position[1] - origin[1]) / cell_m
    t = 0.0
    for n in range(len(directions)):
        du, dv, dz = directions[n, 0] / cell_m, directions[n, 1] / cell_m, float(directions[n, 2])
        low, high = 0.0, 1e9
        for _ in range(60):
            u, v = u0 + t * du, v0 + t * dv
            j, i = min(max(int(u), 0), columns - 2), min(max(int(v), 0), rows - 2)
            base, corner = nodes[i, j], nodes[i + 1, j + 1]
            below = u - j >= v - i
            if below:
                gu = nodes[i, j + 1] - base
                gv = corner - nodes[i, j + 1]
            else:
                gv = nodes[i + 1, j] - base
                gu = corner - nodes[i + 1, j]
            gap = position[2] + t * dz - (base + gu * (u - j) + gv * (v - i))
            if gap > 0:
                low = t
            else:
                high = t
            found = t + gap / (gu * du + gv * dv - dz)
            u, v = u0 + found * du - j, v0 + found * dv - i
            same = 0.0 <= u <= 1.0 and 0.0 <= v <= 1.0 and (u >= v) == below
            if same or abs(found - t) < 1e-7:
                t = found
                break
            t = found if low < found < high else 0.5 * (low + min(high, low + 1e3))
        u, v = u0 + t * du, v0 + t * dv
        if 0.0 <= u <= columns - 1 and 0.0 <= v <= rows - 1 and t < limits[n]:
            limits[n] = t
