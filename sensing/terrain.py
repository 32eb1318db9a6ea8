"""Terrain: a grid of ground heights, how a body stands on it, and its mesh.

Where lanes pass over others there are several: the ground, and a grid for each level of decks.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np
import numpy.typing as npt
from numba import njit

from protocol.geometry import Floats
from protocol.roadmap import RoadMap
from sensing.config import SceneConfig
from sensing.decks import REACH_M, Bools, LanePlaces, by_level, deck_mesh
from sensing.limits import MAX_TERRAIN_NODES
from sensing.mesh import TriangleMesh, merge
from sensing.noise import stream
from sensing.road import RoadArea, count_up

_WAVES = ((48.0, 0.7), (17.0, 0.3))  # spacing of the undulation in m, share of its amplitude


def road_relief(
    places: LanePlaces, origin: Floats, cell_m: float, shape: tuple[int, int]
) -> tuple[Floats, Bools]:
    """Returns heights (rows, columns): the lanes' near them, smoothly interpolated elsewhere.

    And where lanes are near. Only sums and products are used, so that every machine finds the same
    numbers.
    """
    weight, total = np.zeros(shape), np.zeros(shape)
    reach = int(np.ceil(REACH_M / cell_m))
    step = np.arange(-reach, reach + 1)
    for number in np.unique(places.lane):
        lane = places.points[places.lane == number]
        grid = (lane[:, :2] - origin) / cell_m
        node = np.floor(grid).astype(np.int64)
        column = node[:, 0, None, None] + step[None, None, :]
        row = node[:, 1, None, None] + step[None, :, None]
        dx, dy = column - grid[:, 0, None, None], row - grid[:, 1, None, None]
        near = np.maximum(1.0 - (dx * dx + dy * dy) * (cell_m / REACH_M) ** 2, 0.0) ** 2
        column, row = np.broadcast_arrays(column, row)
        np.add.at(weight, (row, column), near)
        np.add.at(total, (row, column), near * lane[:, 2, None, None])
    return _spread(weight, total), weight > 0


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
    """Returns the road map that agents and edges use, with a map's height error.

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


@dataclass(frozen=True, slots=True, eq=False)
class _Surface:
    """Heights over a grid; `known` says at which nodes lanes are near.

    Nodes are (rows along y, columns along x); `origin` is x, y (2,) of the first.
    """

    origin: Floats
    cell_m: float
    nodes: Floats
    known: Bools

    def height_m(self, places: Floats) -> Floats:
        """Returns the height at places (N, 2); beyond the grid, that of its border."""
        result = np.empty(len(places))
        _heights(self.nodes, self.origin, self.cell_m, places, result)
        return result

    def is_known(self, places: Floats) -> Bools:
        """Whether lanes are near places (N, 2)."""
        column, row = np.rint((places - self.origin) / self.cell_m).astype(np.int64).T
        rows, columns = self.known.shape
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        at = np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)
        return np.asarray(inside & self.known[at])

    def stand(self, plane: Floats) -> Floats:
        """Returns poses (N, 6) of bodies at x, y, yaw (N, 3)."""
        result = np.empty((len(plane), 6))
        _stand(self.nodes, self.origin, self.cell_m, plane, result)
        return result


