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

from protocol.codec.tokens import (
    I4,
    I8,
    U1,
    fold,
    i64,
)
from protocol.codec.walk import UNITS
from protocol.scans import Floats

CONTEXTS = 62
_NEAR, _FAR, _MIXED, _SKY, TAIL = 0, 26, 44, 50, 56
PAD = 16  # columns to either side, those of the ring's other end
_TAPS = 8  # of the filter, on the ring and on the ring below
MORE = 4  # inputs besides
WEIGHTS = 2 * _TAPS + MORE
WEIGHT_BITS = 7
BANDS = 4  # of rings, each with weights of its own
_UNEASE = 5e3  # added to the power of the inputs, by whose square a beam counts less
_LARGEST = 127  # size of a residual
_CLASSES = 1 << 10
# Rows of whole numbers along a ring: its filtered ranges and those of the ring below, smoothed;
# residuals; what smoothing took off; what was expected; sizes of residuals here and below; beams
# lost here and below; jumps; and the ring two below, smoothed.
HERE, BELOW, _RESIDUAL, _OFF, EXPECTED, _SIZE, _SIZE_BELOW, _GONE, _GONE_BELOW, _JUMP = range(10)
_UNDER = 10
ROWS = 11
# Whole numbers that beams of a ring pass on: column and `PAD`, returns since a jump, bits by which
# inputs are shorter than ranges, largest input, range before the last edge, range of an edge.
AT, SEEN, SCALE, MOST, OTHER, EDGE = range(6)
PLACES = 6


def _size_classes() -> U1:
    """Returns the class of a sum of sizes: half octaves."""
    result = np.zeros(_CLASSES, np.uint8)
    for total in range(1, _CLASSES):
        octave = (2 * total).bit_length() - 1
        result[total] = min(2 * octave + ((4 * total >> octave) & 1), 25)
    return result


SIZE_CLASSES = _size_classes()


@njit("void(int32[:,::1], int64, int64)", cache=True, nogil=True)
def begin(rows: I4, columns: int, step: int) -> None:
    """Makes the ring that is complete the ring below: smooths it and closes its circle.

    Args:
        rows: of `ROWS`.
        columns: of a ring.
        step: share of a correction that reaches the column before, in 1/256.
    """
    correction = 0
    for at in range(PAD + columns - 1, PAD - 1, -1):
        here = i64(rows[HERE, at])
        smooth = here + correction
        rows[_UNDER, at], rows[BELOW, at] = rows[BELOW, at], smooth
        ahead = correction + here - rows[EXPECTED, at]
        correction = 0 if rows[_JUMP, at] else (ahead * step) >> 8
        rows[_SIZE_BELOW, at] = rows[_SIZE, at]
        rows[_GONE_BELOW, at] = rows[_GONE, at]
    for row in (BELOW, _OFF, _SIZE_BELOW, _GONE_BELOW):
        for n in range(PAD):
            rows[row, n] = rows[row, n + columns]
            rows[row, PAD + columns + n] = rows[row, PAD + n]
    for n in range(PAD):
        rows[_RESIDUAL, n] = 0
        rows[_SIZE, n] = rows[_SIZE_BELOW, n]
        rows[_GONE, n] = rows[_GONE_BELOW, n]


@njit(
    "int64(int32[:,::1], int32[::1], int32[::1], int64[::1], int64, int64)", cache=True, nogil=True
)
def expect(rows: I4, weights: I4, extra: I4, place: I8, at: int, last: int) -> int:
    """Returns what a beam is expected to return; fills four more inputs of the filter.

    Args:
        rows: of `ROWS`.
        weights: (WEIGHTS,).
        extra: (MORE + 1,), filled, and last what is expected without the filter.
        place: of `PLACES`.
        at: column and `PAD`.
        last: filtered range to the left.
    """
    scale, most, edge = place[SCALE], place[MOST], place[EDGE]
    under = i64(rows[BELOW, at])
    left, right = i64(rows[BELOW, at - 1]), i64(rows[BELOW, at + 1])
    slope = under - left if at > PAD else 0
    ahead = last + slope
    median = max(min(last, under), min(max(last, under), ahead))
    apart = abs(last - left)
    if apart > edge:  # the ring below is of another surface here: go on as before
        before = i64(rows[HERE, at - 2])
        steep, steeper = last - before, before - i64(rows[HERE, at - 3])
        own = 0
        if at >= PAD + 3 and (steep > 0) == (steeper > 0):
            own = min(steep, steeper) if steep > 0 else max(steep, steeper)
        if apart > 2 * edge or 4 * abs(own) > edge:
            median = last + own
    bend = right - 2 * under + left
    turn = i64(rows[BELOW, at + 2]) - right - left + i64(rows[BELOW, at - 2])
    extra[MORE] = median
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
    for n in range(MORE):
        total = np.int32(total + np.int32(weights[2 * _TAPS + n] * extra[n]))
    change = (i64(total) << scale) >> WEIGHT_BITS
    widest = most << scale
    expected: int = median + max(-widest, min(widest, change))
    return expected


