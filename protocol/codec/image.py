"""The default profile's model of a range image: what each beam is expected to return.

Ranges are whole numbers of 1/256 step. A ring is cut into eight sectors that advance side by side,
so that eight chains of arithmetic run at once; the lowest ring comes first, for flat ground is the
easiest to begin with. Each beam's range is expected where the ring so far and the ring below agree
(the median of LOCO-I, Weinberger et al. 2000), and what differs is coded in whole steps from there.
The expectation goes on from a filtered range, not from the decoded one: the first few returns after
a jump count much, later ones less, so that range noise averages out.

Which beams return at all is coded four beams at a time.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from protocol.codec.cloud import Floats32
from protocol.codec.rans import SHARES, START, STATES, advance, is_short, refill
from protocol.codec.tokens import (
    ESCAPE,
    I1,
    I4,
    I8,
    TAIL_ALPHABET,
    U1,
    U2,
    U4,
    fold,
    i64,
    tail_base,
    tail_bits,
    tail_token,
    u64,
    unfold,
)

SECTORS = 8
UNITS = 256  # in one step
MAX_UNITS = 1 << 30
STRIDE = TAIL_ALPHABET
CONTEXTS = 59
COUNTS = 1 << 14  # four times as many symbols as there are, for four counters in turn
_MASK, _TAIL = 48, 55
_NO_RETURN = -(1 << 31)
_FAR_M = (56.0, 75.0, 95.0)  # beyond these, returns are lost more and more often
_START_M = 10.0


def landmarks(units_per_m: float) -> I8:
    """Returns the distances in units that the model looks at, and last the one it starts at."""
    return np.array([min(int(m * units_per_m), MAX_UNITS) for m in (*_FAR_M, _START_M)], np.int64)


def symbol_room(channels: int, columns: int) -> int:
    """Returns how many symbols an image can have at most."""
    return channels * (2 * columns + columns // 4 + SECTORS)


@njit("int64(int64, int64, int64, int64[::1])", cache=True)
def _mask_context(left: int, below: int, distance: int, marks: I8) -> int:
    """Returns the context of four beams: do their neighbours return, and from how far?"""
    context = _MASK + (left > 0) + 2 * (below > 0)
    if left > 0 and below > 0:
        for n in range(3):
            if distance > marks[n]:
                context += 1
    return context


@njit("void(int32[::1], int32[::1], int8[::1], int64, int64)", cache=True)
def _look_below(below: I4, slopes: I4, levels: I1, wide: int, shift: int) -> None:
    """Fills how the ring below runs at each beam: its slope, and how uneven it is there."""
    end = wide * SECTORS
    for sector in range(SECTORS):  # what sectors see beyond their ends
        below[sector] = below[end + (sector + 7) % 8]
        below[end + SECTORS + sector] = below[SECTORS + (sector + 1) % 8]
    for at in range(SECTORS, end + SECTORS):
        slope = below[at] - below[at - SECTORS]
        slopes[at] = slope
        uneven = max(abs(slope), abs(below[at + SECTORS] - below[at])) >> (5 + shift)
        levels[at] = (
            np.int8(uneven > 0)
            + np.int8(uneven > 1)
            + np.int8(uneven > 3)
            + np.int8(uneven > 7)
            + np.int8(uneven > 15)
            + np.int8(uneven > 31)
            + np.int8(uneven > 63)
        )
    for at in range(SECTORS, 2 * SECTORS):
        slopes[at] = 0


@njit(
    "void(float32[:,::1], float64, int64[::1], int64[::1], uint16[::1], uint32[::1], "
    "int32[::1], int64[::1])",
    cache=True,
)
def describe(
    range_m: Floats32,
    units_per_m: float,
    tuning: I8,
    marks: I8,
    symbols: U2,
    raw: U4,
    counts: I4,
    sizes: I8,
) -> None:
    """Turns an image into symbols and raw bits.

    Args:
        range_m: (channels, columns), 0 where nothing came back.
        units_per_m: 256 by the step.
        tuning: floor of the gain in 1/256, steps of a jump, shift of activities, low bits.
        marks: of `landmarks`.
        symbols: filled with `sector << 12 | context * STRIDE + token`.
        raw: filled with raw bits.
        counts: zeros (COUNTS,); filled with how often each symbol occurs, in four parts.
        sizes: filled with the number of symbols, of raw words and of returns.
    """
    channels, columns = range_m.shape
    floor, jump, shift, low = tuning[0], tuning[1], tuning[2], tuning[3]
    wide = (columns + 4 * SECTORS - 1) // (4 * SECTORS) * 4
    room = (wide + 2) * SECTORS
    lines = np.full((2, room), np.int32(marks[3]), np.int32)
    moods = np.zeros((2, room), np.int8)
    slopes, levels = np.zeros(room, np.int32), np.zeros(room, np.int8)
    beams = np.zeros(room, np.int32)
    nibbles = np.full((wide // 4 + 1, SECTORS), 15, np.int8)
    seen = np.zeros(SECTORS, np.int64)
    gains = np.empty(16, np.int64)
    for n in range(16):
        gains[n] = max(UNITS * 2 // (2 * n + 3), floor)
    count, words, held, points, rise = 0, 0, 0, 0, 0
    bits = u64(0)
    for row in range(channels - 1, -1, -1):
        here, below = lines[row & 1], lines[1 - (row & 1)]
        mood, mood_below = moods[row & 1], moods[1 - (row & 1)]
        _look_below(below, slopes, levels, wide, shift)
        for sector in range(SECTORS):
            seen[sector] = 0
            nibbles[wide // 4, sector] = nibbles[0, sector]
        for j in range(0, wide, 4):
            for sector in range(SECTORS):
                base = sector * wide + j
                nibble = 15
                for b in range(4):
                    at = (j + b + 1) * SECTORS + sector
                    beams[at] = _NO_RETURN
                    if base + b < columns:
                        metres = range_m[row, base + b]
                        if metres > 0:
                            beams[at] = np.int32(metres * units_per_m + 0.5)
                            points += 1
                        else:
                            nibble ^= 1 << b
                if base < columns:
                    left = i64(nibbles[(j >> 2) - 1, sector])
                    known = i64(nibbles[j >> 2, sector])
                    distance = i64(below[(j + 1) * SECTORS + sector])
                    symbol = _mask_context(left, known, distance, marks) * STRIDE + nibble
                    symbols[count] = sector << 12 | symbol
                    counts[(count & 3) << 12 | symbol] += 1
                    count += 1
                    nibbles[j >> 2, sector] = nibble
        change = rise
        for at in range(SECTORS, (wide + 1) * SECTORS):
            under, beside = i64(below[at]), i64(mood_below[at])
            if at < 2 * SECTORS:
                here[at - SECTORS] = under + change
                mood[at - SECTORS] = beside
            last, before = i64(here[at - SECTORS]), i64(mood[at - SECTORS])
            ahead = last + slopes[at]
            expected = max(min(last, under), min(max(last, under), ahead))
            there = i64(beams[at] != _NO_RETURN)
            k = ((i64(beams[at]) - expected + UNITS // 2) >> 8) * there
            number = fold(k)
            extra, length = number & ((1 << low) - 1), low * there
            number >>= low
            symbol = (min(before + beside, 5) * 8 + levels[at]) * STRIDE + min(number, ESCAPE)
            symbols[count] = (at & 7) << 12 | symbol
            counts[((count & 3) << 12 | symbol) & (COUNTS - 1)] += there
            count += there
            if number >= ESCAPE:
                token = tail_token(number - ESCAPE)
                symbol = (_TAIL + min(before + beside, 3)) * STRIDE + token
                symbols[count] = (at & 7) << 12 | symbol
                counts[((count & 3) << 12 | symbol) & (COUNTS - 1)] += 1
                count += 1
                extra |= (number - ESCAPE - tail_base(token)) << low
                length += tail_bits(token)
            if length > 0:
                bits |= u64(extra) << u64(held)
                held += length
                if held >= 32:
                    raw[words] = np.uint32(bits & u64(0xFFFFFFFF))
                    words += 1
                    bits >>= u64(32)
                    held -= 32
            size, calm = abs(k), seen[at & 7]
            if size >= jump:
                here[at] = expected + k * UNITS
                seen[at & 7] = 0
            else:
                here[at] = expected + gains[calm & 15] * k
                seen[at & 7] = min(calm + there, 15)
            mood[at] = min(size >> shift, 3) if there else min(before, beside)
            if at < 2 * SECTORS:
                change = i64(here[at]) - under
                if at == SECTORS:
                    rise = change
    if held > 0:
        raw[words] = np.uint32(bits & u64(0xFFFFFFFF))
        words += 1
    sizes[0], sizes[1], sizes[2] = count, words, points


@njit(
    "int64(uint16[::1], int64, uint32[::1], uint8[::1], uint8[::1], uint32[::1], int64[::1], "
    "int64[::1], int64, float64, Array(float32, 2, 'C', readonly=True), float32[:,::1])",
    cache=True,
)
def restore(
    words: U2,
    end: int,
    raw: U4,
    table_of: U1,
    slots: U1,
    place: U4,
    tuning: I8,
    marks: I8,
    columns: int,
    m_per_unit: float,
    directions: Floats32,
    xyz: Floats32,
) -> int:
    """Reverses `describe` and places the points; returns 0, or -1 if the payload is damaged.

    Args:
        words: of the entropy coder, and zeros behind them, enough for all symbols of a ring.
        end: how many words are not such zeros.
        raw: the raw bits.
        table_of: the table of each context.
        slots: (tables * 4096,), of `open_tables`.
        place: (tables * STRIDE,), of `open_tables`.
        tuning: as the encoder's.
        marks: as the encoder's.
        columns: of the image.
        m_per_unit: the step by 256.
        directions: (channels * columns, 3).
        xyz: (returns + 1, 3), filled with points ring by ring, but for the last row.
    """
    channels = directions.shape[0] // columns
    floor, jump, shift, low = tuning[0], tuning[1], tuning[2], tuning[3]
    wide = (columns + 4 * SECTORS - 1) // (4 * SECTORS) * 4
    room = (wide + 2) * SECTORS
    lines = np.full((2, room), np.int32(marks[3]), np.int32)
    moods = np.zeros((2, room), np.int8)
    slopes, levels = np.zeros(room, np.int32), np.zeros(room, np.int8)
    returns, beams = np.zeros(room, np.int8), np.zeros(room, np.int32)
    nibbles = np.full((wide // 4 + 1, SECTORS), 15, np.int8)
    seen = np.zeros(SECTORS, np.int64)
    gains = np.empty(16, np.int64)
    for n in range(16):
        gains[n] = max(UNITS * 2 // (2 * n + 3), floor)
    states = np.empty(STATES, np.uint64)
    for n in range(STATES):
        states[n] = (u64(words[2 * n]) << u64(16)) | u64(words[2 * n + 1])
    at_word, at_raw, held, rise = 2 * STATES, 0, 0, 0
    bits = u64(0)
    first = i64(len(xyz)) - 1
    for row in range(channels - 1, -1, -1):
        if at_word > end:
            return -1
        here, below = lines[row & 1], lines[1 - (row & 1)]
        mood, mood_below = moods[row & 1], moods[1 - (row & 1)]
        _look_below(below, slopes, levels, wide, shift)
        for sector in range(SECTORS):
            seen[sector] = 0
            nibbles[wide // 4, sector] = nibbles[0, sector]
        for j in range(0, wide, 4):
            for sector in range(SECTORS):
                base = sector * wide + j
                if base >= columns:
                    continue
                left = i64(nibbles[(j >> 2) - 1, sector])
                known = i64(nibbles[j >> 2, sector])
                distance = i64(below[(j + 1) * SECTORS + sector])
                table = i64(table_of[_mask_context(left, known, distance, marks)])
                state = states[sector]
                nibble = i64(slots[table << 12 | i64(state & u64(SHARES - 1))])
                state = advance(state, place[table << 6 | nibble])
                states[sector] = refill(state, words[at_word])
                at_word += is_short(state)
                nibbles[j >> 2, sector] = nibble
                for b in range(min(4, columns - base)):
                    there = (nibble >> b) & 1
                    returns[(j + b + 1) * SECTORS + sector] = there
                    first -= there
        if first < 0:
            return -1
        change = rise
        for at in range(SECTORS, (wide + 1) * SECTORS):
            under, beside = i64(below[at]), i64(mood_below[at])
            if at < 2 * SECTORS:
                here[at - SECTORS] = under + change
                mood[at - SECTORS] = beside
            last, before = i64(here[at - SECTORS]), i64(mood[at - SECTORS])
            ahead = last + slopes[at]
            expected = max(min(last, under), min(max(last, under), ahead))
            if returns[at]:
                table = i64(table_of[min(before + beside, 5) * 8 + levels[at]])
                state = states[at & 7]
                number = i64(slots[table << 12 | i64(state & u64(SHARES - 1))])
                state = advance(state, place[table << 6 | number])
                states[at & 7] = refill(state, words[at_word])
                at_word += is_short(state)
                length = low
                if number >= ESCAPE:
                    table = i64(table_of[_TAIL + min(before + beside, 3)])
                    state = states[at & 7]
                    token = i64(slots[table << 12 | i64(state & u64(SHARES - 1))])
                    state = advance(state, place[table << 6 | token])
                    states[at & 7] = refill(state, words[at_word])
                    at_word += is_short(state)
                    length += tail_bits(token)
                    if length > 32:
                        return -1
                    number = ESCAPE + tail_base(token)
                if length > 0:
                    if held < length:
                        if at_raw >= len(raw):
                            return -1
                        bits |= u64(raw[at_raw]) << u64(held)
                        at_raw += 1
                        held += 32
                    extra = i64(bits & ((u64(1) << u64(length)) - u64(1)))
                    bits >>= u64(length)
                    held -= length
                    number = ((number + (extra >> low)) << low) | (extra & ((1 << low) - 1))
                k = unfold(number)
                beams[at] = expected + k * UNITS
                size, calm = abs(k), seen[at & 7]
                if size >= jump:
                    here[at] = expected + k * UNITS
                    seen[at & 7] = 0
                else:
                    here[at] = expected + gains[calm & 15] * k
                    seen[at & 7] = min(calm + 1, 15)
                mood[at] = min(size >> shift, 3)
            else:
                here[at] = expected
                mood[at] = min(before, beside)
            if at < 2 * SECTORS:
                change = i64(here[at]) - under
                if at == SECTORS:
                    rise = change
        point, beam = first, row * columns
        taken = first
        for at in range(SECTORS, (wide + 1) * SECTORS):
            taken += returns[at]
        # A beam without return writes too, and is overwritten by the next, but for the ring's last.
        next_x, next_y, next_z = xyz[taken, 0], xyz[taken, 1], xyz[taken, 2]
        for sector in range(SECTORS):
            start = SECTORS + sector
            valid = max(0, min(wide, columns - sector * wide))
            for at in range(start, start + SECTORS * valid, SECTORS):
                metres = np.float32(beams[at] * m_per_unit)
                xyz[point, 0] = directions[beam, 0] * metres
                xyz[point, 1] = directions[beam, 1] * metres
                xyz[point, 2] = directions[beam, 2] * metres
                point += returns[at]
                beam += 1
        xyz[taken, 0], xyz[taken, 1], xyz[taken, 2] = next_x, next_y, next_z
    if at_word != end or at_raw != len(raw) or first != 0:
        return -1
    for n in range(STATES):
        if states[n] != u64(START):
            return -1
    return 0
