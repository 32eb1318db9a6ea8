"""Heights of a grid of ground: the road's own height spread outwards, and gentle undulation."""

from __future__ import annotations

import numpy as np

from protocol.geometry import Floats
from protocol.roadmap import RoadMap
from sensing.road import resample

_REACH_M = 9.0  # a lane's height counts for grid points this near
_SAMPLE_M = 3.0
_WAVES = ((48.0, 0.7), (17.0, 0.3))  # spacing of the undulation in m, share of its amplitude


def road_relief(road_map: RoadMap, origin: Floats, cell_m: float, shape: tuple[int, int]) -> Floats:
    """Returns heights (rows, columns): the lanes' near them, smoothly interpolated elsewhere.

    Only sums and products are used, so that every machine finds the same numbers.
    """
    weight, total = np.zeros(shape), np.zeros(shape)
    reach = int(np.ceil(_REACH_M / cell_m))
    step = np.arange(-reach, reach + 1)
    for lane in road_map.lanes:
        line = lane.points
        flat = resample(line[:, :2], _SAMPLE_M)
        height = _height_along(flat, line)
        grid = (flat - origin) / cell_m
        node = np.floor(grid).astype(np.int64)
        column = node[:, 0, None, None] + step[None, None, :]
        row = node[:, 1, None, None] + step[None, :, None]
        dx, dy = column - grid[:, 0, None, None], row - grid[:, 1, None, None]
        near = np.maximum(1.0 - (dx * dx + dy * dy) * (cell_m / _REACH_M) ** 2, 0.0) ** 2
        column, row = np.broadcast_arrays(column, row)
        np.add.at(weight, (row, column), near)
        np.add.at(total, (row, column), near * height[:, None, None])
    return _spread(weight, total)


def undulation(
    origin: Floats, cell_m: float, shape: tuple[int, int], rng: np.random.Generator
) -> Floats:
    """Returns smooth heights (rows, columns) within ±1, drawn on coarse lattices."""
    result = np.zeros(shape)
    for spacing_m, share in _WAVES:
        low = np.floor(origin / spacing_m)
        x = (origin[0] + np.arange(shape[1]) * cell_m) / spacing_m - low[0]
        y = (origin[1] + np.arange(shape[0]) * cell_m) / spacing_m - low[1]
        lattice = rng.uniform(-share, share, (int(y[-1]) + 2, int(x[-1]) + 2))
        result += _blend(_blend(lattice, y).T, x).T
    return result


def _height_along(flat: Floats, line: Floats) -> Floats:
    """Returns the heights at points (N, 2) that were resampled from a polyline (K, 3)."""
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line[:, :2], axis=0).T))])
    here = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(flat, axis=0).T))])
    return np.asarray(np.interp(here, way, line[:, 2]))


def _blend(lattice: Floats, at: Floats) -> Floats:
    """Interpolates the rows of a lattice with a quintic step: no creases at the lattice."""
    low = at.astype(np.int64)
    t = at - low
    s = (t * t * t * (t * (t * 6 - 15) + 10))[:, None]
    return np.asarray(lattice[low] * (1 - s) + lattice[low + 1] * s)


def _spread(weight: Floats, total: Floats) -> Floats:
    """Fills a sparsely known grid from ever coarser means of it (push-pull interpolation)."""
    rows, columns = weight.shape
    known = weight > 0
    mean = np.divide(total, weight, out=np.zeros_like(total), where=known)
    if rows <= 2 and columns <= 2:
        everywhere = float(total.sum() / max(weight.sum(), 1e-12))
        return np.where(known, mean, everywhere)
    trust = np.minimum(weight, 1.0)
    coarse = _spread(_halved(trust), _halved(trust * mean))
    wide = _doubled(_doubled(coarse, rows).T, columns).T
    return trust * mean + (1.0 - trust) * wide


def _halved(grid: Floats) -> Floats:
    rows, columns = grid.shape
    even = np.pad(grid, ((0, rows % 2), (0, columns % 2)))
    return np.asarray(even[::2, ::2] + even[1::2, ::2] + even[::2, 1::2] + even[1::2, 1::2])


def _doubled(coarse: Floats, rows: int) -> Floats:
    """Interpolates between the rows of a halved grid, whose centres lie half a row further."""
    at = np.clip((np.arange(rows) - 0.5) / 2, 0, len(coarse) - 1)
    low = np.minimum(at.astype(np.int64), max(len(coarse) - 2, 0))
    high = np.minimum(low + 1, len(coarse) - 1)
    t = (at - low)[:, None]
    return np.asarray(coarse[low] * (1 - t) + coarse[high] * t)
