"""The default profile's model of a range image: what each beam is expected to return.

Ranges are whole numbers of 1/256 step. A ring is cut into eight sectors that advance side by side,
so that eight chains of arithmetic run at once; the lowest ring comes first, for flat ground is the
easiest to begin with. Each beam's range is expected where the ring so far and the ring below agree
(the median of LOCO-I, Weinberger et al. 2000), and what differs is coded in whole steps from there.
The expectation goes on from a filtered range, not from the decoded one: the first few returns after
a jump count much, later ones less, so that range noise averages out.

A beam is one token: lost, a residual, or the escape from them. What is left of each beam is its
kind, the lowest two bits how large the residual was, the next how many were lost in a row. Tokens
of a ring are read first, ranges follow from them, points from ranges: three short loops take less
time than a long one. All arithmetic that both sides share is of whole numbers.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from protocol.codec.prediction import (
    GONE,
    LOST,
    LOST_TOKEN,
    SECTORS,
    STRIDE,
    TAIL,
    TOKENS,
    classify,
    describe_lower_ring,
    place_ring,
    ranges_of_ring,
    residuals_of_ring,
)
from protocol.codec.rans import (
    ESCAPE,
    I4,
    I8,
    SHARES,
    STATES,
    TURN_SHIFT,
    U1,
    U2,
    U4,
    advance,
    fold,
    i64,
    is_short,
    read_states,
    refill,
    states_are_final,
    tail_base,
    tail_bits,
    tail_token,
    u64,
    unfold,
)
from protocol.scans import Floats, Floats32


@njit(
    "void(float32[:,::1], float64, int64[::1], int64[::1], uint8[::1], uint8[::1], uint32[::1], "
    "uint32[::1], int32[:,::1], int64[::1])",
    cache=True,
    nogil=True,
)
def image_to_symbols(
    range_m: Floats32,
    units_per_m: float,
    tuning: I8,
    marks: I8,
    context_of: U1,
    next_kind: U1,
    symbols: U4,
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
        context_of: `CONTEXT_OF`.
        next_kind: `NEXT_KIND`.
        symbols: filled with `sector << TURN_SHIFT | context * STRIDE + token`.
        raw: filled with raw bits.
        counts: zeros (2, COUNTS); filled with how often each symbol occurs, in two parts.
        sizes: filled with the number of symbols, of raw words and of points.
    """
    channels, columns = range_m.shape
    limits, shift, low = (np.int32(tuning[0]), np.int32(tuning[1])), tuning[2], tuning[3]
    plain = low == 0  # no raw bits but those of escapes
    wide = (columns + SECTORS - 1) // SECTORS
    room, end = (wide + 2) * SECTORS, (wide + 1) * SECTORS
    lines = np.full((2, room), np.int32(marks[3]), np.int32)
    kinds = np.zeros((2, room), np.uint8)
    slopes, bases = np.zeros(room, np.int32), np.zeros(room, np.int16)
    beams, steps = np.full(room, np.int32(LOST), np.int32), np.zeros(room, np.int32)
    units = np.full(wide * SECTORS, np.int32(LOST), np.int32)
    calms, classes = np.zeros(room, np.int32), np.empty(STRIDE, np.uint16)
    classify(shift, low, classes)
    count, words, held, rise = 0, 0, 0, np.int32(0)
    bits = u64(0)
    for row in range(channels - 1, -1, -1):
        here, below = lines[row & 1], lines[1 - (row & 1)]
        kind, kind_below = kinds[row & 1], kinds[1 - (row & 1)]
        describe_lower_ring(below, kind_below, slopes, bases, wide, shift, marks)
        for column in range(columns):
            metres = range_m[row, column]
            units[column] = np.int32(metres * units_per_m + 0.5) if metres > 0 else np.int32(LOST)
        for column in range(wide):
            start = u64((column + 1) * SECTORS)
            for n in range(SECTORS):
                beams[start + u64(n)] = units[u64(n * wide + column)]
        given = beams, below, slopes
        rise = residuals_of_ring(*given, limits, rise, calms, here, steps)
        for sector in range(SECTORS):
            kind[sector] = kind_below[SECTORS + sector]
        for at in range(SECTORS, end):
            before, base = i64(kind[at - SECTORS]), i64(bases[at])
            context = i64(context_of[u64((base << 4) | before)])
            whole = i64(steps[at]) - 1  # of a lost beam -1, and so is the number
            number = min(whole >> low, ESCAPE)
            token = number + 1
            symbol = context * STRIDE + token
            symbols[u64(count)] = (at & 7) << TURN_SHIFT | symbol
            counts[u64(at & 1), u64(symbol)] += 1
            count += 1
            kind[at] = next_kind[u64(i64(classes[u64(token)]) | ((base & 24) << 1) | before)]
            if number != ESCAPE and plain:
                continue
            extra, length = whole & ((1 << low) - 1), low * i64(whole >= 0)
            if number == ESCAPE:
                over = (whole >> low) - ESCAPE
                token = tail_token(over)
                symbol = (TAIL + (before & 3)) * STRIDE + token
                symbols[count] = (at & 7) << TURN_SHIFT | symbol
                counts[at & 1, symbol] += 1
                count += 1
                extra |= (over - tail_base(token)) << low
                length += tail_bits(token)
            if length > 0:
                bits |= u64(extra) << u64(held)
                held += length
                if held >= 32:
                    raw[words] = np.uint32(bits & u64(0xFFFFFFFF))
                    words += 1
                    bits >>= u64(32)
                    held -= 32
    if held > 0:
        raw[words] = np.uint32(bits & u64(0xFFFFFFFF))
        words += 1
    points = channels * wide * SECTORS
    for context in range(TAIL):
        lost = context * STRIDE + LOST_TOKEN
        points -= counts[0, lost] + counts[1, lost]
    sizes[0], sizes[1], sizes[2] = count, words, points


