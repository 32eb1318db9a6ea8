"""Streams of symbols as sections of a payload: tables of shares, then the coder's words.

Neighbouring contexts share a table where that costs fewer bits than a second table would. A share
is written as a level, a third of an octave each, as the difference from the table before. Level 0
means that the token does not occur.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from protocol.codec.payload import Reader
from protocol.codec.rans import (
    I8,
    SHARES,
    STATES,
    U1,
    U2,
    U4,
    encode_symbols,
    fill_lookup,
    fold,
    i64,
    unfold,
)
from protocol.errors import CodecError
from protocol.limits import MAX_TABLES

LEVELS = 3 * 12 + 2
_WRITTEN_BITS = 3.0  # a level, roughly
_WEIGHTS = np.array([0] + [round(64 * 2 ** (k / 3)) for k in range(LEVELS - 1)], np.int64)


@njit("float64(int64[::1])", cache=True, nogil=True)
def _cost(counts: I8) -> float:
    """Returns the bits that coding these tokens and writing their table takes, roughly."""
    total, bits, last = 0, 0.0, 0
    for token in range(len(counts)):
        n = counts[token]
        if n > 0:
            total += n
            last = token
            bits -= n * np.log2(n)
    if total == 0:
        return 0.0
    return float(bits + total * np.log2(total) + 6 + _WRITTEN_BITS * (last + 1))


@njit("int64(int64[:,::1], float64, uint8[::1], uint8[:,::1])", cache=True, nogil=True)
def choose_tables(counts: I8, worth: float, table_of: U1, levels: U1) -> int:
    """Fills the table of each context and the levels of each table; returns how many tables.

    Args:
        counts: (contexts, stride), how often each token occurred in each context.
        worth: bits that a further table must save.
        table_of: (contexts,).
        levels: (contexts, stride); only the first rows are filled.
    """
    contexts, stride = counts.shape
    run, joined = np.zeros(stride, np.int64), np.zeros(stride, np.int64)
    run_cost, table = 0.0, 0
    for context in range(contexts + 1):
        alone = 0.0
        if context < contexts:
            for token in range(stride):
                joined[token] = run[token] + counts[context, token]
            alone, together = _cost(counts[context]), _cost(joined)
            if context == 0 or together <= run_cost + alone + worth or table == MAX_TABLES - 1:
                run, joined, run_cost = joined, run, together
                table_of[context] = table
                continue
        total = 0
        for token in range(stride):
            total += run[token]
        for token in range(stride):
            levels[table, token] = 0
            if run[token] > 0:
                octaves = max(0.0, np.log2(run[token] * float(SHARES) / total))
                levels[table, token] = i64(3.0 * octaves + 1.5)
            if context < contexts:
                run[token] = counts[context, token]
        table += 1
        run_cost = alone
        if context < contexts:
            table_of[context] = table
    return table


@njit("void(uint8[:,::1], int64, uint16[:,::1])", cache=True, nogil=True)
def shares_of_levels(levels: U1, tables: int, shares: U2) -> None:
    """Fills shares that sum to 4096, each at most 4095; the same on every machine."""
    stride = levels.shape[1]
    for table in range(tables):
        total, largest = 0, 0
        for token in range(stride):
            total += _WEIGHTS[levels[table, token]]
            if levels[table, token] > levels[table, largest]:
                largest = token
        left = SHARES
        for token in range(stride):
            weight = _WEIGHTS[levels[table, token]]
            share = max(1, weight * SHARES // total) if weight > 0 else 0
            shares[table, token] = share
            left -= share
        left += i64(shares[table, largest])
        if left == SHARES:
            left -= 1
            shares[table, stride - 1 if largest != stride - 1 else 0] = 1
        shares[table, largest] = left


@njit("int64(uint8[::1], int64, int64, int64)", cache=True, nogil=True)
def _put(out: U1, at: int, bits: int, value: int) -> int:
    for n in range(bits):
        out[(at + n) >> 3] |= np.uint8(((value >> n) & 1) << ((at + n) & 7))
    return at + bits


@njit("int64(uint8[::1], uint8[:,::1], int64, uint8[::1])", cache=True, nogil=True)
def write_tables(table_of: U1, levels: U1, tables: int, out: U1) -> int:
    """Writes which contexts share a table, and the tables; returns the bytes written.

    Args:
        table_of: (contexts,).
        levels: (contexts, stride).
        tables: how many rows of `levels` to write.
        out: zeros; 16 + contexts / 8 + 11 bits for each level suffice.
    """
    at = 0
    for context in range(1, len(table_of)):
        at = _put(out, at, 1, 1 if table_of[context] != table_of[context - 1] else 0)
    stride = levels.shape[1]
    before = np.zeros(stride, np.int64)
    for table in range(tables):
        last = 0
        for token in range(stride):
            if levels[table, token] > 0:
                last = token
        at = _put(out, at, 6, last)
        for token in range(last + 1):
            level = i64(levels[table, token])
            number = fold(level - before[token]) + 1
            before[token] = level
            zeros = 0
            while number >> (zeros + 1):
                zeros += 1
            at = _put(out, at, zeros, 0)
            at = _put(out, at, 1, 1)
            at = _put(out, at, zeros, number & ((1 << zeros) - 1))
    return (at + 7) >> 3


@njit(
    "int64(Array(uint8, 1, 'C', readonly=True), uint8[::1], uint8[:,::1])", cache=True, nogil=True
)
def read_tables(data: U1, table_of: U1, levels: U1) -> int:
    """Reverses `write_tables`; returns how many tables, or -1 if `data` does not hold them."""
    contexts, stride = levels.shape
    end = len(data) * 8
    if end < contexts:
        return -1
    at = 0
    for context in range(1, contexts):
        table = i64(table_of[context - 1]) + ((data[at >> 3] >> (at & 7)) & 1)
        if table >= MAX_TABLES:
            return -1
        table_of[context] = table
        at += 1
    tables: int = i64(table_of[contexts - 1]) + 1
    before = np.zeros(stride, np.int64)
    for table in range(tables):
        if at + 6 > end:
            return -1
        last, largest = 0, 0
        for n in range(6):
            last |= i64((data[at >> 3] >> (at & 7)) & 1) << n
            at += 1
        if last >= stride:
            return -1
        for token in range(last + 1):
            zeros = 0
            while at < end and not (data[at >> 3] >> (at & 7)) & 1:
                zeros += 1
                at += 1
            if at + 1 + zeros > end or zeros > 8:
                return -1
            at += 1
            number = i64(1) << zeros
            for n in range(zeros):
                number |= i64((data[at >> 3] >> (at & 7)) & 1) << n
                at += 1
            before[token] += unfold(number - 1)
            if not 0 <= before[token] < LEVELS:
                return -1
            levels[table, token] = before[token]
            largest = max(largest, before[token])
        if largest == 0:
            return -1
    return tables


@dataclass(frozen=True, slots=True, eq=False)
class SymbolStream:
    """A stream of symbols to decode: words with zeros behind them, `end` of the words, and tables.

    `table_of` is the table of each context, `slots` (tables * 4096,) and `place`
    (tables * stride,) are those of `fill_lookup`.
    """

    words: U2
    end: int
    table_of: U1
    slots: U1
    place: U4


def pack_symbols(symbols: U4, count: int, counts: I8, worth: float = 0.0) -> list[bytes]:
    """Returns the sections of the first `count` symbols.

    Args:
        symbols: `state << TURN_SHIFT | context * stride + token`.
        count: how many of them.
        counts: (contexts, stride), how often each occurs.
        worth: bits that a further table must save: each takes the decoder room in its caches.
    """
    contexts, stride = counts.shape
    table_of = np.zeros(contexts, np.uint8)
    levels = np.zeros((contexts, stride), np.uint8)
    tables = choose_tables(counts, worth, table_of, levels)
    written = np.zeros(contexts + tables * 2 * stride, np.uint8)
    length = write_tables(table_of, levels, tables, written)
    shares = np.zeros((tables, stride), np.uint16)
    shares_of_levels(levels, tables, shares)
    words = np.empty(count + 2 * STATES, np.uint16)
    start = encode_symbols(symbols, count, shares[table_of], words)
    return [written[:length].tobytes(), words[start:].astype("<u2", copy=False).tobytes()]


def unpack_symbols(reader: Reader, shape: tuple[int, int], room: int) -> SymbolStream:
    """Reads the sections of `pack_symbols`.

    Args:
        reader: of the payload.
        shape: how many contexts the form has, and how many tokens each.
        room: how many words the decoder may read beyond the end before it checks.

    Raises:
        CodecError: they do not hold tables and words.
    """
    written, body = reader.section(), reader.section()
    if len(body) % 2 or len(body) < 4 * STATES:
        raise CodecError(f"scan has {len(body)} bytes of symbols")
    table_of, levels = np.zeros(shape[0], np.uint8), np.zeros(shape, np.uint8)
    tables = read_tables(np.frombuffer(written, np.uint8), table_of, levels)
    if tables < 0:
        raise CodecError("the tables of a scan are damaged")
    shares = np.zeros((tables, shape[1]), np.uint16)
    shares_of_levels(levels, tables, shares)
    slots = np.empty((tables, SHARES), np.uint8)
    place = np.empty((tables, shape[1]), np.uint32)
    fill_lookup(shares, slots, place)
    end = len(body) // 2
    words = np.zeros(end + room, np.uint16)
    words[:end] = np.frombuffer(body, "<u2")
    return SymbolStream(words, end, table_of, slots.ravel(), place.ravel())


def read_raw(section: bytes, spare: int = 0) -> U4:
    """Returns the words of raw bits, and so many zeros behind them.

    Raises:
        CodecError: they are not whole.
    """
    if len(section) % 4:
        raise CodecError(f"scan has {len(section)} bytes of raw bits")
    words = np.zeros(len(section) // 4 + spare, np.uint32)
    words[: len(section) // 4] = np.frombuffer(section, "<u4")
    return words
