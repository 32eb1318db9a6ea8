"""Ground removal by RANSAC plane fitting, tile by tile (after Chen et al. 2022).

The paper fits planes to the whole cloud. A road climbs metres over an approach and bends a little
everywhere, so that its far ends lie off any one plane. Here planes are fitted tile by tile, to
heights over the road map: a plane must be nearly parallel to the mapped road and near it, and the
mapped road itself is the first hypothesis. Near a sensor a car's side holds more points than the
ground around it; so each square metre has one vote, its lowest point. Far away a tile may hold no
more than a piece of one ring on the road: where no plane is found, what lies on the mapped road
goes. `tile_m=None` fits the whole cloud, every point alike, without the map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numba import njit

from perception.arrays import Bools, Floats, Floats32, Ints, Ints32
from perception.config import GroundConfig
from perception.parallel import each
from perception.roadway import Placed
from perception.votes import BLOCK, VOTE_CELL_M, lowest, span, squares, squares_of

SAMPLE = 4096  # of the whole cloud, on every n-th point
WALL_DEG = 20.0  # a plane through the whole cloud that is steeper than this is a wall
LEAST_INLIERS = 6
LEAST_SHARE = 0.2  # of the sample: a plane with less support need not be found
CONFIDENCE = 0.99
_PART = "Tuple((float32[:,::1], float32[::1], float32[::1]))"
_CHANCE = "Tuple((float64, float64, float64, int64))"


Part = tuple[Floats32, Floats32, Floats32]  # points (N, 3), heights (N,) of road and ground


def remove_ground(
    parts: Sequence[Placed], *, config: GroundConfig, rng: np.random.Generator
) -> tuple[Floats32, Floats32, Ints]:
    """Removes points on the ground, of all parts of a cloud together.

    Returns:
        The points above the ground (M, 3), map frame, in the order of the parts; the height of
        the ground below each (M,): the plane's where one was found, else the road map's; and how
        many are of each part (P,).
    """
    by_tiles = config.tile_m is not None
    slope_deg, offset_m = config.max_slope_deg, config.max_offset_m
    if not by_tiles:
        slope_deg, offset_m = WALL_DEG, np.inf
    limits = np.array([config.distance_m, np.tan(np.radians(slope_deg)), offset_m])
    left = [_Left.of(part) for part in parts]
    area = squares(_around([part.lowest for part in parts]), VOTE_CELL_M)
    for _ in range(config.runs):
        if sum(len(part.points) for part in left) < LEAST_INLIERS:
            break
        votes = _by_area(left, area) if by_tiles else _by_point(left)
        tiles = squares(span(votes), config.tile_m or np.inf)
        work = np.array([config.max_iterations, rng.integers(2**62)])
        planes = _fit_all(*_by_tile(votes, tiles), limits, work)
        layers = _layers(planes, config.distance_m, bottomless=by_tiles)
        left = each(partial(_without, tiles=tiles, layers=layers, over_road=by_tiles), left)
    if by_tiles and config.runs:
        left = [part.off_road(config.distance_m) for part in left]
    points = np.concatenate([np.zeros((0, 3), np.float32), *(part.points for part in left)])
    ground_m = np.concatenate([np.zeros(0, np.float32), *(part.floor_m() for part in left)])
    return points, ground_m, np.array([len(part.points) for part in left], np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class _Left:
    """The remaining points of a part: points (N, 3), heights (N,) of road and ground.

    The ground's is NaN where no plane was found, and empty before any was looked for. `lowest`
    (V, 3) is as of `Placed`, once known.
    """

    points: Floats32
    road_m: Floats32
    ground_m: Floats32
    lowest: Floats32 | None = None

    @classmethod
    def of(cls, part: Placed) -> _Left:
        return cls(part.points, part.road_m, np.zeros(0, np.float32), part.lowest)

    def votes(self, area: Floats) -> Floats32:
        """Returns the lowest points, of an area's grid where they are not known."""
        return lowest(self.points, self.road_m, area) if self.lowest is None else self.lowest

    def off_road(self, distance_m: float) -> _Left:
        """Returns it without what lies on the mapped road where no plane was found."""
        has_plane = ~np.isnan(self.ground_m) if len(self.ground_m) else np.False_
        kept = has_plane | (np.abs(self.points[:, 2] - self.road_m) > distance_m)
        return _Left(self.points[kept], self.road_m[kept], self.floor_m()[kept])

    def floor_m(self) -> Floats32:
        """Returns the height of the ground below each point, or else the road's (N,)."""
        if len(self.ground_m) == 0:
            return self.road_m
        return np.where(np.isnan(self.ground_m), self.road_m, self.ground_m)


