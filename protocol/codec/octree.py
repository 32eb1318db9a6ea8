"""Unordered points as an octree, breadth first: which eighths of a cell hold points.

Points become cells of a grid, their Morton keys are sorted. A cell with one point is not divided
further; its remaining bits are as good as random and are raw (as in Draco's kd-tree). Which eighths
are occupied takes two symbols of four bits each; the context of the first is how many eighths the
parent had, that of the second is the first.
"""

from __future__ import annotations

import math
import struct

import numpy as np
import numpy.typing as npt
from numba import njit

from protocol.codec.payload import Reader
from protocol.codec.rans import (
    I8,
    SHARES,
    START,
    STATES,
    TAIL_ALPHABET,
    TURN_SHIFT,
    U1,
    U2,
    U4,
    advance,
    i64,
    is_short,
    refill,
    tail_base,
    tail_bits,
    tail_token,
    u64,
)
from protocol.codec.symbols import pack_symbols, read_raw, unpack_symbols
from protocol.errors import CodecError
from protocol.limits import (
    FREE_TREE_SYMBOLS,
    MAX_TREE_DEPTH,
    MAX_TREE_ORIGIN_M,
    TREE_SYMBOLS_PER_WORD,
)
from protocol.scans import Floats, Floats32

U8 = npt.NDArray[np.uint64]

STRIDE = TAIL_ALPHABET
_FIRST, _SECOND, _LONE, _COUNT = 0, 16, 32, 53
CONTEXTS = 54


@njit("int64(int64)", cache=True, nogil=True)
def most_symbols(words: int) -> int:
    """Returns how many symbols may stand in so many words of the entropy coder.

    One that is certain takes next to no bits, so that a few bytes could hold millions of them.
    """
    return FREE_TREE_SYMBOLS + TREE_SYMBOLS_PER_WORD * words


def symbol_room(points: int, depth: int) -> int:
    """Returns how many symbols a tree can have at most."""
    return points * (depth * 3 + 2) + 8


@njit("void(int64[:,::1], uint64[::1])", cache=True, nogil=True)
def morton_keys(cells: I8, keys: U8) -> None:
    """Fills the Morton keys (N,) of cells (N, 3), z highest."""
    for n in range(len(keys)):
        key = u64(0)
        for axis in range(3):
            v = u64(cells[n, axis]) & u64(0x1FFFFF)
            v = (v | (v << u64(32))) & u64(0x1F00000000FFFF)
            v = (v | (v << u64(16))) & u64(0x1F0000FF0000FF)
            v = (v | (v << u64(8))) & u64(0x100F00F00F00F00F)
            v = (v | (v << u64(4))) & u64(0x10C30C30C30C30C3)
            v = (v | (v << u64(2))) & u64(0x1249249249249249)
            key |= v << u64(axis)
        keys[n] = key


@njit("void(uint64[::1], int64[:,::1])", cache=True, nogil=True)
def morton_cells(keys: U8, cells: I8) -> None:
    """Reverses `morton_keys`."""
    for n in range(len(keys)):
        for axis in range(3):
            v = (keys[n] >> u64(axis)) & u64(0x1249249249249249)
            v = (v | (v >> u64(2))) & u64(0x10C30C30C30C30C3)
            v = (v | (v >> u64(4))) & u64(0x100F00F00F00F00F)
            v = (v | (v >> u64(8))) & u64(0x1F0000FF0000FF)
            v = (v | (v >> u64(16))) & u64(0x1F00000000FFFF)
            v = (v | (v >> u64(32))) & u64(0x1FFFFF)
            cells[n, axis] = i64(v)


