"""Terrain: a grid of ground heights, how a body stands on it, and its mesh."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import product

import numpy as np
import numpy.typing as npt
from numba import njit

from protocol.geometry import Floats
from protocol.roadmap import RoadMap
from sensing.config import SceneConfig
from sensing.limits import MAX_TERRAIN_NODES
from sensing.mesh import TriangleMesh
from sensing.noise import stream
from sensing.road import RoadArea, count_up, resample

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


_MAP_WAVES = 16
_MAP_WAVES_M = (40.0, 150.0)  # lengths of the waves of a map's height error


def believed_map(road_map: RoadMap, config: SceneConfig, seed: int) -> RoadMap:
    """Returns the road map that agents and edges have: its heights are off by what maps are off.

    Half of the error's variance is an offset of the whole map, half waves of 40 to 150 m.
    """
    if not config.map_height_std_m:
        return road_map
    rng = stream(seed, "map height")
    offset_m = float(rng.standard_normal()) * config.map_height_std_m / math.sqrt(2)
    heading, phase = rng.uniform(0.0, 2 * np.pi, (2, _MAP_WAVES))
    per_m = 2 * np.pi / rng.uniform(*_MAP_WAVES_M, _MAP_WAVES)
    along = np.stack([np.cos(heading), np.sin(heading)]) * per_m
    amplitude_m = config.map_height_std_m / math.sqrt(_MAP_WAVES)

    def error_m(places: Floats) -> Floats:
        return np.asarray(offset_m + amplitude_m * np.cos(places @ along + phase).sum(axis=1))

    return road_map.raised(error_m)


def _height_along(flat: Floats, line: Floats) -> Floats:
    """Returns the heights at points (N, 2) that were resampled from a polyline (K, 3)."""
    along_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line[:, :2], axis=0).T))])
    here = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(flat, axis=0).T))])
    return np.asarray(np.interp(here, along_m, line[:, 2]))


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


CELL_M = 4.0
MARGIN_M = 128.0  # as far beyond the road as a sensor on it sees
_HALF_WHEELBASE_M, _HALF_TRACK_M = 1.35, 0.75


class Terrain:
    """A grid of heights, as the scene's ground mesh shows it.

    Attributes:
        origin: x, y (2,) of the grid's first node, in the map frame.
        cell_m: distance between nodes.
        nodes: heights (rows along y, columns along x) in m, read-only.
    """

    def __init__(self, road_map: RoadMap, config: SceneConfig, seed: int) -> None:
        flat = np.concatenate([lane.points[:, :2] for lane in road_map.lanes])
        low, high = flat.min(axis=0) - MARGIN_M, flat.max(axis=0) + MARGIN_M
        self.cell_m = CELL_M
        while np.prod((high - low) / self.cell_m) > MAX_TERRAIN_NODES:
            self.cell_m *= 2
        self.origin: Floats = np.floor(low / self.cell_m) * self.cell_m
        columns, rows = (int(n) + 2 for n in (high - self.origin) / self.cell_m)
        shape = (rows, columns)
        road = road_relief(road_map, self.origin, self.cell_m, shape)
        waves = undulation(self.origin, self.cell_m, shape, stream(seed, "terrain"))
        self.nodes: Floats = np.ascontiguousarray(road + waves * config.terrain_amplitude_m)
        self.nodes.setflags(write=False)

    def height_m(self, xy: npt.ArrayLike) -> Floats:
        """Returns the ground's height at places (N, 2); beyond the grid, that of its border."""
        places = np.ascontiguousarray(np.asarray(xy, np.float64).reshape(-1, 2))
        result = np.empty(len(places))
        _heights(self.nodes, self.origin, self.cell_m, places, result)
        return result

    def body_poses(self, x: npt.ArrayLike, y: npt.ArrayLike, yaw: npt.ArrayLike) -> Floats:
        """Returns poses (N, 6) of bodies whose four wheels stand on the ground.

        Args:
            x: of the footprints' centres (N,), m.
            y: the same.
            yaw: headings (N,), rad CCW from +x.
        """
        plane = np.ascontiguousarray(np.column_stack([x, y, yaw]), np.float64)
        result = np.empty((len(plane), 6))
        _stand(self.nodes, self.origin, self.cell_m, plane, result)
        return result


_GRID = "Array(float64, 2, 'C', readonly=True), float64[::1], float64"


@njit(f"float64({_GRID}, float64, float64)", cache=True)
def _height(nodes: Floats, origin: Floats, cell_m: float, x: float, y: float) -> float:
    """Interpolates within the triangle of the ground mesh: cells are cut from low to high x, y."""
    rows, columns = nodes.shape
    u = min(max((x - origin[0]) / cell_m, 0.0), columns - 1.000001)
    v = min(max((y - origin[1]) / cell_m, 0.0), rows - 1.000001)
    i, j = int(v), int(u)
    u -= j
    v -= i
    low, high = nodes[i, j], nodes[i + 1, j + 1]
    if u >= v:
        corner = nodes[i, j + 1]
        return float(low + u * (corner - low) + v * (high - corner))
    corner = nodes[i + 1, j]
    return float(low + v * (corner - low) + u * (high - corner))


@njit(f"void({_GRID}, Array(float64, 2, 'C', readonly=True), float64[::1])", cache=True)
def _heights(nodes: Floats, origin: Floats, cell_m: float, xy: Floats, result: Floats) -> None:
    for n in range(len(xy)):
        result[n] = _height(nodes, origin, cell_m, xy[n, 0], xy[n, 1])


