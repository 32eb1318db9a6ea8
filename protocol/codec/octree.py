"""Unordered points as an octree, depth first, on the lattice of `lattice`.

A cell of the tree codes which of its octants hold points (two symbols of four bits, upper half
first), then which of these hold one point only. Those are not divided further: a symbol of up to
three bits codes where the point lies along each axis, the rest is as good as random and is raw (as
in Draco's kd-tree). A symbol codes whether it lies at the corner of its cell or at the middle.
Contexts are those of `tree_contexts`.
"""

from __future__ import annotations

import struct

import numpy as np
import numpy.typing as npt
from numba import njit

from protocol.codec.lattice import fill_corners, fill_nodes, sort_keys
from protocol.codec.payload import Reader
from protocol.codec.rans import (
    I8,
    SHARES,
    STATES,
    TURN_SHIFT,
    U1,
    U2,
    U4,
    U8,
    advance,
    i64,
    is_short,
    read_states,
    refill,
    states_are_final,
    tail_base,
    tail_bits,
    tail_token,
    u64,
)
from protocol.codec.symbols import pack_symbols, read_raw, unpack_symbols
from protocol.codec.tree_contexts import (
    CONTEXTS,
    COPIES,
    LOWER,
    STRIDE,
    UPPER,
    half_of,
    is_flat,
    level_of,
    lone_context,
    middle_context,
    place_context,
    quarter_of,
)
from protocol.errors import CodecError
from protocol.limits import (
    FREE_TREE_SYMBOLS,
    MAX_TREE_DEPTH,
    MAX_TREE_ORIGIN_M,
    TREE_SYMBOLS_PER_WORD,
)
from protocol.scans import Floats, Floats32

_COPIES_BITS = 20  # raw, of a count beyond the tokens
# The most that one cell may read before the decoder checks for the end of the data.
_SYMBOLS_PER_CELL = 40  # four of the cell, four of each of eight points
_SPARE = 24  # words of raw bits: three times 16 bits and 20 of each point, and one ahead
_SYMBOLS_PER_BIT = 6000  # that a table must save
_STACK = 7 * MAX_TREE_DEPTH + 8


@njit("int64(int64)", cache=True, nogil=True)
def most_symbols(words: int) -> int:
    """Returns how many symbols may stand in so many words of the entropy coder.

    One that is certain takes next to no bits, so that a few bytes could hold millions of them.
    """
    return FREE_TREE_SYMBOLS + TREE_SYMBOLS_PER_WORD * words


def symbol_room(points: int, depth: int) -> int:
    """Returns how many symbols a tree can have at most."""
    return points * (depth * 2 + 5) + 8  # a cell that is divided holds two points at least


@njit("int64(uint64[::1], int64, int64, uint64)", cache=True, nogil=True)
def _end_of_octant(keys: U8, start: int, end: int, shift: int) -> int:
    """Returns where the keys end that agree with the first above `shift`."""
    wanted, step, at = keys[start] >> shift, 1, start + 1
    while at < end and keys[at] >> shift == wanted:  # ever farther, then back between the last two
        step *= 2
        start, at = at, at + step
    at = min(at, end)
    while at - start > 1:
        between = (start + at) >> 1
        if keys[between] >> shift == wanted:
            start = between
        else:
            at = between
    return at