class Terrain:
    """A grid of heights, as the scene's ground mesh shows it, and those of decks over it.

    Attributes:
        origin: x, y (2,) of the grid's first node, in the map frame.
        cell_m: distance between nodes.
        nodes: heights (rows along y, columns along x) in m, read-only.
        deck_mesh: all decks; empty where no lane passes over another.
    """

    def __init__(self, road_map: RoadMap, config: SceneConfig, seed: int) -> None:
        flat = np.concatenate([lane.points[:, :2] for lane in road_map.lanes])
        low, high = flat.min(axis=0) - MARGIN_M, flat.max(axis=0) + MARGIN_M
        self.cell_m = CELL_M
        while np.prod((high - low) / self.cell_m) > MAX_TERRAIN_NODES:
            self.cell_m *= 2
        self.origin: Floats = np.floor(low / self.cell_m) * self.cell_m
        columns, rows = (int(n) + 2 for n in (high - self.origin) / self.cell_m)
        waves = undulation(self.origin, self.cell_m, (rows, columns), stream(seed, "terrain"))
        waves *= config.terrain_amplitude_m
        on_ground, on_decks = by_level(LanePlaces.of(road_map.lanes))
        self._ground = self._surface(on_ground, waves)
        self.nodes: Floats = self._ground.nodes
        self._decks = [self._deck(places, waves) for places in on_decks]
        self.deck_mesh = merge(
            deck_mesh(run, deck.height_m(np.ascontiguousarray(run.points[:, :2])))
            for deck, places in zip(self._decks, on_decks, strict=True)
            for run in places.runs()
        )

    def _surface(
        self, places: LanePlaces, waves: Floats, first: tuple[int, int] = (0, 0)
    ) -> _Surface:
        """Returns the surface under places on lanes, from a node (row, column) on."""
        origin = self.origin + np.array(first[::-1]) * self.cell_m
        relief, known = road_relief(places, origin, self.cell_m, waves.shape)
        nodes = np.ascontiguousarray(relief + waves)
        nodes.setflags(write=False)
        return _Surface(origin, self.cell_m, nodes, known)

    def _deck(self, places: LanePlaces, waves: Floats) -> _Surface:
        """Returns the surface of a deck, which undulates as the ground that it begins on does."""
        grid = (places.points[:, :2] - self.origin) / self.cell_m
        around = int(np.ceil(REACH_M / self.cell_m)) + 1
        left, low = np.floor(grid.min(axis=0)).astype(int) - around
        right, high = np.ceil(grid.max(axis=0)).astype(int) + around + 1
        return self._surface(places, waves[low:high, left:right], (int(low), int(left)))

    def height_m(self, xy: npt.ArrayLike, level_m: npt.ArrayLike | None = None) -> Floats:
        """Returns the ground's height at places (N, 2); beyond the grid, that of its border.

        With `level_m`, heights in m, the height of the deck or ground that is nearest to them.
        """
        places = np.ascontiguousarray(np.asarray(xy, np.float64).reshape(-1, 2))
        found = self._ground.height_m(places)
        for deck, chosen in self._on_decks(places, level_m):
            found[chosen] = deck.height_m(np.ascontiguousarray(places[chosen]))
        return found

    def body_poses(
        self,
        x: npt.ArrayLike,
        y: npt.ArrayLike,
        yaw: npt.ArrayLike,
        level_m: npt.ArrayLike | None = None,
    ) -> Floats:
        """Returns poses (N, 6) of bodies whose four wheels stand on the ground or on a deck.

        Args:
            x: of the footprints' centres (N,), m.
            y: the same.
            yaw: headings (N,), rad CCW from +x.
            level_m: height of their lanes (N,), which decides between ground and decks.
        """
        plane = np.ascontiguousarray(np.column_stack([x, y, yaw]), np.float64)
        found = self._ground.stand(plane)
        for deck, chosen in self._on_decks(np.ascontiguousarray(plane[:, :2]), level_m):
            found[chosen] = deck.stand(np.ascontiguousarray(plane[chosen]))
        return found

    def _on_decks(
        self, places: Floats, level_m: npt.ArrayLike | None
    ) -> Iterator[tuple[_Surface, Bools]]:
        """Yields each deck with the places (N,) on it."""
        if level_m is None or not self._decks:
            return
        meant = np.broadcast_to(np.asarray(level_m, np.float64), len(places))
        off_m = [np.abs(self._ground.height_m(places) - meant)]
        for deck in self._decks:
            here_m = np.abs(deck.height_m(places) - meant)
            off_m.append(np.where(deck.is_known(places), here_m, np.inf))
        nearest = np.argmin(off_m, axis=0)
        for number, deck in enumerate(self._decks, 1):
            yield deck, nearest == number


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
    """Returns the mesh of ground and decks; blocks that no sensor on the road sees are omitted."""
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
    mesh = TriangleMesh.of(vertices, renamed[triangles])
    return merge([mesh, terrain.deck_mesh]) if len(terrain.deck_mesh.triangles) else mesh


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