@njit("int64(int32[:,::1], int64[::1], int64, int64, int64)", cache=True, nogil=True)
def instead(rows: I4, place: I8, median: int, last: int, which: int) -> int:
    """Returns what a beam may return that is not what was expected: another surface's range.

    Args:
        rows: of `ROWS`.
        place: of `PLACES`.
        median: what is expected without the filter.
        last: filtered range to the left.
        which: 1 for this ring's other surface, 2 for the first of four ranges of the rings below
            that is neither that nor what was expected.
    """
    at, edge = place[AT], place[EDGE]
    other: int = last if abs(median - last) > edge else place[OTHER]
    if which == 1:
        return other
    found: int = i64(rows[BELOW, at])
    if abs(median - found) <= edge or abs(other - found) <= edge:
        found = i64(rows[BELOW, at + 1])
    if abs(median - found) <= edge or abs(other - found) <= edge:
        found = i64(rows[_UNDER, at])
    if abs(median - found) <= edge or abs(other - found) <= edge:
        found = i64(rows[BELOW, at - 1])
    return found


@njit(
    "void(int32[:,::1], int32[::1], int64, int64, float64[::1], float64[:,::1])",
    cache=True,
    nogil=True,
)
def note(rows: I4, extra: I4, at: int, wanted: int, inputs: Floats, gram: Floats) -> None:
    """Adds a beam to the normal equations of the filter.

    Args:
        rows: of `ROWS`.
        extra: as `expect` filled it.
        at: column and `PAD`.
        wanted: what the filter should have said, as an input.
        inputs: (WEIGHTS + 1,), overwritten.
        gram: (WEIGHTS + 1, WEIGHTS + 1), products of inputs with each other, and last the wanted.
    """
    for n in range(_TAPS):
        inputs[n] = rows[_RESIDUAL, at - _TAPS + n]
        inputs[_TAPS + n] = rows[_OFF, at - _TAPS // 2 + n]
    for n in range(MORE):
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


@njit("int64(int32[:,::1], uint8[::1], int64, int64, int64[::1])", cache=True, nogil=True)
def context_of(rows: I4, size_classes: U1, at: int, expected: int, marks: I8) -> int:
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


@njit("int64(int64)", cache=True, nogil=True)
def tail_of(context: int) -> int:
    """Returns which of the first four tails an escape in this context has."""
    if context < _FAR:
        return min(3, context // 6)
    return 3


@njit("int64(int32[:,::1], int64[::1], int64[::1], int64, int64, int64)", cache=True, nogil=True)
def settle(rows: I4, tuning: I8, place: I8, median: int, value: int, k: int) -> int:
    """Takes a decoded range into the rows; returns the filtered range.

    Args:
        rows: of `ROWS`.
        tuning: floor of the gain in 1/256, steps of a jump, shift of activities, low bits.
        place: of `PLACES`.
        median: what was expected without the filter; the rows go on from it, so that the filter's
            weights do not act on its own inputs.
        value: the range.
        k: its steps from what was expected.
    """
    at, seen, scale, most = place[AT], place[SEEN], place[SCALE], place[MOST]
    residual = value - median
    rows[EXPECTED, at], rows[_GONE, at] = median, 0
    rows[_SIZE, at] = min(((fold(k) >> tuning[3]) + 1) >> 1, _LARGEST)
    if abs(residual) >= tuning[1] * UNITS:
        rows[HERE, at], rows[_JUMP, at], rows[_RESIDUAL, at], rows[_OFF, at] = value, 1, 0, 0
        place[SEEN] = 0
        return value
    here: int = median + ((max(UNITS * 2 // (2 * seen + 3), tuning[0]) * residual) >> 8)
    rows[HERE, at], rows[_JUMP, at] = here, 0
    rows[_RESIDUAL, at] = max(-most, min(most, residual >> scale))
    rows[_OFF, at] = max(-most, min(most, (value - here) >> scale))
    if 2 * abs(residual) >= tuning[1] * UNITS:
        seen = min(seen, 1)
    place[SEEN] = min(seen + 1, 30)
    return here


@njit("void(int32[:,::1], int64, int64)", cache=True, nogil=True)
def pass_over(rows: I4, at: int, expected: int) -> None:
    """Takes a lost beam into the rows."""
    rows[EXPECTED, at], rows[_GONE, at], rows[HERE, at] = expected, 1, expected
    rows[_JUMP, at], rows[_RESIDUAL, at], rows[_OFF, at] = 0, 0, 0
    rows[_SIZE, at] = (rows[_SIZE, at - 1] + rows[_SIZE_BELOW, at]) >> 1


@njit("void(int64[::1], int64[::1])", cache=True, nogil=True)
def measure(tuning: I8, place: I8) -> None:
    """Fills bits of scale, the largest input, two thirds of a jump in seven bits, and an edge."""
    widest = tuning[1] * UNITS * 2 // 3
    place[SCALE] = 4
    while widest >> place[SCALE] > 127:
        place[SCALE] += 1
    place[MOST] = max(4, widest >> place[SCALE])
    place[EDGE] = 2 * tuning[1] * UNITS