@njit(
    "void(uint64[::1], int64[:,::1], int64, uint32[::1], uint32[::1], int64[:,::1], int64[::1], "
    "int64[::1])",
    cache=True,
    nogil=True,
)
def tree_to_symbols(
    keys: U8,
    cells: I8,
    depth: int,
    symbols: U4,
    raw: U4,
    counts: I8,
    order: I8,
    sizes: I8,
) -> None:
    """Turns sorted nodes into symbols and raw bits.

    Args:
        keys: (N,), sorted.
        cells: (N, 3), in the same order.
        depth: of the tree.
        symbols: filled with `state << TURN_SHIFT | context * STRIDE + token`.
        raw: filled with raw bits.
        counts: zeros (CONTEXTS, STRIDE); filled with how often each symbol occurs.
        order: (N,), filled with the order in which the decoder places the nodes.
        sizes: filled with the number of symbols and of raw words.
    """
    starts, ends = np.empty(_STACK, np.int64), np.empty(_STACK, np.int64)
    levels, flats = np.empty(_STACK, np.int64), np.empty(_STACK, np.int64)
    first = np.empty(8, np.int64)
    contexts, tokens = np.empty(_SYMBOLS_PER_CELL, np.int64), np.empty(_SYMBOLS_PER_CELL, np.int64)
    last = np.zeros(3, np.int64)
    starts[0], ends[0], levels[0], flats[0], top = 0, len(keys), depth - 1, 0, 1
    x = y = z = alone = alone_before = middle = middle_before = i64(0)
    count, words, held, placed = 0, 0, 0, 0
    bits = u64(0)
    while top > 0:
        top -= 1
        start, end, level = starts[top], ends[top], levels[top]
        shift = u64(3 * level + 1)
        occupied, crowd = 0, 0
        n = start
        while n < end:
            octant = i64(keys[n] >> shift) & 7
            occupied |= 1 << octant
            first[octant] = n
            crowd += 1
            n = _end_of_octant(keys, n, end, shift)
        sides = 3 * half_of(x, cells[start, 0] >> (level + 1), level)
        sides += half_of(y, cells[start, 1] >> (level + 1), level)
        above = 2 * level - alone - alone_before
        contexts[0] = UPPER + 108 * i64(above > 0) + 54 * flats[top] + 6 * sides
        contexts[0] += quarter_of(z, cells[start, 2] >> (level + 1), level)
        contexts[1] = LOWER + 18 * (occupied >> 4) + 9 * flats[top] + sides
        tokens[0], tokens[1] = occupied >> 4, occupied & 15
        used, seen, pattern, behind, octant = 2, 0, 0, end, 8
        while octant > 0:
            octant -= 1
            if not (occupied >> octant) & 1:
                continue
            pattern = 2 * pattern + i64(behind - first[octant] == 1)
            behind = first[octant]
            seen += 1
            if seen == 4 or seen == crowd:
                contexts[used] = lone_context(crowd, i64(seen > 4), above)
                tokens[used] = pattern
                used, pattern = used + 1, 0
        behind = end
        for octant in range(7, -1, -1):
            if not (occupied >> octant) & 1:
                continue
            at, copies = first[octant], behind - first[octant]
            behind = at
            if level > 0 and copies > 1:
                starts[top], ends[top], levels[top] = at, at + copies, level - 1
                flats[top] = is_flat(occupied)
                top += 1
                continue
            if copies > 1:
                token = min(tail_token(copies - 2), STRIDE - 1)
                contexts[used], tokens[used] = COPIES + min(max(-alone, 0), 4), token
                used += 1
                bits |= u64(copies - 2 - tail_base(token)) << u64(held)
                held += _COPIES_BITS if token == STRIDE - 1 else tail_bits(token)
            fine = max(level - 3, 0)
            last[0], last[1], last[2] = x, y, z
            for axis in range(3):
                if held >= 32:
                    raw[words] = np.uint32(bits & u64(0xFFFFFFFF))
                    words += 1
                    bits >>= u64(32)
                    held -= 32
                if level > 0:
                    here = cells[at, axis]
                    context = place_context(last[axis], here >> level, level)
                    contexts[used] = context + 36 * i64(axis == 2)
                    tokens[used] = (here & ((1 << level) - 1)) >> fine
                    used += 1
                    bits |= u64(here & ((1 << fine) - 1)) << u64(held)
                    held += fine
            x, y, z = cells[at, 0], cells[at, 1], cells[at, 2]
            inner = 0
            for n in range(at, at + copies):
                inner += i64(keys[n] & u64(1))
                order[placed] = n
                placed += 1
            rise = z - last[2]
            contexts[used] = middle_context(copies, level, rise, middle, middle_before)
            tokens[used] = min(1 + inner, STRIDE - 1) if 0 < inner < copies else i64(inner > 0)
            if tokens[used] == STRIDE - 1:
                bits |= u64(inner) << u64(held)
                held += _COPIES_BITS
            used += 1
            middle, middle_before = i64(inner > 0), middle
            if held >= 32:
                raw[words] = np.uint32(bits & u64(0xFFFFFFFF))
                words += 1
                bits >>= u64(32)
                held -= 32
            alone, alone_before = level if level > 0 else level_of(copies), alone
        for n in range(used):
            symbols[count] = (count & 7) << TURN_SHIFT | (contexts[n] * STRIDE + tokens[n])
            counts[contexts[n], tokens[n]] += 1
            count += 1
    if held > 0:
        raw[words] = np.uint32(bits & u64(0xFFFFFFFF))
        words += 1
    sizes[0], sizes[1] = count, words


@njit(inline="always")
def _next(
    context: int, table_of: U1, slots: U1, place: U4, states: U8, words: U2, at: int, count: int
) -> tuple[int, int]:
    """Returns the next symbol of a context, and the word behind it."""
    table = u64(table_of[context])
    state = states[count & u64(7)]
    token = u64(slots[(table << u64(12)) | (state & u64(SHARES - 1))])
    state = advance(state, place[(table << u64(4)) | token])
    states[count & u64(7)] = refill(state, words[at])
    return i64(token), at + is_short(state)


