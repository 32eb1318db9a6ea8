"""Clustering: DBSCAN (Ester et al. 1996), exact, on a grid.

Cells have the side eps / sqrt(3), so that points of one cell are always neighbours: a cell with
`min_points` holds core points only, and cells are joined whole. Occupied cells are sorted; for
half of the surrounding columns of cells a window walks along with them, which finds all
neighbouring pairs without a hash table. Whether two cells have neighbouring points is decided in
bounded time (`near`).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from perception.arrays import Bytes, Floats, Floats32, Ints, Ints32
from perception.cells import Cells
from perception.config import ClusterConfig

FEW = 32  # points of a set: fewer are compared, not parted
LIMIT = 256  # looks at a point, all in all


@njit("float64(float32[:,::1], int64, int64)", cache=True, nogil=True)
def apart(points: Floats32, i: int, j: int) -> float:
    """Returns the squared distance between two points."""
    x = np.float64(points[i, 0]) - points[j, 0]
    y = np.float64(points[i, 1]) - points[j, 1]
    z = np.float64(points[i, 2]) - points[j, 2]
    return float(x * x + y * y + z * z)


@njit("int64[::1](uint8[::1], int64, int64)", cache=True, nogil=True)
def _chosen(core: Bytes, first: int, end: int) -> Ints:
    """Returns which points of a range are core points."""
    result = np.empty(end - first, np.int64)
    count = 0
    for index in range(first, end):
        result[count] = index
        count += core[index]
    return result[:count].copy()


@njit("void(float32[:,::1], int64[::1], float32[::1])", cache=True, nogil=True)
def _span(points: Floats32, some: Ints, bounds: Floats32) -> None:
    """Writes the lowest and highest x, y and z (6,) of some points."""
    bounds[:3], bounds[3:] = np.inf, -np.inf
    for index in some:
        for axis in range(3):
            at = points[index, axis]
            bounds[axis], bounds[3 + axis] = min(bounds[axis], at), max(bounds[3 + axis], at)


@njit("UniTuple(float64, 2)(float32[::1], float32[::1])", cache=True, nogil=True)
def _gap(a: Floats32, b: Floats32) -> tuple[float, float]:
    """Returns the squares of how near and how far apart points within two bounds (6,) can be."""
    near_m2 = far_m2 = 0.0
    for axis in range(3):
        above, below = np.float64(b[axis]) - a[3 + axis], np.float64(a[axis]) - b[3 + axis]
        near_m = max(max(above, below), 0.0)
        far_m = max(np.float64(b[3 + axis]) - a[axis], np.float64(a[3 + axis]) - b[axis])
        near_m2, far_m2 = near_m2 + near_m * near_m, far_m2 + far_m * far_m
    return near_m2, far_m2


@njit("int64(float32[:,::1], int64[::1], float32[::1])", cache=True, nogil=True)
def _part(points: Floats32, some: Ints, bounds: Floats32) -> int:
    """Sorts some points by which half of their bounds they lie in; returns how many come first."""
    axis, widest_m = 0, -1.0
    for candidate in range(3):
        side_m = np.float64(bounds[3 + candidate]) - bounds[candidate]
        if side_m > widest_m:
            axis, widest_m = candidate, side_m
    middle = (np.float64(bounds[axis]) + bounds[3 + axis]) / 2
    count = 0
    for place in range(some.size):
        if points[some[place], axis] <= middle:
            some[place], some[count] = some[count], some[place]
            count += 1
    return count


@njit("boolean(float32[:,::1], int64[::1], int64[::1], float64)", cache=True, nogil=True)
def _compare(points: Floats32, a: Ints, b: Ints, square_m2: float) -> bool:
    for i in a:
        for j in b:
            if apart(points, i, j) <= square_m2:
                return True
    return False


@njit("boolean(float32[:,::1], int64[::1], int64[::1], float64)", cache=True, nogil=True)
def _by_parts(points: Floats32, a: Ints, b: Ints, square_m2: float) -> bool:
    """Parts the wider of two sets until bounds, or a few comparisons, decide.

    Contrived sets, whose points all lie very close to the limit, are taken for near once that took
    too long.
    """
    left = LIMIT * (a.size + b.size)
    bounds_a, bounds_b = np.empty(6, np.float32), np.empty(6, np.float32)
    todo = [(0, a.size, 0, b.size)]
    while todo:
        first_a, end_a, first_b, end_b = todo.pop()
        some_a, some_b = a[first_a:end_a], b[first_b:end_b]
        _span(points, some_a, bounds_a)
        _span(points, some_b, bounds_b)
        left -= some_a.size + some_b.size
        near_m2, far_m2 = _gap(bounds_a, bounds_b)
        if near_m2 > square_m2:
            continue
        if far_m2 <= square_m2 or left < 0:
            return True
        if some_a.size <= FEW and some_b.size <= FEW:
            if _compare(points, some_a, some_b, square_m2):
                return True
            left -= some_a.size * some_b.size
        elif (bounds_a[3:] - bounds_a[:3]).max() >= (bounds_b[3:] - bounds_b[:3]).max():
            middle = first_a + _part(points, some_a, bounds_a)
            todo.append((first_a, middle, first_b, end_b))
            todo.append((middle, end_a, first_b, end_b))
        else:
            middle = first_b + _part(points, some_b, bounds_b)
            todo.append((first_a, end_a, first_b, middle))
            todo.append((first_a, end_a, middle, end_b))
    return False


@njit(
    "boolean(float32[:,::1], uint8[::1], UniTuple(int64, 2), UniTuple(int64, 2), float64)",
    cache=True,
    nogil=True,
)
def near(
    points: Floats32, core: Bytes, one: tuple[int, int], other: tuple[int, int], square_m2: float
) -> bool:
    """Whether two ranges have core points that are neighbours."""
    a, b = _chosen(core, one[0], one[1]), _chosen(core, other[0], other[1])
    return bool(_by_parts(points, a, b, square_m2))


NOISE = -1
_AROUND = np.array([(x, y) for x in range(-2, 3) for y in range(-2, 3)])
_SHRINK = 0.9999  # keeps float32 rounding from making two points of a cell no neighbours

_PATIENCE = 16  # comparisons a point, before cells are parted


def cluster(points: Floats32, *, config: ClusterConfig) -> Ints32:
    """Returns the cluster of each point (N,), numbered by their first points; -1 is noise.

    A border point goes to the cluster of its nearest core point.
    """
    if len(points) == 0:
        return np.zeros(0, np.int32)
    cells = Cells.of(points, config.eps_m / np.sqrt(3) * _SHRINK)
    pairs = _pairs(cells.keys, _windows(cells.stride))
    labels = _label(cells.points, cells.starts, pairs, config.eps_m**2, config.min_points)
    return np.asarray(_numbered(labels, cells.order))


def _windows(stride: Ints) -> Ints:
    """Returns the first and last key difference (13, 2) to half of the cells within two steps.

    A column's cells lie side by side: there are 12 columns ahead, and the cells above one's own.
    """
    columns = _AROUND @ stride[:2]
    ahead = columns[columns > 0]
    return np.concatenate([[[1, 2]], np.stack([ahead - 2, ahead + 2], -1)])


@njit("int64(int64[::1], int64)", cache=True, nogil=True)
def _root(parents: Ints, cell: int) -> int:
    while parents[cell] != cell:
        parents[cell] = parents[parents[cell]]
        cell = parents[cell]
    return cell


def _pairs(cells: Ints, windows: Ints) -> Ints:
    """Returns all pairs (P, 2) of occupied cells that may hold neighbours."""
    pairs = np.empty((16 * len(cells), 2), np.int64)
    count = _pair_up(cells, windows, pairs)
    if count > len(pairs):  # one in three of the 62 cells around each is occupied, or more
        pairs = np.empty((count, 2), np.int64)
        _pair_up(cells, windows, pairs)
    return pairs[:count]


@njit("int64(int64[::1], int64[:,::1], int64[:,::1])", cache=True, nogil=True)
def _pair_up(cells: Ints, windows: Ints, pairs: Ints) -> int:
    """Writes as many pairs as fit; returns how many there are."""
    count = 0
    for window in range(windows.shape[0]):
        first = 0
        for cell in range(cells.size):
            low, high = cells[cell] + windows[window, 0], cells[cell] + windows[window, 1]
            while first < cells.size and cells[first] < low:
                first += 1
            other = first
            while other < cells.size and cells[other] <= high:
                if count < pairs.shape[0]:
                    pairs[count, 0], pairs[count, 1] = cell, other
                count += 1
                other += 1
    return count


@njit(
    "void(float32[:,::1], int32[::1], int64, int64, float64, int64, int32[::1])",
    cache=True,
    nogil=True,
)
def _count(
    points: Floats32,
    starts: Ints32,
    cell: int,
    other: int,
    square_m2: float,
    enough: int,
    neighbours: Ints32,
) -> None:
    """Adds the points of another cell that are neighbours, for those that lack some."""
    for i in range(starts[cell], starts[cell + 1]):
        for j in range(starts[other], starts[other + 1]):
            if neighbours[i] >= enough:
                break
            if apart(points, i, j) <= square_m2:
                neighbours[i] += 1


@njit(
    "uint8[::1](float32[:,::1], int32[::1], int64[:,::1], float64, int64)", cache=True, nogil=True
)
def _core(
    points: Floats32, starts: Ints32, pairs: Ints, square_m2: float, min_points: int
) -> Bytes:
    """Marks the points with enough neighbours; only in thin cells need they be counted."""
    assert points.shape[1] == 3
    neighbours = np.empty(points.shape[0], np.int32)
    for cell in range(starts.size - 1):
        neighbours[starts[cell] : starts[cell + 1]] = starts[cell + 1] - starts[cell]
    for pair in range(pairs.shape[0]):
        a, b = pairs[pair, 0], pairs[pair, 1]
        if starts[a + 1] - starts[a] < min_points:
            _count(points, starts, a, b, square_m2, min_points, neighbours)
        if starts[b + 1] - starts[b] < min_points:
            _count(points, starts, b, a, square_m2, min_points, neighbours)
    return (neighbours >= min_points).astype(np.uint8)


@njit("float32[:,::1](float32[:,::1], int32[::1])", cache=True, nogil=True)
def _bounds(points: Floats32, starts: Ints32) -> Floats32:
    """Returns the lowest and highest x, y and z in each cell (C, 6)."""
    assert points.shape[1] == 3
    bounds = np.empty((starts.size - 1, 6), np.float32)
    for cell in range(starts.size - 1):
        low_x = low_y = low_z = np.float32(np.inf)
        high_x = high_y = high_z = np.float32(-np.inf)
        for i in range(starts[cell], starts[cell + 1]):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            low_x, high_x = x if x < low_x else low_x, x if x > high_x else high_x
            low_y, high_y = y if y < low_y else low_y, y if y > high_y else high_y
            low_z, high_z = z if z < low_z else low_z, z if z > high_z else high_z
        bounds[cell] = np.array([low_x, low_y, low_z, high_x, high_y, high_z], np.float32)
    return bounds


@njit(
    "boolean(float32[:,::1], uint8[::1], int32[::1], float32[:,::1], int64, int64, float64)",
    cache=True,
    nogil=True,
)
def _touch(
    points: Floats32,
    core: Bytes,
    starts: Ints32,
    bounds: Floats32,
    cell: int,
    other: int,
    square_m2: float,
) -> bool:
    """Whether two cells have core points that are neighbours."""
    if _gap(bounds[cell], bounds[other])[0] > square_m2:
        return False
    first, end = starts[other], starts[other + 1]
    patience = _PATIENCE * (starts[cell + 1] - starts[cell] + end - first) + FEW * FEW
    for i in range(starts[cell], starts[cell + 1]):
        if not core[i]:
            continue
        gap_m2 = 0.0
        for axis in range(3):
            at = np.float64(points[i, axis])
            gap_m = max(max(bounds[other, axis] - at, at - bounds[other, 3 + axis]), 0.0)
            gap_m2 += gap_m * gap_m
        if gap_m2 > square_m2:
            continue
        for j in range(first, end):
            if core[j] and apart(points, i, j) <= square_m2:
                return True
        patience -= end - first
        if patience < 0:
            return bool(
                near(points, core, (starts[cell], starts[cell + 1]), (first, end), square_m2)
            )
    return False


@njit(
    "void(float32[:,::1], uint8[::1], int32[::1], int64, int64, int64, int32[::1], float64[::1])",
    cache=True,
    nogil=True,
)
def _adopt(
    points: Floats32,
    core: Bytes,
    starts: Ints32,
    cell: int,
    other: int,
    root: int,
    labels: Ints32,
    nearest_m2: Floats,
) -> None:
    """Gives a cell's border points to the other cell's cluster where its core points are nearer."""
    for i in range(starts[cell], starts[cell + 1]):
        if core[i]:
            continue
        for j in range(starts[other], starts[other + 1]):
            apart_m2 = apart(points, i, j)
            nearer = apart_m2 < nearest_m2[i] or (labels[i] == NOISE and apart_m2 <= nearest_m2[i])
            if core[j] and nearer:
                labels[i], nearest_m2[i] = root, apart_m2


@njit(
    "int32[::1](float32[:,::1], int32[::1], int64[:,::1], float64, int64)",
    cache=True,
    nogil=True,
)
def _label(
    points: Floats32, starts: Ints32, pairs: Ints, square_m2: float, min_points: int
) -> Ints32:
    """Returns the cell that stands for each point's cluster, or -1; points lie cell by cell."""
    assert points.shape[1] == 3
    core = _core(points, starts, pairs, square_m2, min_points)
    bounds = _bounds(points, starts)
    parents = np.arange(bounds.shape[0])
    for pair in range(pairs.shape[0]):
        a, b = pairs[pair, 0], pairs[pair, 1]
        root_a, root_b = _root(parents, a), _root(parents, b)
        if root_a != root_b and _touch(points, core, starts, bounds, a, b, square_m2):
            parents[max(root_a, root_b)] = min(root_a, root_b)
    labels, nearest_m2 = np.empty(points.shape[0], np.int32), np.empty(points.shape[0])
    for cell in range(bounds.shape[0]):
        root = parents[cell] = _root(parents, cell)
        labels[starts[cell] : starts[cell + 1]] = root
        if starts[cell + 1] - starts[cell] >= min_points:
            continue  # all of them are core points
        for i in range(starts[cell], starts[cell + 1]):
            labels[i], nearest_m2[i] = root if core[i] else NOISE, square_m2
        _adopt(points, core, starts, cell, cell, root, labels, nearest_m2)
    for pair in range(pairs.shape[0]):
        a, b = pairs[pair, 0], pairs[pair, 1]
        if starts[a + 1] - starts[a] < min_points:
            _adopt(points, core, starts, a, b, parents[b], labels, nearest_m2)
        if starts[b + 1] - starts[b] < min_points:
            _adopt(points, core, starts, b, a, parents[a], labels, nearest_m2)
    return labels


@njit("void(int32[::1])", cache=True, nogil=True)
def renumber(labels: Ints32) -> None:
    """Numbers clusters from 0 in the order of their first points."""
    highest = NOISE
    for label in labels:
        highest = max(highest, label)
    new = np.full(highest + 1, NOISE, np.int32)
    following = 0
    for index in range(labels.size):
        label = labels[index]
        if label == NOISE:
            continue
        if new[label] == NOISE:
            new[label] = following
            following += 1
        labels[index] = new[label]


@njit("int32[::1](int32[::1], int32[::1])", cache=True, nogil=True)
def _numbered(labels: Ints32, order: Ints32) -> Ints32:
    """Brings labels back into the points' order and numbers clusters by their first points."""
    result = np.empty_like(labels)
    for place in range(labels.size):
        result[np.uint32(order[place])] = labels[place]
    renumber(result)
    return result