def _around(votes: Sequence[Floats32]) -> Floats:
    """Returns the span (2, 2) of all squares in which parts voted, and one around them."""
    both = span(np.concatenate([np.zeros((0, 3), np.float32), *votes]))
    return np.asarray(both + np.array([[-VOTE_CELL_M], [VOTE_CELL_M]]))


def _by_area(parts: Sequence[_Left], area: Floats) -> Floats32:
    """Returns one vote (V, 3) for each square metre: x, y and height over the road."""
    known = all(part.lowest is not None for part in parts)  # then there is nothing to compute
    ask = partial(_Left.votes, area=area)
    votes = np.concatenate([*map(ask, parts)] if known else each(ask, parts))
    return lowest(votes, np.zeros(len(votes), np.float32), area)


def _by_point(parts: Sequence[_Left]) -> Floats32:
    """Returns every n-th point (V, 3)."""
    points = np.concatenate([part.points for part in parts])
    return np.ascontiguousarray(points[:: max(len(points) // SAMPLE, 1)])


def _without(part: _Left, tiles: Floats, layers: Floats32, *, over_road: bool) -> _Left:
    """Returns the points that lie outside their tile's layer."""
    room = len(part.points) + 1  # one is written before it is known to stay
    kept = np.empty((room, 3), np.float32), np.empty(room, np.float32), np.empty(room, np.float32)
    given = part.points, part.road_m, part.ground_m
    count = _remove(given, tiles, layers, over_road, kept)
    return _Left(*(array[:count] for array in kept))


def _layers(planes: Floats, distance_m: float, *, bottomless: bool) -> Floats32:
    """Returns the ground's layer by tile, from planes (T, 3).

    Each is (T, 5): the plane, and the heights over it, straight up, between which points go; none
    where there is no plane.
    """
    reach_m = distance_m * np.sqrt(1.0 + planes[:, :1] ** 2 + planes[:, 1:2] ** 2)
    low_m = np.full_like(reach_m, -np.inf) if bottomless else -reach_m
    layers = np.column_stack([planes, low_m, reach_m]).astype(np.float32)
    layers[np.isnan(planes[:, 0])] = [np.nan, np.nan, np.nan, np.inf, -np.inf]
    return layers


@njit("int64(uint64[::1])", cache=True, nogil=True)
def _draw(state: Ints) -> int:
    """Splitmix64: the next number of a sequence that any machine repeats."""
    state[0] += np.uint64(0x9E3779B97F4A7C15)
    z = state[0]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return int((z ^ (z >> np.uint64(31))) >> np.uint64(2))


@njit(
    "int64(float32[:,::1], float64, float64, float64, float64)",
    cache=True,
    nogil=True,
    fastmath=True,
)
def _support(sample: Floats32, a: float, b: float, c: float, reach_m: float) -> int:
    """Counts the points of a sample (3, K) within reach of z = a x + b y + c."""
    slope_x, slope_y, height = np.float32(a), np.float32(b), np.float32(c)
    reach = np.float32(reach_m)
    count = 0
    for index in range(sample.shape[1]):
        off = sample[2, index] - slope_x * sample[0, index] - slope_y * sample[1, index] - height
        count += abs(off) <= reach
    return count


@njit(
    f"{_CHANCE}(float32[:,::1], float64, float64, float64, float64)",
    cache=True,
    nogil=True,
    fastmath=True,
)
def _refine(
    sample: Floats32, a: float, b: float, c: float, reach_m: float
) -> tuple[float, float, float, int]:
    """Least squares on the inliers: normal equations about their mean."""
    n, mx, my, mz = 0, 0.0, 0.0, 0.0
    for index in range(sample.shape[1]):
        x, y, z = sample[0, index], sample[1, index], sample[2, index]
        if abs(z - a * x - b * y - c) <= reach_m:
            n, mx, my, mz = n + 1, mx + x, my + y, mz + z
    if n < 3:
        return a, b, c, n
    mx, my, mz = mx / n, my / n, mz / n
    xx, xy, yy, xz, yz = 0.0, 0.0, 0.0, 0.0, 0.0
    for index in range(sample.shape[1]):
        x, y, z = sample[0, index], sample[1, index], sample[2, index]
        if abs(z - a * x - b * y - c) <= reach_m:
            x, y, z = x - mx, y - my, z - mz
            xx, xy, yy, xz, yz = xx + x * x, xy + x * y, yy + y * y, xz + x * z, yz + y * z
    determinant = xx * yy - xy * xy
    if determinant < 1e-3 * n:
        return a, b, c, n
    a = (xz * yy - yz * xy) / determinant
    b = (yz * xx - xz * xy) / determinant
    return a, b, mz - a * mx - b * my, n


@njit("int64(float64, int64)", cache=True, nogil=True)
def _enough(share: float, max_iterations: int) -> int:
    """Returns after how many draws of 3 points a plane with this share was hardly missed."""
    miss = 1.0 - min(share**3, 1.0 - 1e-9)
    return min(max_iterations, int(np.log(1.0 - CONFIDENCE) / np.log(miss)) + 1)


@njit(f"{_CHANCE}(float32[:,::1], float64[::1], int64, uint64[::1])", cache=True, nogil=True)
def _ransac(
    sample: Floats32, limits: Floats, max_iterations: int, state: Ints
) -> tuple[float, float, float, int]:
    """Finds the level plane with most support in a sample (3, K) around its own middle."""
    distance_m, max_slope, max_offset_m = limits
    size = sample.shape[1]
    best_a, best_b, best_c = 0.0, 0.0, 0.0
    best = _support(sample, best_a, best_b, best_c, distance_m)
    enough = _enough(max(best / size, LEAST_SHARE), max_iterations)
    iteration = 0
    while iteration < enough:
        iteration += 1
        i, j, k = _draw(state) % size, _draw(state) % size, _draw(state) % size
        ux, uy = sample[0, j] - sample[0, i], sample[1, j] - sample[1, i]
        vx, vy = sample[0, k] - sample[0, i], sample[1, k] - sample[1, i]
        cross = ux * vy - uy * vx
        if abs(cross) < 1e-2:
            continue
        uz, vz = sample[2, j] - sample[2, i], sample[2, k] - sample[2, i]
        a, b = (uz * vy - vz * uy) / cross, (vz * ux - uz * vx) / cross
        c = sample[2, i] - a * sample[0, i] - b * sample[1, i]
        if a * a + b * b > max_slope * max_slope or abs(c) > max_offset_m:
            continue
        reach_m = distance_m * np.sqrt(1.0 + a * a + b * b)
        count = _support(sample, a, b, c, reach_m)
        if count > best:
            best, best_a, best_b, best_c = count, a, b, c
            enough = _enough(max(best / size, LEAST_SHARE), max_iterations)
    return best_a, best_b, best_c, best


@njit("Tuple((float32[:,::1], int64[::1]))(float32[:,::1], float64[::1])", cache=True, nogil=True)
def _by_tile(votes: Floats32, tiles: Floats) -> tuple[Floats32, Ints]:
    """Sorts votes by their tile; tile t has those from starts[t] to starts[t + 1]."""
    starts = np.zeros(int(tiles[3] * tiles[4]) + 1, np.int64)
    tile_of = squares_of(votes, tiles)
    for tile in tile_of:
        starts[tile + 1] += 1
    starts = np.cumsum(starts)
    following, ordered = starts.copy(), np.empty_like(votes)
    for vote in range(votes.shape[0]):
        tile = tile_of[vote]
        ordered[following[tile]] = votes[vote]
        following[tile] += 1
    return ordered, starts


@njit(
    "float64[:,::1](float32[:,::1], int64[::1], float64[::1], int64[::1])", cache=True, nogil=True
)
def _fit_all(votes: Floats32, starts: Ints, limits: Floats, work: Ints) -> Floats:
    """Returns each tile's plane, height over base = a x + b y + c, as (T, 3); NaN for none.

    Votes are points (V, 3): x, y and height over the base.
    """
    max_iterations, seed = work
    tiles = starts.size - 1
    planes = np.full((tiles, 3), np.nan)
    state = np.zeros(1, np.uint64)
    for tile in range(tiles):
        first, size = starts[tile], starts[tile + 1] - starts[tile]
        if size < LEAST_INLIERS:
            continue
        x, y = 0.0, 0.0
        for vote in range(first, first + size):
            x, y = x + votes[vote, 0] / size, y + votes[vote, 1] / size
        sample = np.empty((3, size), np.float32)
        for slot in range(size):
            sample[0, slot] = votes[first + slot, 0] - x
            sample[1, slot] = votes[first + slot, 1] - y
            sample[2, slot] = votes[first + slot, 2]
        state[0] = np.uint64(seed) ^ (np.uint64(tile) * np.uint64(0xD1B54A32D192ED03))
        a, b, c, found = _ransac(sample, limits, max_iterations, state)
        if found >= LEAST_INLIERS:
            a, b, c, _ = _refine(sample, a, b, c, limits[0] * np.sqrt(1.0 + a * a + b * b))
            planes[tile, 0], planes[tile, 1], planes[tile, 2] = a, b, c - a * x - b * y
    return planes


@njit(
    "Tuple((float32[::1], boolean[::1]))"
    "(float32[:,::1], float32[::1], float64[::1], float32[:,::1], float32)",
    cache=True,
    nogil=True,
)
def _over_tiles(
    points: Floats32, road_m: Floats32, grid: Floats, layers: Floats32, share: float
) -> tuple[Floats32, Bools]:
    """Returns the height (B,) of the plane at a block's points, and which lie outside the layer.

    Points come in runs of one tile, for a sensor scans along its rings.
    """
    assert points.shape[1] == 3
    size = points.shape[0]
    tiles, plane_m, stays = (
        squares_of(points, grid),
        np.empty(size, np.float32),
        np.empty(size, np.bool_),
    )
    first = 0
    while first < size:
        tile, end = tiles[np.uint64(first)], first + 1
        while end < size and tiles[np.uint64(end)] == tile:
            end += 1
        along_x, along_y, middle_m, low_m, high_m = layers[tile]
        for place in range(first, end):
            index = np.uint64(place)
            x, y, z = points[index, 0], points[index, 1], points[index, 2]
            ground_m = along_x * x + along_y * y + middle_m
            ground_m += share * road_m[index]
            plane_m[index] = ground_m
            stays[index] = not ((low_m <= z - ground_m) & (z - ground_m <= high_m))
        first = end
    return plane_m, stays


@njit("int32[::1](boolean[::1])", cache=True, nogil=True)
def _chosen(stays: Bools) -> Ints32:
    """Returns the marked indices, without a branch, which would often be mispredicted."""
    chosen, count = np.empty(stays.size + 1, np.int32), np.uint64(0)
    for index in range(stays.size):
        chosen[count] = index
        count += np.uint64(stays[index])
    return chosen[:count]


@njit(
    f"int64({_PART}, float64[::1], float32[:,::1], boolean, {_PART})",
    cache=True,
    nogil=True,
)
def _remove(part: Part, grid: Floats, layers: Floats32, over_road: bool, kept: Part) -> int:
    """Copies the points outside their tile's layer, in order; returns their number."""
    points, road_m, ground_m = part
    kept_points, kept_road_m, kept_ground_m = kept
    assert points.shape[1] == kept_points.shape[1] == 3
    share, is_first, count = np.float32(1.0 if over_road else 0.0), ground_m.size == 0, 0
    for begin in range(0, points.shape[0], BLOCK):
        some, some_road_m = points[begin : begin + BLOCK], road_m[begin : begin + BLOCK]
        plane_m, stays = _over_tiles(some, some_road_m, grid, layers, share)
        for chosen in _chosen(stays):
            index = np.uint64(chosen)
            for axis in range(3):
                kept_points[count, axis] = some[index, axis]
            kept_road_m[count], kept_ground_m[count] = some_road_m[index], plane_m[index]
            if not is_first and not np.isnan(ground_m[begin + chosen]):
                kept_ground_m[count] = ground_m[begin + chosen]
            count += 1
    return count