@njit(inline="always")
def _bits(raw: U4, at: int, length: int) -> int:
    """Returns up to 32 raw bits."""
    word = at >> u64(5)
    both = u64(raw[word]) | (u64(raw[word + u64(1)]) << u64(32))
    value: int = i64((both >> (at & u64(31))) & ((u64(1) << u64(length)) - u64(1)))
    return value


@njit(
    "int64(uint16[::1], int64, uint32[::1], uint8[::1], uint8[::1], uint32[::1], int64, "
    "float64, float64[::1], float32[:,::1])",
    cache=True,
    nogil=True,
)
def symbols_to_points(
    words: U2,
    end: int,
    raw: U4,
    table_of: U1,
    slots: U1,
    place: U4,
    depth: int,
    edge_m: float,
    low: Floats,
    xyz: Floats32,
) -> int:
    """Reverses `tree_to_symbols` and places the points; returns 0, -1 if the payload is damaged.

    Args:
        words: of the entropy coder, and `_SYMBOLS_PER_CELL` zeros behind them.
        end: how many words are not such zeros.
        raw: the raw bits, and `_SPARE` zeros behind them.
        table_of: the table of each context.
        slots: (tables * 4096,), of `fill_lookup`.
        place: (tables * STRIDE,), of `fill_lookup`.
        depth: of the tree.
        edge_m: of a cell.
        low: (3,), where the first cell's corner is.
        xyz: (N, 3), filled.
    """
    stack = np.empty((_STACK, 5), np.int64)
    states = np.empty(STATES, np.uint64)
    read_states(words, states)
    points, most = len(xyz), u64(most_symbols(end))
    end_word, end_bit = u64(end), u64(32 * (len(raw) - _SPARE))
    at, bit, count, found, top = u64(2 * STATES), u64(0), u64(0), 0, min(points, 1)
    stack[0], stack[0, 3] = 0, depth - 1
    x = y = z = alone = alone_before = middle = middle_before = i64(0)
    while top > 0:
        if at > end_word or bit > end_bit or count > most:
            return -1
        top -= 1
        level, flat = stack[top, 3], stack[top, 4]
        cell_x, cell_y, cell_z = stack[top, 0], stack[top, 1], stack[top, 2]
        sides = 3 * half_of(x, cell_x, level) + half_of(y, cell_y, level)
        above = 2 * level - alone - alone_before
        context = UPPER + 108 * i64(above > 0) + 54 * flat + 6 * sides
        context += quarter_of(z, cell_z, level)
        upper, at = _next(context, table_of, slots, place, states, words, at, count)
        context = LOWER + 18 * upper + 9 * flat + sides
        lower, at = _next(context, table_of, slots, place, states, words, at, count + u64(1))
        count += u64(2)
        occupied, crowd = 16 * upper + lower, 0
        for octant in range(8):
            crowd += (occupied >> octant) & 1
        if crowd == 0:
            return -1
        context = lone_context(crowd, 0, above)
        lone, at = _next(context, table_of, slots, place, states, words, at, count)
        count += u64(1)
        if crowd > 4:
            context = lone_context(crowd, 1, above)
            token, at = _next(context, table_of, slots, place, states, words, at, count)
            count += u64(1)
            lone = (lone << (crowd - 4)) | (token & ((1 << (crowd - 4)) - 1))
        fine, mask = max(level - 3, 0), (1 << level) - 1
        for octant in range(7, -1, -1):
            if not (occupied >> octant) & 1:
                continue
            crowd -= 1
            single = (lone >> crowd) & 1
            child_x = 2 * cell_x + (octant & 1)
            child_y = 2 * cell_y + ((octant >> 1) & 1)
            child_z = 2 * cell_z + (octant >> 2)
            if level > 0 and not single:
                stack[top, 0], stack[top, 1], stack[top, 2] = child_x, child_y, child_z
                stack[top, 3], stack[top, 4] = level - 1, is_flat(occupied)
                top += 1
                continue
            copies, before_x, before_y, before_z = 1, x, y, z
            x, y, z = child_x << level, child_y << level, child_z << level
            if not single:
                context = COPIES + min(max(-alone, 0), 4)
                token, at = _next(context, table_of, slots, place, states, words, at, count)
                count += u64(1)
                length = _COPIES_BITS if token == STRIDE - 1 else tail_bits(token)
                copies = 2 + tail_base(token) + _bits(raw, bit, length)
                bit += u64(length)
            elif level > 0:
                context = place_context(before_x, child_x, level)
                token, at = _next(context, table_of, slots, place, states, words, at, count)
                x |= ((token << fine) & mask) | _bits(raw, bit, fine)
                bit += u64(fine)
                context = place_context(before_y, child_y, level)
                token, at = _next(
                    context, table_of, slots, place, states, words, at, count + u64(1)
                )
                y |= ((token << fine) & mask) | _bits(raw, bit, fine)
                bit += u64(fine)
                context = place_context(before_z, child_z, level) + 36
                token, at = _next(
                    context, table_of, slots, place, states, words, at, count + u64(2)
                )
                z |= ((token << fine) & mask) | _bits(raw, bit, fine)
                bit += u64(fine)
                count += u64(3)
            alone, alone_before = level if level > 0 else level_of(copies), alone
            if copies > points - found:
                return -1
            context = middle_context(copies, level, z - before_z, middle, middle_before)
            token, at = _next(context, table_of, slots, place, states, words, at, count)
            count += u64(1)
            inner = copies * token if token < 2 else token - 1
            if token == STRIDE - 1:
                inner = _bits(raw, bit, _COPIES_BITS)
                bit += u64(_COPIES_BITS)
            middle, middle_before = i64(inner > 0), middle
            for n in range(copies):
                half = 0.5 if copies - n <= inner else 0.0
                xyz[found, 0] = np.float32((x + half) * edge_m + low[0])
                xyz[found, 1] = np.float32((y + half) * edge_m + low[1])
                xyz[found, 2] = np.float32((z + half) * edge_m + low[2])
                found += 1
    if at != end_word or found != points or (bit + u64(31)) >> u64(5) != end_bit >> u64(5):
        return -1
    return 0 if states_are_final(states) else -1


