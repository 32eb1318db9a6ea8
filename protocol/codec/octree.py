"""Unordered points as an octree, breadth first: which eighths of a cell hold points.

A cell with one point is not divided further; its remaining bits are as good as random and go raw
(as in Draco's kd-tree). Which eighths are occupied takes two symbols of four bits each; the first
is expected by how many eighths the parent had, the second by the first.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from protocol.codec.rans import SHARES, START, STATES, TURN_SHIFT, advance, is_short, refill
from protocol.codec.tokens import (
    I8,
    TAIL_ALPHABET,
    U1,
    U2,
    U4,
    i64,
    tail_base,
    tail_bits,
    tail_token,
    u64,
)

U8 = npt.NDArray[np.uint64]

MAX_DEPTH = 20
STRIDE = TAIL_ALPHABET
_FIRST, _SECOND, _LONE, _COUNT = 0, 16, 32, 53
CONTEXTS = 54


_FREE_SYMBOLS, _SYMBOLS_OF_A_WORD = 1 << 20, 128


@njit("int64(int64)", cache=True, nogil=True)
def most_symbols(words: int) -> int:
    """Returns how many symbols may stand in so many words of the entropy coder.

    One that is certain takes next to no bits, so that a few bytes could hold millions of them.
    """
    return _FREE_SYMBOLS + _SYMBOLS_OF_A_WORD * words


def symbol_room(points: int, depth: int) -> int:
    """Returns how many symbols a tree can have at most."""
    return points * (depth * 3 + 2) + 8


@njit("void(int64[:,::1], uint64[::1])", cache=True, nogil=True)
def weave(cells: I8, keys: U8) -> None:
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
def unweave(keys: U8, cells: I8) -> None:
    """Reverses `weave`."""
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
def describe_tree(keys: U8, depth: int, symbols: U2, raw: U4, counts: I8, sizes: I8) -> None:
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
def restore_tree(
    words: U2, end: int, raw: U4, table_of: U1, slots: U1, place: U4, depth: int, keys: U8
) -> int:
    """Reverses `describe_tree`, but for the order; returns 0, or -1 if the payload is damaged.

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