@njit(
    "int64(uint16[::1], int64, uint32[::1], Array(uint8, 1, 'C', readonly=True), uint8[::1], "
    "uint32[::1], int64[::1], int64[::1], uint8[::1], float64, "
    "Array(float64, 2, 'C', readonly=True), "
    "Array(float64, 2, 'C', readonly=True), UniTuple(float64, 2), float32[:,::1])",
    cache=True,
    nogil=True,
)
def symbols_to_points(
    words: U2,
    end_word: int,
    raw: U4,
    table_of: U1,
    slots: U1,
    place: U4,
    tuning: I8,
    marks: I8,
    next_kind: U1,
    m_per_unit: float,
    turns: Floats,
    azimuths: Floats,
    origin_m: tuple[float, float],
    xyz: Floats32,
) -> int:
    """Reverses `image_to_symbols` and places the points; returns 0, -1 if the data is damaged.

    Args:
        words: of the entropy coder, and zeros behind them, enough for all symbols of a ring.
        end_word: how many words are not such zeros.
        raw: the raw bits.
        table_of: the table of each base and kind, then those of the tails.
        slots: (tables * 4096,), of `open_tables`.
        place: (tables * STRIDE,), of `open_tables`.
        tuning: as the encoder's.
        marks: as the encoder's.
        next_kind: `NEXT_KIND`.
        m_per_unit: the step by 256.
        turns: (channels, 3), of each ring: how far out and how far round it points, and how far up.
        azimuths: (columns, 2), cosine and sine.
        origin_m: height and radius of `BeamOrigin`.
        xyz: (returns + 1, 3), filled with points ring by ring, but for the last row.
    """
    channels, columns = len(turns), len(azimuths)
    limits, shift, low = (np.int32(tuning[0]), np.int32(tuning[1])), tuning[2], tuning[3]
    plain = low == 0  # no raw bits but those of escapes
    wide = (columns + SECTORS - 1) // SECTORS
    room, end = (wide + 2) * SECTORS, (wide + 1) * SECTORS
    lines = np.full((2, room), np.int32(marks[3]), np.int32)
    kinds = np.zeros((2, room), np.uint8)
    slopes, bases = np.zeros(room, np.int32), np.zeros(room, np.int16)
    steps, beams = np.zeros(room, np.int32), np.zeros(room, np.int32)
    calms, moves = np.zeros(room, np.int32), np.zeros(room, np.int32)
    classes = np.empty(STRIDE, np.uint16)
    classify(shift, low, classes)
    step_of = np.zeros(STRIDE, np.int32)
    for n in range(ESCAPE):
        step_of[n + 1] = unfold(n)
    tails = len(table_of) - 4
    states = np.empty(STATES, np.uint64)
    read_states(words, states)
    at_word, at_raw, held, rise = u64(2 * STATES), 0, 0, np.int32(0)
    bits = u64(0)
    first = i64(len(xyz)) - 1
    for row in range(channels - 1, -1, -1):
        if at_word > u64(end_word):
            return -1
        here, below = lines[row & 1], lines[1 - (row & 1)]
        kind, kind_below = kinds[row & 1], kinds[1 - (row & 1)]
        describe_lower_ring(below, kind_below, slopes, bases, wide, shift, marks)
        for sector in range(SECTORS):
            kind[sector] = kind_below[SECTORS + sector]
        returns = 0
        for at in range(SECTORS, end):
            before, base = u64(kind[at - SECTORS]), u64(bases[at])
            table = u64(table_of[(base << u64(4)) | before])
            state = states[at & 7]
            token = u64(slots[(table << u64(12)) | (state & u64(SHARES - 1))])
            state = advance(state, place[(table << u64(6)) | token])
            states[at & 7] = refill(state, words[at_word])
            at_word += is_short(state)
            kind[at] = next_kind[u64(classes[token]) | ((base & u64(24)) << u64(1)) | before]
            steps[at] = step_of[token]
            there = i64(token != u64(LOST_TOKEN))
            returns += there
            if token != u64(TOKENS - 1) and plain:
                continue
            length = low * there
            if token == u64(TOKENS - 1):
                table = u64(table_of[tails + i64(before & u64(3))])
                state = states[at & 7]
                token = u64(slots[(table << u64(12)) | (state & u64(SHARES - 1))])
                state = advance(state, place[(table << u64(6)) | token])
                states[at & 7] = refill(state, words[at_word])
                at_word += is_short(state)
                length += tail_bits(i64(token))
                if length > 32:
                    return -1
                steps[at] = unfold(ESCAPE + tail_base(i64(token)))
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
                number = fold(i64(steps[at])) + (extra >> low)
                steps[at] = unfold((number << low) | (extra & ((1 << low) - 1)))
        for n in range(columns, wide * SECTORS):
            if kind[(n % wide + 1) * SECTORS + n // wide] < GONE:
                return -1
        first -= returns
        if first < 0:
            return -1
        given = steps, kind, below, slopes
        rise = ranges_of_ring(*given, limits, rise, calms, moves, here, beams)
        placing = turns, row, azimuths, origin_m, xyz
        place_ring(beams, kind, SECTORS, m_per_unit, *placing, first, returns)
    if at_word != u64(end_word) or at_raw != len(raw) or first != 0:
        return -1
    return 0 if states_are_final(states) else -1