_HEAD = struct.Struct("<dddB")


def pack_tree(points: Floats, edge_m: float) -> tuple[list[bytes], npt.NDArray[np.int64]]:
    """Returns the sections of a cloud (N, 3), and the order (N,) in which its points come back.

    Raises:
        CodecError: the cloud is too wide for cells of this edge, or too regular.
    """
    if not len(points):
        return [], np.zeros(0, np.int64)
    points = np.ascontiguousarray(points)
    low, high = np.empty(3), np.empty(3)
    fill_corners(points, low, high)
    extent_m = float((high - low).max())
    if extent_m / edge_m >= 2**MAX_TREE_DEPTH - 1:
        raise CodecError(
            f"a coordinate lies {extent_m:.1f} m from another: at this bound the form ends at "
            f"{edge_m * (2**MAX_TREE_DEPTH - 1):.1f} m"
        )
    cells, keys = np.empty(points.shape, np.int64), np.empty(len(points), np.uint64)
    order, placed = np.empty(len(points), np.int64), np.empty(len(points), np.int64)
    largest = fill_nodes(points, low, edge_m, cells, keys)
    depth = max(largest.bit_length(), 1)
    sort_keys(keys, 3 * depth + 1, order)
    symbols = np.empty(symbol_room(len(points), depth), np.uint32)
    raw = np.empty(2 * len(points) + 2, np.uint32)
    counts, sizes = np.zeros((CONTEXTS, STRIDE), np.int64), np.zeros(2, np.int64)
    tree_to_symbols(keys, cells[order], depth, symbols, raw, counts, placed, sizes)
    sections = pack_symbols(symbols, int(sizes[0]), counts, sizes[0] / _SYMBOLS_PER_BIT)
    if sizes[0] > most_symbols(len(sections[1]) // 2):
        raise CodecError(f"{len(points)} points lie too regularly for a tree")
    bits = raw[: sizes[1]].astype("<u4", copy=False).tobytes()
    return [_HEAD.pack(*low, depth), *sections, bits], order[placed]


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
    *low, depth = _HEAD.unpack(head)
    if not (
        np.isfinite(low).all()
        and np.abs(low).max() < MAX_TREE_ORIGIN_M
        and 1 <= depth <= MAX_TREE_DEPTH
    ):
        raise CodecError(f"a tree claims depth {depth} at {low}")
    stream = unpack_symbols(reader, (CONTEXTS, STRIDE), _SYMBOLS_PER_CELL)
    raw = read_raw(reader.section(), _SPARE)
    xyz = np.empty((points, 3), np.float32)
    tables = (stream.table_of, stream.slots, stream.place)
    placing = (depth, edge_m, np.array(low), xyz)
    if symbols_to_points(stream.words, stream.end, raw, *tables, *placing) < 0:
        raise CodecError("a tree is damaged, or holds other than the points it claims")
    return xyz
