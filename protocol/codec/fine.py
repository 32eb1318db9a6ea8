"""The compact profile's model of a range image: slower than the default's, and closer to the noise.

Rings are walked from the lowest, each along its columns. Three things are added to what `image`
does. A ring that is complete is smoothed once more, backwards (Rauch, Tung and Striebel, 1965), so
that the ring above follows a calmer one. What is expected is corrected by a linear filter over the
last residuals of this ring and what smoothing took off the ring below; the encoder finds the
weights by least squares for each of four bands of rings and sends them. And tokens are told apart
by the residuals of ten neighbours, in half octaves.

Edges take bits as well. Where a ring runs on another surface than the ring below, it is expected to
go on as steeply as before. A range that is far from what was expected may be coded from one of two
others: the surface before the last edge, or one of the ring below.

All arithmetic that both sides share is of whole numbers, with shifts and floor division; none of it
depends on the order of a sum or on floating point, so that every machine decodes the same.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from protocol.codec.cloud import Floats, Floats32
from protocol.codec.image import STRIDE, UNITS
from protocol.codec.rans import SHARES, START, STATES, TURN_SHIFT, advance, is_short, refill
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

CONTEXTS = 62
_NEAR, _FAR, _MIXED, _SKY, _TAIL = 0, 26, 44, 50, 56
_PAD = 16  # columns to either side, those of the ring's other end
_TAPS = 8  # of the filter, on the ring and on the ring below
_MORE = 4  # inputs besides
WEIGHTS = 2 * _TAPS + _MORE
WEIGHT_BITS = 7
BANDS = 4  # of rings, each with weights of its own
_PARTS = 6  # of all rings: one for each band, but for the lowest, which has the rest
_UNEASE = 5e3  # added to the power of the inputs, by whose square a beam counts less
_LARGEST = 127  # size of a residual
_CLASSES = 1 << 10
# Rows of whole numbers along a ring: its filtered ranges and those of the ring below, smoothed;
# residuals; what smoothing took off; what was expected; sizes of residuals here and below; beams
# lost here and below; jumps; and the ring two below, smoothed.
_HERE, _BELOW, _RESIDUAL, _OFF, _EXPECTED, _SIZE, _SIZE_BELOW, _GONE, _GONE_BELOW, _JUMP = range(10)
_UNDER = 10
_ROWS = 11
# Whole numbers that beams of a ring pass on: column and `_PAD`, returns since a jump, bits by which
# inputs are shorter than ranges, largest input, range before the last edge, range of an edge.
_AT, _SEEN, _SCALE, _MOST, _OTHER, _EDGE = range(6)
_PLACES = 6


def _size_classes() -> U1:
    """Returns the class of a sum of sizes: half octaves."""
    result = np.zeros(_CLASSES, np.uint8)
    for total in range(1, _CLASSES):
        octave = (2 * total).bit_length() - 1
        result[total] = min(2 * octave + ((4 * total >> octave) & 1), 25)
    return result


SIZE_CLASSES = _size_classes()


@njit("void(int32[:,::1], int64, int64)", cache=True)
def _begin(rows: I4, columns: int, step: int) -> None:
    """Makes the ring that is complete the ring below: smooths it and closes its circle.

    Args:
        rows: of `_ROWS`.
        columns: of a ring.
        step: share of a correction that reaches the column before, in 1/256.
    """
    correction = 0
    for at in range(_PAD + columns - 1, _PAD - 1, -1):
        here = i64(rows[_HERE, at])
        smooth = here + correction
        rows[_UNDER, at], rows[_BELOW, at] = rows[_BELOW, at], smooth
        ahead = correction + here - rows[_EXPECTED, at]
        correction = 0 if rows[_JUMP, at] else (ahead * step) >> 8
        rows[_SIZE_BELOW, at] = rows[_SIZE, at]
        rows[_GONE_BELOW, at] = rows[_GONE, at]
    for row in (_BELOW, _OFF, _SIZE_BELOW, _GONE_BELOW):
        for n in range(_PAD):
            rows[row, n] = rows[row, n + columns]
            rows[row, _PAD + columns + n] = rows[row, _PAD + n]
    for n in range(_PAD):
        rows[_RESIDUAL, n] = 0
        rows[_SIZE, n] = rows[_SIZE_BELOW, n]
        rows[_GONE, n] = rows[_GONE_BELOW, n]


@njit("int64(int32[:,::1], int32[::1], int32[::1], int64[::1], int64, int64)", cache=True)
def _expect(rows: I4, weights: I4, extra: I4, place: I8, at: int, last: int) -> int:
    """Returns what a beam is expected to return; fills four more inputs of the filter.

    Args:
        rows: of `_ROWS`.
        weights: (WEIGHTS,).
        extra: (_MORE + 1,), filled, and last what is expected without the filter.
        place: of `_PLACES`.
        at: column and `_PAD`.
        last: filtered range to the left.
    """
    scale, most, edge = place[_SCALE], place[_MOST], place[_EDGE]
    under = i64(rows[_BELOW, at])
    left, right = i64(rows[_BELOW, at - 1]), i64(rows[_BELOW, at + 1])
    slope = under - left if at > _PAD else 0
    ahead = last + slope
    median = max(min(last, under), min(max(last, under), ahead))
    apart = abs(last - left)
    if apart > edge:  # the ring below is of another surface here: go on as before
        before = i64(rows[_HERE, at - 2])
        steep, steeper = last - before, before - i64(rows[_HERE, at - 3])
        own = 0
        if at >= _PAD + 3 and (steep > 0) == (steeper > 0):
            own = min(steep, steeper) if steep > 0 else max(steep, steeper)
        if apart > 2 * edge or 4 * abs(own) > edge:
            median = last + own
    bend = right - 2 * under + left
    turn = i64(rows[_BELOW, at + 2]) - right - left + i64(rows[_BELOW, at - 2])
    extra[_MORE] = median
    ahead, gap = (ahead - median) >> scale, (under - median) >> scale
    extra[0] = ahead if abs(ahead) <= most else 0
    extra[1] = gap if abs(gap) <= most else 0
    extra[2] = max(-most, min(most, bend >> scale))
    extra[3] = max(-most, min(most, turn >> scale))
    total = np.int32(0)
    for n in range(_TAPS):
        total = np.int32(total + np.int32(weights[n] * rows[_RESIDUAL, at - _TAPS + n]))
    for n in range(_TAPS):
        total = np.int32(total + np.int32(weights[_TAPS + n] * rows[_OFF, at - _TAPS // 2 + n]))
    for n in range(_MORE):
        total = np.int32(total + np.int32(weights[2 * _TAPS + n] * extra[n]))
    change = (i64(total) << scale) >> WEIGHT_BITS
    widest = most << scale
    expected: int = median + max(-widest, min(widest, change))
    return expected


@njit("int64(int32[:,::1], int64[::1], int64, int64, int64)", cache=True)
def _instead(rows: I4, place: I8, median: int, last: int, which: int) -> int:
    """Returns what a beam may return that is not what was expected: another surface's range.

    Args:
        rows: of `_ROWS`.
        place: of `_PLACES`.
        median: what is expected without the filter.
        last: filtered range to the left.
        which: 1 for this ring's other surface, 2 for the first of four ranges of the rings below
            that is neither that nor what was expected.
    """
    at, edge = place[_AT], place[_EDGE]
    other: int = last if abs(median - last) > edge else place[_OTHER]
    if which == 1:
        return other
    found: int = i64(rows[_BELOW, at])
    if abs(median - found) <= edge or abs(other - found) <= edge:
        found = i64(rows[_BELOW, at + 1])
    if abs(median - found) <= edge or abs(other - found) <= edge:
        found = i64(rows[_UNDER, at])
    if abs(median - found) <= edge or abs(other - found) <= edge:
        found = i64(rows[_BELOW, at - 1])
    return found


@njit("void(int32[:,::1], int32[::1], int64, int64, float64[::1], float64[:,::1])", cache=True)
def _note(rows: I4, extra: I4, at: int, wanted: int, inputs: Floats, gram: Floats) -> None:
    """Adds a beam to the normal equations of the filter.

    Args:
        rows: of `_ROWS`.
        extra: as `_expect` filled it.
        at: column and `_PAD`.
        wanted: what the filter should have said, as an input.
        inputs: (WEIGHTS + 1,), overwritten.
        gram: (WEIGHTS + 1, WEIGHTS + 1), products of inputs with each other, and last the wanted.
    """
    for n in range(_TAPS):
        inputs[n] = rows[_RESIDUAL, at - _TAPS + n]
        inputs[_TAPS + n] = rows[_OFF, at - _TAPS // 2 + n]
    for n in range(_MORE):
        inputs[2 * _TAPS + n] = extra[n]
    inputs[WEIGHTS] = wanted
    power = 0.0
    for a in range(WEIGHTS):
        power += inputs[a] * inputs[a]
    calm = 1.0 / (_UNEASE + power)
    for a in range(WEIGHTS + 1):
        x = inputs[a] * calm * calm
        if x != 0:
            for b in range(WEIGHTS + 1):
                gram[a, b] += x * inputs[b]


@njit("int64(int32[:,::1], uint8[::1], int64, int64, int64[::1])", cache=True)
def _context(rows: I4, size_classes: U1, at: int, expected: int, marks: I8) -> int:
    """Returns the context of a beam: how large residuals are nearby, and what was lost there."""
    total = i64(
        2 * (rows[_SIZE, at - 1] + rows[_SIZE, at - 2] + rows[_SIZE_BELOW, at])
        + rows[_SIZE, at - 3]
        + rows[_SIZE, at - 4]
        + rows[_SIZE_BELOW, at - 1]
        + rows[_SIZE_BELOW, at + 1]
        + rows[_SIZE_BELOW, at + 2]
        + rows[_SIZE_BELOW, at + 3]
    )
    size: int = i64(size_classes[min((11 * total) >> 4, _CLASSES - 1)])
    below = rows[_GONE_BELOW, at - 1] + rows[_GONE_BELOW, at] + rows[_GONE_BELOW, at + 1]
    gone = i64(rows[_GONE, at - 1] + rows[_GONE, at - 2] + below)
    if gone >= 4:
        return _SKY + size // 5
    if gone == 3:
        return _MIXED + size // 5
    distance: int = i64(expected > marks[0]) + i64(expected > marks[1]) + i64(expected > marks[2])
    if distance > 0:
        return _FAR + (distance - 1) * 6 + size // 5
    return _NEAR + size


@njit("int64(int64)", cache=True)
def _tail_of(context: int) -> int:
    """Returns which of the first four tails an escape in this context has."""
    if context < _FAR:
        return min(3, context // 6)
    return 3


@njit("int64(int32[:,::1], int64[::1], int64[::1], int64, int64, int64)", cache=True)
def _settle(rows: I4, tuning: I8, place: I8, median: int, value: int, k: int) -> int:
    """Takes a decoded range into the rows; returns the filtered range.

    Args:
        rows: of `_ROWS`.
        tuning: floor of the gain in 1/256, steps of a jump, shift of activities, low bits.
        place: of `_PLACES`.
        median: what was expected without the filter; the rows go on from it, so that the filter's
            weights do not act on its own inputs.
        value: the range.
        k: its steps from what was expected.
    """
    at, seen, scale, most = place[_AT], place[_SEEN], place[_SCALE], place[_MOST]
    residual = value - median
    rows[_EXPECTED, at], rows[_GONE, at] = median, 0
    rows[_SIZE, at] = min(((fold(k) >> tuning[3]) + 1) >> 1, _LARGEST)
    if abs(residual) >= tuning[1] * UNITS:
        rows[_HERE, at], rows[_JUMP, at], rows[_RESIDUAL, at], rows[_OFF, at] = value, 1, 0, 0
        place[_SEEN] = 0
        return value
    here: int = median + ((max(UNITS * 2 // (2 * seen + 3), tuning[0]) * residual) >> 8)
    rows[_HERE, at], rows[_JUMP, at] = here, 0
    rows[_RESIDUAL, at] = max(-most, min(most, residual >> scale))
    rows[_OFF, at] = max(-most, min(most, (value - here) >> scale))
    if 2 * abs(residual) >= tuning[1] * UNITS:
        seen = min(seen, 1)
    place[_SEEN] = min(seen + 1, 30)
    return here


@njit("void(int32[:,::1], int64, int64)", cache=True)
def _pass_over(rows: I4, at: int, expected: int) -> None:
    """Takes a lost beam into the rows."""
    rows[_EXPECTED, at], rows[_GONE, at], rows[_HERE, at] = expected, 1, expected
    rows[_JUMP, at], rows[_RESIDUAL, at], rows[_OFF, at] = 0, 0, 0
    rows[_SIZE, at] = (rows[_SIZE, at - 1] + rows[_SIZE_BELOW, at]) >> 1


@njit("void(int64[::1], int64[::1])", cache=True)
def _measure(tuning: I8, place: I8) -> None:
    """Fills bits of scale, the largest input, two thirds of a jump in seven bits, and an edge."""
    widest = tuning[1] * UNITS * 2 // 3
    place[_SCALE] = 4
    while widest >> place[_SCALE] > 127:
        place[_SCALE] += 1
    place[_MOST] = max(4, widest >> place[_SCALE])
    place[_EDGE] = 2 * tuning[1] * UNITS


@njit(
    "void(float32[:,::1], float64, int64[::1], int64[::1], uint8[::1], int32[:,::1], "
    "float64[:,:,::1], uint16[::1], uint32[::1], int32[:,::1], int64[::1])",
    cache=True,
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
    """
    channels, columns = range_m.shape
    low = tuning[3]
    rows = np.zeros((_ROWS, columns + 2 * _PAD), np.int32)
    for at in range(columns + 2 * _PAD):
        rows[_HERE, at] = rows[_EXPECTED, at] = marks[3]
    extra = np.zeros(_MORE + 1, np.int32)
    place, inputs, learns = np.zeros(_PLACES, np.int64), np.zeros(WEIGHTS + 1), len(gram) > 0
    _measure(tuning, place)
    count, words, held, points, rise = 0, 0, 0, 0, 0
    bits = u64(0)
    for row in range(channels - 1, -1, -1):
        _begin(rows, columns, UNITS - tuning[0])
        band = min(row * _PARTS // channels, BANDS - 1)
        last = i64(rows[_BELOW, _PAD]) + rise
        place[_SEEN], place[_OTHER] = 0, last
        for column in range(columns):
            at = column + _PAD
            expected = _expect(rows, weights[band], extra, place, at, last)
            context = _context(rows, size_classes, at, expected, marks)
            place[_AT] = at
            turn = (column & (STATES - 1)) << TURN_SHIFT
            metres = range_m[row, column]
            if metres > 0:
                points += 1
                value, base, which = i64(metres * units_per_m + 0.5), expected, 0
                median = i64(extra[_MORE])
                k = (value - expected + UNITS // 2) >> 8
                whole = fold(k)
                number = min(whole >> low, ESCAPE)
                if number == ESCAPE:
                    enough = ((whole >> low) - 8) << low >> 2  # a quarter, or it is not worth it
                    for n in range(1, 3):
                        start = _instead(rows, place, median, last, n)
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
                    tail = _tail_of(context) if which == 0 else 3 + which
                    symbol = (_TAIL + tail) * STRIDE + token
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
                wanted = (value - median) >> place[_SCALE]
                if learns and column & 3 == row & 3 and abs(wanted) <= place[_MOST]:
                    _note(rows, extra, at, wanted, inputs, gram[band])
                k, before = (value - expected + UNITS // 2) >> 8, last
                last = _settle(rows, tuning, place, median, value, k)
                if abs(last - before) > place[_EDGE]:
                    place[_OTHER] = before
            else:
                symbols[count] = turn | context * STRIDE
                counts[count & 1, context * STRIDE] += 1
                count += 1
                last = i64(extra[_MORE])
                _pass_over(rows, at, last)
            if column == 0:
                rise = last - i64(rows[_BELOW, at])
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
    rows = np.zeros((_ROWS, columns + 2 * _PAD), np.int32)
    for at in range(columns + 2 * _PAD):
        rows[_HERE, at] = rows[_EXPECTED, at] = marks[3]
    extra = np.zeros(_MORE + 1, np.int32)
    place, beams = np.zeros(_PLACES, np.int64), np.zeros(columns, np.int32)
    _measure(tuning, place)
    states = np.empty(STATES, np.uint64)
    for n in range(STATES):
        states[n] = (u64(words[2 * n]) << u64(16)) | u64(words[2 * n + 1])
    at_word, at_raw, held, rise = u64(2 * STATES), 0, 0, 0
    bits = u64(0)
    first = i64(len(xyz)) - 1
    for row in range(channels - 1, -1, -1):
        if at_word > u64(end_word):
            return -1
        _begin(rows, columns, UNITS - tuning[0])
        band = min(row * _PARTS // channels, BANDS - 1)
        last = i64(rows[_BELOW, _PAD]) + rise
        place[_SEEN], place[_OTHER] = 0, last
        returns = 0
        for column in range(columns):
            at = column + _PAD
            expected = _expect(rows, weights[band], extra, place, at, last)
            context = _context(rows, size_classes, at, expected, marks)
            place[_AT] = at
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
                        base, number = _instead(rows, place, i64(extra[_MORE]), last, which), 0
                        table = u64(table_of[_TAIL + 3 + which])
                    else:
                        table = u64(table_of[_TAIL + _tail_of(context)])
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
                value, median = base + unfold(number) * UNITS, i64(extra[_MORE])
                k, before = (value - expected + UNITS // 2) >> 8, last
                beams[column] = value
                last = _settle(rows, tuning, place, median, value, k)
                if abs(last - before) > place[_EDGE]:
                    place[_OTHER] = before
                returns += 1
            else:
                last = i64(extra[_MORE])
                _pass_over(rows, at, last)
            states[column & (STATES - 1)] = state
            if column == 0:
                rise = last - i64(rows[_BELOW, at])
        first -= returns
        if first < 0:
            return -1
        out, side, up = turns[row, 0], turns[row, 1], np.float32(turns[row, 2])
        point = first
        for column in range(columns):
            if rows[_GONE, column + _PAD] == 0:
                metres = np.float32(beams[column] * m_per_unit)
                a, b = azimuths[column, 0], azimuths[column, 1]
                xyz[point, 0] = np.float32(out * a - side * b) * metres
                xyz[point, 1] = np.float32(side * a + out * b) * metres
                xyz[point, 2] = up * metres
                point += 1
    if at_word != u64(end_word) or at_raw != len(raw) or first != 0:
        return -1
    for n in range(STATES):
        if states[n] != u64(START):
            return -1
    return 0
