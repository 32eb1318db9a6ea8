"""Points grouped by the cell of a cubic grid (voxel) in which they lie."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from perception.arrays import Floats32, Ints, Ints32

_MIX = 0x9E3779B97F4A7C15  # of Fibonacci hashing: neighbouring keys go far apart


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """Occupied cells, by key, ascending; within a cell points keep the order they came in.

    Cell c has `points` (N, 3) from `starts[c]` to `starts[c + 1]`; `order` (N,) says where each of
    them stood. `keys` (C,) step by `stride` (3,) along x, y and z, and no step of up to two cells
    along one axis leads into another row's.
    """

    points: Floats32
    order: Ints32
    keys: Ints
    starts: Ints32
    stride: Ints

    @classmethod
    def of(cls, points: Floats32, side_m: float) -> Cells:
        """Sorts points (N, 3) into cells of such a side."""
        keys, stride = _keys(points, side_m)
        ordered, order, found, starts = grouped(points, keys, True)
        return cls(ordered, order, found, starts, stride)


@njit("int64(int32[::1], int64[::1], int64)", cache=True, nogil=True)
def _slot(slots: Ints32, keys: Ints, key: int) -> int:
    """Returns where in a hash table a key stands or, if it does not, would stand."""
    mask = np.uint64(slots.size - 1)
    slot = ((np.uint64(key) * np.uint64(_MIX)) >> np.uint64(32)) & mask
    while slots[slot] >= 0 and keys[slots[slot]] != key:
        slot = (slot + np.uint64(1)) & mask
    return int(slot)


@njit("Tuple((int32[::1], int64[::1]))(int64[::1], int32[::1])", cache=True, nogil=True)
def numbered(keys: Ints, first: Ints32) -> tuple[Ints32, Ints]:
    """Numbers cells as they are met: that of each run (R,), and their keys (C,)."""
    room = 2
    while room < 2 * first.size:
        room *= 2
    slots = np.full(room, -1, np.int32)
    found, cell_of = np.empty(first.size, np.int64), np.empty(first.size, np.int32)
    count = 0
    for run in range(first.size):
        slot = _slot(slots, found, keys[first[run]])
        if slots[slot] < 0:
            slots[slot], found[count] = count, keys[first[run]]
            count += 1
        cell_of[run] = slots[slot]
    return cell_of, found[:count].copy()


@njit("Tuple((int64[::1], int64[::1]))(float32[:,::1], float64)", cache=True, nogil=True)
def _keys(points: Floats32, side_m: float) -> tuple[Ints, Ints]:
    """Returns each point's key (N,), and how far keys step along x, y and z."""
    assert points.shape[1] == 3
    low_x = low_y = low_z = np.float32(np.inf)
    high_y = high_z = np.float32(-np.inf)
    for index in range(points.shape[0]):
        x, y, z = points[index, 0], points[index, 1], points[index, 2]
        low_x = x if x < low_x else low_x
        low_y, high_y = y if y < low_y else low_y, y if y > high_y else high_y
        low_z, high_z = z if z < low_z else low_z, z if z > high_z else high_z
    # Empty cells on either side of each row, so that no step of two runs into the next one.
    per_m = 1.0 / side_m
    rows = np.int64((np.float64(high_y) - low_y) * per_m) + 5
    layers = np.int64((np.float64(high_z) - low_z) * per_m) + 5
    x0, y0, z0 = np.float64(low_x), np.float64(low_y), np.float64(low_z)
    step_x, step_y = rows * layers, layers
    keys = np.empty(points.shape[0], np.int64)
    for place in range(points.shape[0]):
        point = np.uint64(place)
        x, y, z = points[point, 0] - x0, points[point, 1] - y0, points[point, 2] - z0
        column, row, layer = np.int32(x * per_m), np.int32(y * per_m), np.int32(z * per_m)
        keys[point] = column * step_x + row * step_y + layer
    return keys, np.array([step_x, step_y, 1])


@njit("int32[::1](int64[::1])", cache=True, nogil=True)
def runs(keys: Ints) -> Ints32:
    """Returns where each run of points with one key begins: in a scan, cells come in runs."""
    first = np.empty(keys.size + 1, np.int32)
    count = 0
    for index in range(keys.size):
        first[count] = index
        count += index == 0 or keys[index] != keys[index - 1]
    first[count] = keys.size
    return first[: count + 1].copy()


@njit(
    "Tuple((float32[:,::1], int32[::1], int64[::1], int32[::1]))"
    "(float32[:,::1], int64[::1], boolean)",
    cache=True,
    nogil=True,
)
def grouped(points: Floats32, keys: Ints, ascending: bool) -> tuple[Floats32, Ints32, Ints, Ints32]:
    """Brings points (N, 3) together by their keys (N,), quickly where these come in runs.

    Returns:
        The points, by keys and, within, as they came; where each stood (N,); the keys (C,),
        `ascending` or else as they were met; where the points of each begin, with N at the end
        (C + 1,).
    """
    assert points.shape[1] == 3
    first = runs(keys)
    cell_of, found = numbered(keys, first[:-1])
    rank = np.argsort(found) if ascending else np.arange(found.size)
    members = np.zeros(found.size, np.int32)
    for run in range(cell_of.size):
        members[cell_of[run]] += first[run + 1] - first[run]
    starts = np.zeros(found.size + 1, np.int32)
    following = np.empty(found.size, np.int32)
    for cell in range(found.size):
        following[rank[cell]] = starts[cell]
        starts[cell + 1] = starts[cell] + members[rank[cell]]
    order, ordered = np.empty(points.shape[0], np.int32), np.empty_like(points)
    for run in range(cell_of.size):
        begin, end, place = first[run], first[run + 1], following[cell_of[run]]
        following[cell_of[run]] += end - begin
        for index in range(begin, end):
            for axis in range(3):
                ordered[place, axis] = points[index, axis]
            order[place] = index
            place += 1
    return ordered, order, found[rank], starts