@njit(
    "void(uint64[::1], int64, uint16[::1], uint32[::1], int64[:,::1], int64[::1])",
    cache=True,
    nogil=True,
)
def tree_to_symbols(keys: U8, depth: int, symbols: U2, raw: U4, counts: I8, sizes: I8) -> None:
    """Turns sorted keys into symbols and raw bits.

    Args:
        keys: (N,), sorted.
        depth: of the tree.
        symbols: filled with `state << TURN_SHIFT | context * STRIDE + token`.
        raw: filled with raw bits.
        counts: zeros (CONTEXTS, STRIDE); filled with how often each symbol occurs.
        sizes: filled with the number of symbols and of raw words.
    """
    points = len(keys)
    starts, ends = np.zeros((2, points + 1), np.int64), np.zeros((2, points + 1), np.int64)
    crowds = np.zeros((2, points + 1), np.int64)
    inside, token_of = np.zeros(8, np.int64), np.zeros(18, np.int64)
    context_of = np.zeros(18, np.int64)
    ends[0, 0], crowds[0, 0], cells = points, 7, min(points, 1)
    count, words, held = 0, 0, 0
    bits = u64(0)
    for level in range(depth - 1, -1, -1):
        now, then = (depth - 1 - level) & 1, (depth - level) & 1
        born = 0
        for cell in range(cells):
            at, end = starts[now, cell], ends[now, cell]
            for n in range(8):
                inside[n] = 0
            for n in range(at, end):
                inside[i64(keys[n] >> u64(3 * level)) & 7] += 1
            occupied, crowd = 0, 0
            for n in range(8):
                if inside[n] > 0:
                    occupied |= 1 << n
                    crowd += 1
            context_of[0] = _FIRST + crowds[now, cell] + 8 * (level < 3)
            token_of[0] = occupied >> 4
            context_of[1], token_of[1] = _SECOND + (occupied >> 4), occupied & 15
            used = 2
            for n in range(8):
                if inside[n] == 0:
                    continue
                extra, length = u64(0), 0
                if level == 0:
                    token = tail_token(inside[n] - 1)
                    context_of[used], token_of[used] = _COUNT, token
                    length = tail_bits(token)
                    extra = u64(inside[n] - 1 - tail_base(token))
                else:
                    lone = inside[n] == 1
                    context_of[used], token_of[used] = _LONE + level, 1 if lone else 0
                    if lone:
                        length = 3 * level
                        extra = keys[at] & ((u64(1) << u64(length)) - u64(1))
                    else:
                        starts[then, born], ends[then, born] = at, at + inside[n]
                        crowds[then, born] = crowd - 1
                        born += 1
                used += 1
                at += inside[n]
                while length > 0:
                    part = min(length, 30)
                    bits |= (extra & u64((1 << part) - 1)) << u64(held)
                    extra >>= u64(part)
                    length -= part
                    held += part
                    if held >= 32:
                        raw[words] = np.uint32(bits & u64(0xFFFFFFFF))
                        words += 1
                        bits >>= u64(32)
                        held -= 32
            for n in range(used):
                symbols[count] = (count & 7) << TURN_SHIFT | (context_of[n] * STRIDE + token_of[n])
                counts[context_of[n], token_of[n]] += 1
                count += 1
        cells = born
    if held > 0:
        raw[words] = np.uint32(bits & u64(0xFFFFFFFF))
        words += 1
    sizes[0], sizes[1] = count, words


