"""Ground removal: the planes that RANSAC finds, one after the other (Chen et al. 2022).

The paper fits planes to the whole cloud. A road climbs metres over an approach and bends a little
everywhere, so that its far ends lie off any one plane. Here planes are fitted tile by tile, to
heights over the road map: a plane must be nearly parallel to the mapped road and near it, and the
mapped road itself is the first hypothesis. Near a sensor a car's side holds more points than the
ground around it; so each square metre has one vote, its lowest point. `tile_m=None` fits the whole
cloud, every point alike, without the map.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from perception.arrays import Floats, Floats32, Ints
from perception.config import GroundConfig

CELL_M = 1.0  # of a tile, hypotheses are scored on the lowest point of each cell
SAMPLE = 4096  # of the whole cloud, on every n-th point
WALL_DEG = 20.0  # a plane through the whole cloud that is steeper than this is a wall
LEAST_INLIERS = 6
LEAST_SHARE = 0.2  # of the sample: a plane with less support need not be found
CONFIDENCE = 0.99
_CHANCE = "Tuple((float64, float64, float64, int64))"


def remove_ground(
    points: Floats32, road_m: Floats32, *, config: GroundConfig, rng: np.random.Generator
) -> tuple[Floats32, Floats32]:
    """Takes points (N, 3), map frame, on the ground away; `road_m` (N,) is the map's height there.

    Returns:
        The points above the ground (M, 3) and the height of the ground below each (M,): the
        plane's where one was found, else the road map's.
    """
    by_tiles = config.tile_m is not None
    points, road_m = points.copy(), road_m.copy()
    base_m = road_m if by_tiles else np.zeros_like(road_m)
    ground_m = np.full(len(points), np.nan, np.float32)
    slope_deg, offset_m = config.max_slope_deg, config.max_offset_m
    if not by_tiles:
        slope_deg, offset_m = WALL_DEG, np.inf
    limits = np.array([config.distance_m, np.tan(np.radians(slope_deg)), offset_m])
    band = np.array([-np.inf if by_tiles else -config.distance_m, config.distance_m])
    for _ in range(config.runs):
        if len(points) < LEAST_INLIERS:
            break
        low_high = _span(points)
        tiles = _squares(low_high, config.tile_m or np.inf)
        if by_tiles:
            voters = _lowest(points, base_m, _squares(low_high, CELL_M))
        else:
            voters = np.arange(0, len(points), max(len(points) // SAMPLE, 1))
        votes = np.column_stack([points[voters, :2], points[voters, 2] - base_m[voters]])
        work = np.array([config.max_iterations, rng.integers(2**62)])
        planes = _fit_all(*_by_tile(votes, tiles), limits, work)
        kept = _remove(points, base_m, ground_m, tiles, planes, band)
        points, base_m, ground_m = points[:kept], base_m[:kept], ground_m[:kept]
    return points, np.where(np.isnan(ground_m), road_m[: len(points)], ground_m)


def _squares(span: Floats, side_m: float) -> Floats:
    """Returns a grid (5,) over a span: origin x and y, squares per metre, columns, rows.

    Its lines are fixed in the map. An infinite side gives one square.
    """
    low, high = span
    if np.isinf(side_m):
        return np.array([*low, 0, 1, 1], np.float64)
    first = np.floor(low / side_m)
    return np.array([*(first * side_m), 1 / side_m, *(np.floor(high / side_m) - first + 1)])


@njit("float64[:,::1](float32[:,::1])", cache=True)
def _span(points: Floats32) -> Floats:
    """Returns the lowest and the highest x and y as (2, 2)."""
    span = np.array([[np.inf, np.inf], [-np.inf, -np.inf]])
    for index in range(points.shape[0]):
        for axis in range(2):
            span[0, axis] = min(span[0, axis], points[index, axis])
            span[1, axis] = max(span[1, axis], points[index, axis])
    return span


@njit("int64(float32, float32, float64[::1])", cache=True)
def _square(x: float, y: float, grid: Floats) -> int:
    """Returns the square of a grid in which a point lies."""
    column = min(max(int((x - grid[0]) * grid[2]), 0), int(grid[3]) - 1)
    row = min(max(int((y - grid[1]) * grid[2]), 0), int(grid[4]) - 1)
    return row * int(grid[3]) + column


@njit("int64[::1](float32[:,::1], float32[::1], float64[::1])", cache=True)
def _lowest(points: Floats32, base_m: Floats32, cells: Floats) -> Ints:
    """Returns the index of the point that lies lowest over the base, for each cell with points."""
    lowest = np.full(int(cells[3] * cells[4]), -1, np.int64)
    for index in range(points.shape[0]):
        cell = _square(points[index, 0], points[index, 1], cells)
        held = lowest[cell]
        if held < 0 or points[index, 2] - base_m[index] < points[held, 2] - base_m[held]:
            lowest[cell] = index
    return lowest[lowest >= 0]


@njit("int64(uint64[::1])", cache=True)
def _draw(state: Ints) -> int:
    """Splitmix64: the next number of a sequence that any machine repeats."""
    state[0] += np.uint64(0x9E3779B97F4A7C15)
    z = state[0]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return int((z ^ (z >> np.uint64(31))) >> np.uint64(2))


@njit("int64(float32[:,::1], float64, float64, float64, float64)", cache=True, fastmath=True)
def _support(sample: Floats32, a: float, b: float, c: float, reach_m: float) -> int:
    """Counts the points of a sample (3, K) within reach of z = a x + b y + c."""
    slope_x, slope_y, height = np.float32(a), np.float32(b), np.float32(c)
    reach = np.float32(reach_m)
    count = 0
    for index in range(sample.shape[1]):
        off = sample[2, index] - slope_x * sample[0, index] - slope_y * sample[1, index] - height
        count += abs(off) <= reach
    return count


@njit(f"{_CHANCE}(float32[:,::1], float64, float64, float64, float64)", cache=True, fastmath=True)
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


@njit("int64(float64, int64)", cache=True)
def _enough(share: float, max_iterations: int) -> int:
    """Returns after how many draws of 3 points a plane with this share was hardly missed."""
    miss = 1.0 - min(share**3, 1.0 - 1e-9)
    return min(max_iterations, int(np.log(1.0 - CONFIDENCE) / np.log(miss)) + 1)


@njit(f"{_CHANCE}(float32[:,::1], float64[::1], int64, uint64[::1])", cache=True)
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


def _by_tile(votes: Floats32, tiles: Floats) -> tuple[Floats32, Ints]:
    """Sorts votes by their tile; tile t has those from starts[t] to starts[t + 1]."""
    places = ((votes[:, :2] - tiles[:2]) * tiles[2]).astype(np.int64)
    column, row = np.clip(places, 0, tiles[3:].astype(np.int64) - 1).T
    tile_of = row * int(tiles[3]) + column
    members = np.bincount(tile_of, minlength=int(tiles[3] * tiles[4]))
    order = np.argsort(tile_of, kind="stable")
    return np.ascontiguousarray(votes[order]), np.concatenate([[0], np.cumsum(members)])


@njit("float64[:,::1](float32[:,::1], int64[::1], float64[::1], int64[::1])", cache=True)
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
    "int64(float32[:,::1], float32[::1], float32[::1], float64[::1], float64[:,::1], float64[::1])",
    cache=True,
)
def _remove(
    points: Floats32,
    base_m: Floats32,
    ground_m: Floats32,
    grid: Floats,
    planes: Floats,
    band: Floats,
) -> int:
    """Moves the points off their tile's plane to the front, in order; returns their number."""
    kept = 0
    for index in range(points.shape[0]):
        a, b, c = planes[_square(points[index, 0], points[index, 1], grid)]
        plane_m = a * points[index, 0] + b * points[index, 1] + c + base_m[index]
        if not np.isnan(a):
            off_m = (points[index, 2] - plane_m) / np.sqrt(1.0 + a * a + b * b)
            if band[0] <= off_m <= band[1]:
                continue
        for axis in range(3):
            points[kept, axis] = points[index, axis]
        base_m[kept] = base_m[index]
        ground_m[kept] = plane_m if np.isnan(ground_m[index]) else ground_m[index]
        kept += 1
    return kept
