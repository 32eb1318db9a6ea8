"""Unordered clouds as sections of a payload: cells on a grid, sorted, as an octree."""

from __future__ import annotations

import math
import struct

import numpy as np
import numpy.typing as npt

from protocol.codec.octree import (
    CONTEXTS,
    MAX_DEPTH,
    STRIDE,
    describe_tree,
    most_symbols,
    restore_tree,
    symbol_room,
    unweave,
    weave,
)
from protocol.codec.payload import Reader
from protocol.codec.symbols import open_symbols, pack_symbols, read_raw
from protocol.errors import CodecError
from protocol.scans import Floats, Floats32

_HEAD = struct.Struct("<dddB")
_MOST_SYMBOLS_OF_A_CELL = 32


def cell_edge_m(room_m: float) -> float:
    """Returns the edge of a cell whose corners are `room_m` from its middle."""
    return 2.0 * room_m / math.sqrt(3.0)


def pack_tree(points: Floats, edge_m: float) -> tuple[list[bytes], npt.NDArray[np.int64]]:
    """Returns the sections of a cloud (N, 3), and the order (N,) in which its points come back.

    Raises:
        CodecError: the cloud is too wide for cells of this edge, or too regular.
    """
    if not len(points):
        return [], np.zeros(0, np.int64)
    low = points.min(axis=0)
    cells = np.floor((points - low) / edge_m).astype(np.int64)
    depth = int(cells.max()).bit_length()
    if depth > MAX_DEPTH:
        raise CodecError(
            f"a coordinate lies {(points.max(axis=0) - low).max():.1f} m from another: at this "
            f"bound the form ends at {edge_m * 2**MAX_DEPTH:.1f} m"
        )
    keys = np.empty(len(points), np.uint64)
    weave(cells, keys)
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    depth = max(depth, 1)
    symbols = np.empty(symbol_room(len(points), depth), np.uint16)
    raw = np.empty(2 * len(points) + 2, np.uint32)
    counts, sizes = np.zeros((CONTEXTS, STRIDE), np.int64), np.zeros(2, np.int64)
    describe_tree(keys, depth, symbols, raw, counts, sizes)
    sections = pack_symbols(symbols, int(sizes[0]), counts)
    if sizes[0] > most_symbols(len(sections[1]) // 2):
        raise CodecError(f"{len(points)} points lie too regularly for a tree")
    bits = raw[: sizes[1]].astype("<u4", copy=False).tobytes()
    return [_HEAD.pack(*(low + edge_m / 2), depth), *sections, bits], order


def open_tree(reader: Reader, points: int, edge_m: float) -> Floats32:
    """Reads the sections of `pack_tree` and returns points (N, 3).

    Raises:
        CodecError: the sections are damaged.
    """
    if points == 0:
        return np.zeros((0, 3), np.float32)
    head = reader.section()
    if len(head) != _HEAD.size:
        raise CodecError(f"a tree has a head of {len(head)} bytes, needs {_HEAD.size}")
    *middle, depth = _HEAD.unpack(head)
    if not (np.isfinite(middle).all() and np.abs(middle).max() < 1e9 and 1 <= depth <= MAX_DEPTH):
        raise CodecError(f"a tree claims depth {depth} at {middle}")
    stream = open_symbols(reader, CONTEXTS, _MOST_SYMBOLS_OF_A_CELL)
    raw = read_raw(reader.section())
    keys = np.empty(points, np.uint64)
    status = restore_tree(
        stream.words, stream.end, raw, stream.table_of, stream.slots, stream.place, depth, keys
    )
    if status < 0:
        raise CodecError("a tree is damaged, or holds other than the points it claims")
    keys.sort()
    cells = np.empty((points, 3), np.int64)
    unweave(keys, cells)
    found: Floats32 = (cells * edge_m + np.array(middle)).astype(np.float32)
    return found