@njit(
    "int64(uint16[::1], int64, uint32[::1], uint8[::1], uint8[::1], uint32[::1], int64, "
    "uint64[::1])",
    cache=True,
    nogil=True,
)
def symbols_to_tree(
    words: U2, end: int, raw: U4, table_of: U1, slots: U1, place: U4, depth: int, keys: U8
) -> int:
    """Reverses `tree_to_symbols`, but for the order; returns 0, or -1 if the payload is damaged.

    Args:
        words: of the entropy coder, and 32 zeros behind them.
        end: how many words are not such zeros.
        raw: the raw bits.
        table_of: the table of each context.
        slots: (tables * 4096,), of `open_tables`.
        place: (tables * STRIDE,), of `open_tables`.
        depth: of the tree.
        keys: (N,), filled.
    """
    points = len(keys)
    prefixes, crowds = np.empty((2, points + 1), np.uint64), np.empty((2, points + 1), np.int8)
    prefixes[0, 0] = 0
    states = np.empty(STATES, np.uint64)
    for n in range(STATES):
        states[n] = (u64(words[2 * n]) << u64(16)) | u64(words[2 * n + 1])
    at_word, at_raw, held, count, found = 2 * STATES, 0, 0, 0, 0
    most = most_symbols(end)
    bits = u64(0)
    crowds[0, 0], cells = 7, min(points, 1)
    for level in range(depth - 1, -1, -1):
        now, then = (depth - 1 - level) & 1, (depth - level) & 1
        born = 0
        for cell in range(cells):
            if at_word > end or count > most:
                return -1
            prefix = prefixes[now, cell] << u64(3)
            occupied, crowd, octant, step = 0, 0, 0, 0
            while step < 2 or octant < 8:
                if step == 0:
                    context = _FIRST + i64(crowds[now, cell]) + 8 * (level < 3)
                elif step == 1:
                    context = _SECOND + occupied
                elif not (occupied >> octant) & 1:
                    octant += 1
                    continue
                else:
                    context = _LONE + level if level > 0 else _COUNT
                table = i64(table_of[context])
                state = states[count & 7]
                token = i64(slots[table << 12 | i64(state & u64(SHARES - 1))])
                state = advance(state, place[table << 6 | token])
                states[count & 7] = refill(state, words[at_word])
                at_word += i64(is_short(state))
                count += 1
                step += 1
                if step == 1:
                    occupied = token & 15
                    continue
                if step == 2:
                    occupied = occupied << 4 | (token & 15)
                    for n in range(8):
                        crowd += (occupied >> n) & 1
                    continue
                key = prefix | u64(octant)
                octant += 1
                if level > 0 and token == 0:
                    if born >= points:
                        return -1
                    prefixes[then, born], crowds[then, born] = key, crowd - 1
                    born += 1
                    continue
                length = 3 * level if level > 0 else tail_bits(token)
                extra, filled = u64(0), 0
                while filled < length:
                    part = min(length - filled, 30)
                    if held < part:
                        if at_raw >= len(raw):
                            return -1
                        bits |= u64(raw[at_raw]) << u64(held)
                        at_raw += 1
                        held += 32
                    piece = bits & u64((1 << part) - 1)
                    extra |= piece << u64(filled)
                    bits >>= u64(part)
                    held -= part
                    filled += part
                copies = 1
                if level == 0:
                    copies = tail_base(token) + 1 + i64(extra)
                    extra = u64(0)
                if copies > points - found:
                    return -1
                for _ in range(copies):
                    keys[found] = (key << u64(3 * level)) | extra
                    found += 1
        cells = born
    if at_word != end or at_raw != len(raw) or found != points or cells != 0:
        return -1
    for n in range(STATES):
        if states[n] != u64(START):
            return -1
    return 0


_HEAD = struct.Struct("<dddB")
_SYMBOLS_PER_CELL = 32


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
    if depth > MAX_TREE_DEPTH:
        raise CodecError(
            f"a coordinate lies {(points.max(axis=0) - low).max():.1f} m from another: at this "
            f"bound the form ends at {edge_m * 2**MAX_TREE_DEPTH:.1f} m"
        )
    keys = np.empty(len(points), np.uint64)
    morton_keys(cells, keys)
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    depth = max(depth, 1)
    symbols = np.empty(symbol_room(len(points), depth), np.uint16)
    raw = np.empty(2 * len(points) + 2, np.uint32)
    counts, sizes = np.zeros((CONTEXTS, STRIDE), np.int64), np.zeros(2, np.int64)
    tree_to_symbols(keys, depth, symbols, raw, counts, sizes)
    sections = pack_symbols(symbols, int(sizes[0]), counts)
    if sizes[0] > most_symbols(len(sections[1]) // 2):
        raise CodecError(f"{len(points)} points lie too regularly for a tree")
    bits = raw[: sizes[1]].astype("<u4", copy=False).tobytes()
    return [_HEAD.pack(*(low + edge_m / 2), depth), *sections, bits], order


def unpack_tree(reader: Reader, points: int, edge_m: float) -> Floats32:
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
    if not (
        np.isfinite(middle).all()
        and np.abs(middle).max() < MAX_TREE_ORIGIN_M
        and 1 <= depth <= MAX_TREE_DEPTH
    ):
        raise CodecError(f"a tree claims depth {depth} at {middle}")
    stream = unpack_symbols(reader, CONTEXTS, _SYMBOLS_PER_CELL)
    raw = read_raw(reader.section())
    keys = np.empty(points, np.uint64)
    status = symbols_to_tree(
        stream.words, stream.end, raw, stream.table_of, stream.slots, stream.place, depth, keys
    )
    if status < 0:
        raise CodecError("a tree is damaged, or holds other than the points it claims")
    keys.sort()
    cells = np.empty((points, 3), np.int64)
    morton_cells(keys, cells)
    found: Floats32 = (cells * edge_m + np.array(middle)).astype(np.float32)
    return found