@njit(f"void({_GRID}, float64[:,::1], float64[:,::1])", cache=True)
def _stand(nodes: Floats, origin: Floats, cell_m: float, plane: Floats, result: Floats) -> None:
    for n in range(len(plane)):
        x, y, yaw = plane[n, 0], plane[n, 1], plane[n, 2]
        ax, ay = math.cos(yaw) * _HALF_WHEELBASE_M, math.sin(yaw) * _HALF_WHEELBASE_M
        bx, by = -math.sin(yaw) * _HALF_TRACK_M, math.cos(yaw) * _HALF_TRACK_M
        front_left = _height(nodes, origin, cell_m, x + ax + bx, y + ay + by)
        front_right = _height(nodes, origin, cell_m, x + ax - bx, y + ay - by)
        rear_left = _height(nodes, origin, cell_m, x - ax + bx, y - ay + by)
        rear_right = _height(nodes, origin, cell_m, x - ax - bx, y - ay - by)
        climb = (front_left + front_right - rear_left - rear_right) / (4 * _HALF_WHEELBASE_M)
        bank = (front_left + rear_left - front_right - rear_right) / (4 * _HALF_TRACK_M)
        result[n, 0] = x
        result[n, 1] = y
        result[n, 2] = (front_left + front_right + rear_left + rear_right) / 4
        result[n, 3] = math.atan(bank * math.cos(math.atan(climb)))
        result[n, 4] = -math.atan(climb)  # nose up is negative about y, which points left
        result[n, 5] = yaw


_BLOCK = 4  # cells along a block's side
_FINE_WITHIN_M = 60.0  # of the road

Blocks = npt.NDArray[np.int8]
_NONE, _COARSE, _FINE = 0, 1, 2


def ground(terrain: Terrain, road: RoadArea) -> TriangleMesh:
    """Returns the ground's mesh; blocks that no sensor on the road sees are omitted."""
    rows, columns = terrain.nodes.shape
    blocks = _levels(terrain, road, ((rows - 1) // _BLOCK, (columns - 1) // _BLOCK))
    triangles = np.concatenate(
        [_fine_triangles(blocks, columns), _coarse_triangles(blocks, columns)]
    )
    is_used = np.zeros(rows * columns, np.bool_)
    is_used[triangles] = True
    used, renamed = np.flatnonzero(is_used), np.cumsum(is_used) - 1
    row, column = np.divmod(used, columns)
    vertices = np.column_stack(
        [
            terrain.origin[0] + column * terrain.cell_m,
            terrain.origin[1] + row * terrain.cell_m,
            terrain.nodes[row, column],
        ]
    )
    return TriangleMesh.of(vertices, renamed[triangles])


def _levels(terrain: Terrain, road: RoadArea, shape: tuple[int, int]) -> Blocks:
    size_m = _BLOCK * terrain.cell_m
    row, column = np.indices(shape)
    middle: Floats = terrain.origin + (np.stack([column, row], -1) + 0.5) * size_m
    clearance = road.clearance_m(middle, MARGIN_M + size_m).reshape(shape) - size_m * 0.71
    levels = np.where(clearance < _FINE_WITHIN_M, _FINE, _COARSE)
    return np.where(clearance < MARGIN_M, levels, _NONE).astype(np.int8)


def _fine_triangles(blocks: Blocks, columns: int) -> npt.NDArray[np.int64]:
    """Cells are cut from low to high x and y, as `Terrain` interpolates."""
    row, column = np.nonzero(blocks == _FINE)
    step = np.arange(_BLOCK)
    i = (row[:, None, None] * _BLOCK + step[:, None]).repeat(_BLOCK, 2).ravel()
    j = (column[:, None, None] * _BLOCK + step[None, :]).repeat(_BLOCK, 1).ravel()
    low = i * columns + j
    right, up, high = low + 1, low + columns, low + columns + 1
    return np.concatenate([np.stack([low, right, high], -1), np.stack([low, high, up], -1)])


def _coarse_triangles(blocks: Blocks, columns: int) -> npt.NDArray[np.int64]:
    """A fan from each block's middle; a side shared with a fine block takes all nodes there."""
    row, column = np.nonzero(blocks == _COARSE)
    is_fine = np.pad(blocks == _FINE, 1)
    sides = np.stack([is_fine[row + 1 + di, column + 1 + dj] for di, dj in _SIDES], -1)
    kinds = list(product((False, True), repeat=len(_SIDES)))
    fans = [_fan(dict(zip(_SIDES, kind, strict=True)), columns) for kind in kinds]
    kind = sides @ (8, 4, 2, 1)
    size = np.array([len(fan) for fan in fans])
    block = np.repeat(np.arange(len(kind)), size[kind])
    nth = (np.cumsum(size) - size)[kind[block]] + count_up(size[kind])
    low = (row * columns + column) * _BLOCK
    return np.asarray(low[block, None] + np.concatenate(fans)[nth])


_SIDES = ((-1, 0), (0, 1), (1, 0), (0, -1))


def _fan(is_fine: Mapping[tuple[int, int], bool], columns: int) -> npt.NDArray[np.int64]:
    """Returns triangles (N, 3) counter-clockwise from a block's low corner, which is node 0."""
    south, east, north, west = (range(0, _BLOCK, 1 if is_fine[side] else _BLOCK) for side in _SIDES)
    ring = (
        [(0, n) for n in south]
        + [(n, _BLOCK) for n in east]
        + [(_BLOCK, _BLOCK - n) for n in north]
        + [(_BLOCK - n, 0) for n in west]
    )
    node = np.array([i * columns + j for i, j in ring])
    hub = np.full(len(node), _BLOCK // 2 * (columns + 1))
    return np.stack([hub, node, np.roll(node, -1)], -1)
