"""The compact profile's walk over a range image: both directions, with the model of `filters`."""

from __future__ import annotations

import numpy as np
from numba import njit

from protocol.codec.fill import SIDES, find_holes, ring_units
from protocol.codec.filters import (
    AT,
    BANDS,
    BELOW,
    EDGE,
    EXPECTED,
    HERE,
    MORE,
    MOST,
    OTHER,
    PAD,
    PLACES,
    ROWS,
    SCALE,
    SEEN,
    TAIL,
    WEIGHTS,
    begin,
    context_of,
    expect,
    instead,
    measure,
    note,
    pass_over,
    settle,
    tail_of,
)
from protocol.codec.rans import SHARES, STATES, TURN_SHIFT, advance, is_short, refill
from protocol.codec.tokens import (
    ESCAPE,
    I4,
    I8,
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
from protocol.codec.walk import GONE, STRIDE, UNITS, are_done, open_states, place_ring
from protocol.scans import Floats, Floats32

_PARTS = 6  # of all rings: one for each band, but for the lowest, which has the rest


@njit(
    "void(float32[:,::1], float64, int64[::1], int64[::1], uint8[::1], int32[:,::1], "
    "float64[:,:,::1], uint16[::1], uint32[::1], int32[:,::1], int64[::1], float64, float64[::1], "
    "uint8[:,::1])",
    cache=True,
    nogil=True,
)
def describe_fine(
    range_m: Floats32,
    units_per_m: float,
    tuning: I8,
    marks: I8,
    size_classes: U1,
    weights: I4,
    gram: Floats,
    symbols: U2,
    raw: U4,
    counts: I4,
    sizes: I8,
    reach_m: float,
    chords: Floats,
    filled: U1,
) -> None:
    """Turns an image into symbols and raw bits, as `image.describe`.

    Args:
        range_m: as there, and so are all arguments but those named here.
        units_per_m: as there.
        tuning: as there.
        marks: as there.
        size_classes: `SIZE_CLASSES`.
        weights: (BANDS, WEIGHTS), of the filter.
        gram: (BANDS, WEIGHTS + 1, WEIGHTS + 1), to learn better weights: filled. Or empty.
        symbols: as there.
        raw: as there.
        counts: as there.
        sizes: as there.
        reach_m: as there.
        chords: as there.
        filled: as there.
    """
    channels, columns = range_m.shape
    low = tuning[3]
    rows = np.zeros((ROWS, columns + 2 * PAD), np.int32)
    for at in range(columns + 2 * PAD):
        rows[HERE, at] = rows[EXPECTED, at] = marks[3]
    extra = np.zeros(MORE + 1, np.int32)
    place, inputs, learns = np.zeros(PLACES, np.int64), np.zeros(WEIGHTS + 1), len(gram) > 0
    measure(tuning, place)
    beams = np.zeros(columns + 2 * SIDES, np.int32)
    least, most = np.zeros(columns, np.int32), np.full(columns, np.int32(-1), np.int32)
    reach = reach_m * units_per_m - 1.0
    count, words, held, points, rise = 0, 0, 0, 0, 0
    bits = u64(0)
    for row in range(channels - 1, -1, -1):
        ring_units(range_m[row], units_per_m, beams)
        if reach > 0:
            find_holes(beams, 1, reach, chords[row], least, most)
        begin(rows, columns, UNITS - tuning[0])
        band = min(row * _PARTS // channels, BANDS - 1)
        last = i64(rows[BELOW, PAD]) + rise
        place[SEEN], place[OTHER] = 0, last
        for column in range(columns):
            at = column + PAD
            expected = expect(rows, weights[band], extra, place, at, last)
            context = context_of(rows, size_classes, at, expected, marks)
            place[AT] = at
            turn = (column & (STATES - 1)) << TURN_SHIFT
            value = i64(beams[column + SIDES])
            if value < 0 and least[column] <= expected <= most[column]:
                value = expected
                if len(filled) > 0:
                    filled[row, column] = 1
            if value >= 0:
                points += 1
                base, which = expected, 0
                median = i64(extra[MORE])
                k = (value - expected + UNITS // 2) >> 8
                whole = fold(k)
                number = min(whole >> low, ESCAPE)
                if number == ESCAPE:
                    enough = ((whole >> low) - 8) << low >> 2  # a quarter, or it is not worth it
                    for n in range(1, 3):
                        start = instead(rows, place, median, last, n)
                        steps = (value - start + UNITS // 2) >> 8
                        if fold(steps) < min(enough, whole):
                            base, which, whole, k = start, n, fold(steps), steps
                symbol = context * STRIDE + number + which + 1
                extra_bits, length = whole & ((1 << low) - 1), low
                symbols[count] = turn | symbol
                counts[count & 1, symbol] += 1
                count += 1
                if number == ESCAPE:
                    over = (whole >> low) - (ESCAPE if which == 0 else 0)
                    token = tail_token(over)
                    tail = tail_of(context) if which == 0 else 3 + which
                    symbol = (TAIL + tail) * STRIDE + token
                    symbols[count] = turn | symbol
                    counts[count & 1, symbol] += 1
                    count += 1
                    extra_bits |= (over - tail_base(token)) << low
                    length += tail_bits(token)
                if length > 0:
                    bits |= u64(extra_bits) << u64(held)
                    held += length
                    if held >= 32:
                        raw[words] = np.uint32(bits & u64(0xFFFFFFFF))
                        words += 1
                        bits >>= u64(32)
                        held -= 32
                value = base + k * UNITS
                wanted = (value - median) >> place[SCALE]
                if learns and column & 3 == row & 3 and abs(wanted) <= place[MOST]:
                    note(rows, extra, at, wanted, inputs, gram[band])
                k, before = (value - expected + UNITS // 2) >> 8, last
                last = settle(rows, tuning, place, median, value, k)
                if abs(last - before) > place[EDGE]:
                    place[OTHER] = before
            else:
                symbols[count] = turn | context * STRIDE
                counts[count & 1, context * STRIDE] += 1
                count += 1
                last = i64(extra[MORE])
                pass_over(rows, at, last)
            if column == 0:
                rise = last - i64(rows[BELOW, at])
    if held > 0:
        raw[words] = np.uint32(bits & u64(0xFFFFFFFF))
        words += 1
    sizes[0], sizes[1], sizes[2] = count, words, points


@njit(
    "int64(uint16[::1], int64, uint32[::1], Array(uint8, 1, 'C', readonly=True), uint8[::1], "
    "uint32[::1], int64[::1], int64[::1], uint8[::1], int32[:,::1], float64, "
    "Array(float64, 2, 'C', readonly=True), "
    "Array(float64, 2, 'C', readonly=True), float32[:,::1])",
    cache=True,
    nogil=True,
)
def restore_fine(
    words: U2,
    end_word: int,
    raw: U4,
    table_of: U1,
    slots: U1,
    place_of: U4,
    tuning: I8,
    marks: I8,
    size_classes: U1,
    weights: I4,
    m_per_unit: float,
    turns: Floats,
    azimuths: Floats,
    xyz: Floats32,
) -> int:
    """Reverses `describe_fine` and places the points, as `image.restore`.

    Args:
        words: as there, and so are all arguments but those named here.
        end_word: as there.
        raw: as there.
        table_of: (CONTEXTS,), the table of each context.
        slots: as there.
        place_of: as there.
        tuning: as there.
        marks: as there.
        size_classes: `SIZE_CLASSES`.
        weights: (BANDS, WEIGHTS), as the encoder's.
        m_per_unit: as there.
        turns: as there.
        azimuths: as there.
        xyz: (returns + 1, 3), filled with points ring by ring, but for the last row.
    """
    channels, columns = len(turns), len(azimuths)
    low = tuning[3]
    rows = np.zeros((ROWS, columns + 2 * PAD), np.int32)
    for at in range(columns + 2 * PAD):
        rows[HERE, at] = rows[EXPECTED, at] = marks[3]
    extra = np.zeros(MORE + 1, np.int32)
    place = np.zeros(PLACES, np.int64)
    beams, kinds = np.zeros(columns + 1, np.int32), np.zeros(columns + 1, np.uint8)
    measure(tuning, place)
    states = np.empty(STATES, np.uint64)
    open_states(words, states)
    at_word, at_raw, held, rise = u64(2 * STATES), 0, 0, 0
    bits = u64(0)
    first = i64(len(xyz)) - 1
    for row in range(channels - 1, -1, -1):
        if at_word > u64(end_word):
            return -1
        begin(rows, columns, UNITS - tuning[0])
        band = min(row * _PARTS // channels, BANDS - 1)
        last = i64(rows[BELOW, PAD]) + rise
        place[SEEN], place[OTHER] = 0, last
        returns = 0
        for column in range(columns):
            at = column + PAD
            expected = expect(rows, weights[band], extra, place, at, last)
            context = context_of(rows, size_classes, at, expected, marks)
            place[AT] = at
            table = u64(table_of[context])
            state = states[column & (STATES - 1)]
            token = u64(slots[(table << u64(12)) | (state & u64(SHARES - 1))])
            state = advance(state, place_of[(table << u64(6)) | token])
            at_word_next = at_word + is_short(state)
            state = refill(state, words[at_word])
            at_word = at_word_next
            if token > u64(0):
                number, length, base = min(i64(token) - 1, ESCAPE), low, expected
                if number == ESCAPE:
                    which = min(i64(token) - 1 - ESCAPE, 2)
                    if which > 0:
                        base, number = instead(rows, place, i64(extra[MORE]), last, which), 0
                        table = u64(table_of[TAIL + 3 + which])
                    else:
                        table = u64(table_of[TAIL + tail_of(context)])
                    token = u64(slots[(table << u64(12)) | (state & u64(SHARES - 1))])
                    state = advance(state, place_of[(table << u64(6)) | token])
                    at_word_next = at_word + is_short(state)
                    state = refill(state, words[at_word])
                    at_word = at_word_next
                    length += tail_bits(i64(token))
                    if length > 32:
                        return -1
                    number += tail_base(i64(token))
                if length > 0:
                    if held < length:
                        if at_raw >= len(raw):
                            return -1
                        bits |= u64(raw[at_raw]) << u64(held)
                        at_raw += 1
                        held += 32
                    more = i64(bits & ((u64(1) << u64(length)) - u64(1)))
                    bits >>= u64(length)
                    held -= length
                    number = ((number + (more >> low)) << low) | (more & ((1 << low) - 1))
                value, median = base + unfold(number) * UNITS, i64(extra[MORE])
                k, before = (value - expected + UNITS // 2) >> 8, last
                beams[column + 1], kinds[column + 1] = value, 0
                last = settle(rows, tuning, place, median, value, k)
                if abs(last - before) > place[EDGE]:
                    place[OTHER] = before
                returns += 1
            else:
                kinds[column + 1] = GONE
                last = i64(extra[MORE])
                pass_over(rows, at, last)
            states[column & (STATES - 1)] = state
            if column == 0:
                rise = last - i64(rows[BELOW, at])
        first -= returns
        if first < 0:
            return -1
        place_ring(beams, kinds, 1, m_per_unit, turns, row, azimuths, xyz, first, returns)
    if at_word != u64(end_word) or at_raw != len(raw) or first != 0:
        return -1
    return 0 if are_done(states) else -1
