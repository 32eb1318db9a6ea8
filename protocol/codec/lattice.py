"""The lattice of an octree's points, and their order.

A body-centred cubic lattice: of all lattices known it covers space with the fewest nodes for a
largest distance, 1.86 times fewer than a cubic grid (Conway and Sloane, Sphere Packings, Lattices
and Groups, chapter 2). A node is a cell of a cubic grid and one bit, whether it is the cell's
corner or its middle.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from protocol.codec.rans import I8, U8, i64, u64
from protocol.scans import Floats

_RADIX = 11  # bits that are sorted at a time
_COVERING = 4.0 / math.sqrt(5.0)  # edge of a cell by how far a place can be from the nearest node


def lattice_edge_m(room_m: float) -> float:
    """Returns the edge of a cell for which every place is within `room_m` of a node."""
    return room_m * _COVERING


@njit("void(float64[:,::1], float64[::1], float64[::1])", cache=True, nogil=True)
def fill_corners(points: Floats, low: Floats, high: Floats) -> None:
    """Fills the lowest and the highest coordinate on each axis of points (N, 3)."""
    low[:], high[:] = points[0], points[0]
    for n in range(1, len(points)):
        for axis in range(3):
            low[axis] = min(low[axis], points[n, axis])
            high[axis] = max(high[axis], points[n, axis])


@njit("int64(float64[:,::1], float64[::1], float64, int64[:,::1], uint64[::1])", cache=True,
      nogil=True)  # fmt: skip
def fill_nodes(points: Floats, low: Floats, edge_m: float, cells: I8, keys: U8) -> int:
    """Fills the cell (N, 3) and the key (N,) of each point's node; returns the largest coordinate.

    A key is the Morton key of the cell, z highest, and below it whether the node is the cell's
    middle.
    """
    largest = 0
    whole, half = np.empty(3, np.int64), np.empty(3, np.int64)
    for n in range(len(points)):
        to_corner = to_middle = 0.0
        for axis in range(3):
            place = (points[n, axis] - low[axis]) / edge_m
            whole[axis], half[axis] = i64(np.floor(place + 0.5)), i64(np.floor(place))
            to_corner += (place - whole[axis]) ** 2
            to_middle += (place - half[axis] - 0.5) ** 2
        middle = to_middle < to_corner
        key = u64(0)
        for axis in range(3):
            cell = half[axis] if middle else whole[axis]
            cells[n, axis] = cell
            largest = max(largest, cell)
            v = u64(cell) & u64(0x1FFFFF)
            v = (v | (v << u64(32))) & u64(0x1F00000000FFFF)
            v = (v | (v << u64(16))) & u64(0x1F0000FF0000FF)
            v = (v | (v << u64(8))) & u64(0x100F00F00F00F00F)
            v = (v | (v << u64(4))) & u64(0x10C30C30C30C30C3)
            v = (v | (v << u64(2))) & u64(0x1249249249249249)
            key |= v << u64(axis)
        keys[n] = (key << u64(1)) | u64(middle)
    return largest


@njit("void(uint64[::1], int64, int64[::1])", cache=True, nogil=True)
def sort_keys(keys: U8, bits: int, order: I8) -> None:
    """Sorts keys (N,) by their lowest bits and fills their order; equal ones keep theirs."""
    points, passes = len(keys), max(1, (bits + _RADIX - 1) // _RADIX)
    for n in range(points):
        order[n] = n
    other, of_other = np.empty(points, np.uint64), np.empty(points, np.int64)
    starts = np.empty(1 << _RADIX, np.int64)
    for turn in range(passes):
        shift, mask = u64(turn * _RADIX), u64((1 << _RADIX) - 1)
        starts[:] = 0
        for n in range(points):
            starts[(keys[n] >> shift) & mask] += 1
        below = 0
        for digit in range(1 << _RADIX):
            below, starts[digit] = below + starts[digit], below
        for n in range(points):
            digit = (keys[n] >> shift) & mask
            other[starts[digit]], of_other[starts[digit]] = keys[n], order[n]
            starts[digit] += 1
        keys[:], order[:] = other, of_other
