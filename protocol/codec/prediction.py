"""The model of a range image: the expected range of a beam, and the context of its token.

Also what encoder and decoder do once a ring. Helpers that take arrays at each beam are not inlined
by the compiler and can double the time, so that the loops over tokens stand in `range_image`. The
compiler works on all sectors at once where a loop is of int32, writes few arrays, which might
overlap with those it reads, and knows how wide these are.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from protocol.codec.rans import ESCAPE, I2, I4, I8, TAIL_ALPHABET, U1, U2, i32, u64
from protocol.scans import Floats, Floats32

STRIDE = TAIL_ALPHABET
UNITS = 256  # in one step
GONE = 4  # the smallest kind of a lost beam
MIN_FLAT = 1e-3  # of a direction: steeper beams begin as if they were so flat


@njit("float64(float64, float64, float64)", cache=True, nogil=True, inline="always")
def lead_m(radius_m: float, out: float, side: float) -> float:
    """Returns how far along its direction a beam begins."""
    metres: float = radius_m / max(np.sqrt(out * out + side * side), MIN_FLAT)
    return metres


@njit(
    "void(int32[::1], uint8[::1], int64, float64, Array(float64, 2, 'C', readonly=True), int64, "
    "Array(float64, 2, 'C', readonly=True), UniTuple(float64, 2), float32[:,::1], int64, int64)",
    cache=True,
    nogil=True,
)
def place_ring(
    beams: I4,
    kinds: U1,
    sectors: int,
    m_per_unit: float,
    turns: Floats,
    row: int,
    azimuths: Floats,
    origin_m: tuple[float, float],
    xyz: Floats32,
    first: int,
    returns: int,
) -> None:
    """Places the points of a ring.

    Args:
        beams: ranges in units: the first beam of each sector, then the second, and so on, behind as
            many that are no beams.
        kinds: `GONE` or more for lost beams.
        sectors: of a ring.
        m_per_unit: the step by 256.
        turns: (channels, 3), of each ring: how far out and how far round it points, and how far up.
        row: of the ring.
        azimuths: (columns, 2), cosine and sine.
        origin_m: height and radius of `BeamOrigin`.
        xyz: filled from `first` on; has at least one row behind the ring's points.
        first: row of the ring's first point.
        returns: how many points.
    """
    assert turns.shape[1] == xyz.shape[1] == 3
    assert azimuths.shape[1] == 2
    # A beam without return writes too, and is overwritten by the next, but for the ring's last.
    taken, columns = first + returns, len(azimuths)
    wide = (columns + sectors - 1) // sectors
    next_x, next_y, next_z = xyz[taken, 0], xyz[taken, 1], xyz[taken, 2]
    out, side, up = turns[row, 0], turns[row, 1], np.float32(turns[row, 2])
    lift, lead = np.float32(origin_m[0]), np.float32(lead_m(origin_m[1], out, side))
    point, column = u64(first), u64(0)
    for sector in range(sectors):
        at = u64(sectors + sector)
        for _ in range(min(wide, columns - sector * wide)):
            metres = np.float32(beams[at] * m_per_unit)
            a, b = azimuths[column, 0], azimuths[column, 1]
            far = metres + lead
            xyz[point, 0] = np.float32(out * a - side * b) * far
            xyz[point, 1] = np.float32(side * a + out * b) * far
            xyz[point, 2] = up * metres + lift
            point += u64(kinds[at] < GONE)
            at += u64(sectors)
            column += u64(1)
    xyz[taken, 0], xyz[taken, 1], xyz[taken, 2] = next_x, next_y, next_z


SECTORS = 8
LOST = -1  # the range of a lost beam
CALMEST = 15  # more returns in a row without a jump count as so many
MAX_UNITS = 1 << 30
CONTEXTS = 84
COUNTS = 1 << 13  # of symbols
TAIL = 80
LOST_TOKEN = 0  # the token of a lost beam
TOKENS = ESCAPE + 2  # the last of them is the escape
_FAR_M = (56.0, 75.0, 95.0)  # beyond these, returns are lost more and more often
_START_M = 10.0


def distance_marks(units_per_m: float) -> I8:
    """Returns the distances, in units, that separate contexts, and last the one to start at."""
    return np.array([min(int(m * units_per_m), MAX_UNITS) for m in (*_FAR_M, _START_M)], np.int64)


def symbol_room(channels: int, columns: int) -> int:
    """Returns how many symbols an image can have at most."""
    return 2 * channels * (columns + SECTORS)


def _contexts() -> U1:
    """Returns the context of each base (`describe_lower_ring`) and kind of the beam before."""
    result = np.zeros((384, 16), np.uint8)
    for base in range(384):
        level, beside, gone, far = base % 8, base // 8 % 4, base // 32 % 3, base // 96
        for kind in range(16):
            activity, losses = min(kind % 4 + beside, 5), min(kind // 4, 2) + gone
            if losses >= 3:
                context = 72 + 4 * (losses > 3) + min(activity, 3)
            elif far:
                context = 40 + 8 * far + 4 * (activity > 0) + level // 2
            else:
                context = 8 * activity + level
            result[base, kind] = context
    return result.ravel()


def _next_kinds() -> U1:
    """Returns the kind of a beam, by its size class (4: lost), that below and the kind before."""
    result = np.zeros((5, 4, 16), np.uint8)
    for below in range(4):
        for kind in range(16):
            result[:4, below, kind] = np.arange(4)
            result[4, below, kind] = min(kind % 4, below) | min(kind // 4 + 1, 3) << 2
    return result.ravel()


CONTEXT_OF, NEXT_KIND = _contexts(), _next_kinds()


@njit("void(int64, int64, uint16[::1])", cache=True, nogil=True)
def classify(shift: int, low: int, classes: U2) -> None:
    """Fills the size class of each token, as an offset into `NEXT_KIND`."""
    classes[:] = 0
    classes[LOST_TOKEN] = 4 << 6
    for number in range(ESCAPE + 1):
        size = (number + 1) >> 1 if low == 0 else number >> 1
        classes[number + 1] = min(3, size >> (shift - low)) << 6


@njit(
    "void(int32[::1], uint8[::1], int32[::1], int16[::1], int64, int64, int64[::1])",
    cache=True,
    nogil=True,
)
def describe_lower_ring(
    below: I4, kinds: U1, slopes: I4, bases: I2, wide: int, shift: int, marks: I8
) -> None:
    """Fills the slope and the context base of the ring below at each beam.

    Args:
        below: its ranges.
        kinds: its kinds.
        slopes: filled with how much farther each beam reaches than that to its left.
        bases: filled with `how uneven + 8 * size class + 32 * losses + 96 * distance`.
        wide: beams of a sector.
        shift: of activities.
        marks: of `distance_marks`.
    """
    end = wide * SECTORS
    for sector in range(SECTORS):  # what sectors see beyond their ends
        below[sector] = below[end + (sector + 7) % 8]
        below[end + SECTORS + sector] = below[SECTORS + (sector + 1) % 8]
        kinds[sector] = kinds[end + (sector + 7) % 8]
        kinds[end + SECTORS + sector] = kinds[SECTORS + (sector + 1) % 8]
    near, far, farther = np.int32(marks[0]), np.int32(marks[1]), np.int32(marks[2])
    bits = np.int32(5 + shift)
    for at in range(SECTORS, end + SECTORS):
        here = below[at]
        slope = np.int32(here - below[at - SECTORS])
        slopes[at] = slope
        ahead = np.int32(below[at + SECTORS] - here)
        uneven = np.int32(max(np.int32(abs(slope)), np.int32(abs(ahead))) >> bits)
        level = np.int16(uneven > 0) + np.int16(uneven > 1) + np.int16(uneven > 3)
        level += np.int16(uneven > 7) + np.int16(uneven > 15) + np.int16(uneven > 31)
        level += np.int16(uneven > 63)
        gone = np.int16(kinds[at] >= GONE)
        before, behind = kinds[at - SECTORS] >= GONE, kinds[at + SECTORS] >= GONE
        losses = np.int16(gone | before | behind) + np.int16(gone & before & behind)
        distance = np.int16(here > near) + np.int16(here > far) + np.int16(here > farther)
        bases[at] = np.int16(level + 8 * np.int16(kinds[at] & 3) + 32 * losses + 96 * distance)
    for at in range(SECTORS, 2 * SECTORS):
        slopes[at] = 0


@njit("int32(int32, int32, int32)", cache=True, nogil=True)
def expect(last: int, under: int, slope: int) -> int:
    """Returns what a beam is expected to return, by its neighbours to the left and below.

    It is the median of the one to the left, the one below, and the one to the left as much farther
    as the ring below runs there.
    """
    across, level = i32(under - last), i32(0)
    least, most = min(across, level), max(across, level)
    expected: int = last + max(least, min(most, slope))
    return expected


@njit("int32(int32, int32, int32, int32)", cache=True, nogil=True, error_model="numpy")
def follow(k: int, calm: int, floor: int, jump: int) -> int:
    """Returns how far, in units, the filtered range follows a residual of k steps.

    All the way where it jumps; else the less, the more returns in a row came without a jump. The
    quotient is never whole: a float gives the same as a division of whole numbers, which a core
    does one by one.
    """
    gain = i32(np.float32(2 * UNITS) / np.float32(i32(calm + calm + 3)))
    is_jump = i32(abs(k)) >= jump
    moved: int = k * (i32(UNITS) if is_jump else max(gain, floor))
    return moved


@njit("int32(int32, int32, int32, int32)", cache=True, nogil=True)
def still_calm(k: int, calm: int, there: int, jump: int) -> int:
    """Returns how many returns in a row came without a jump, after one more beam."""
    calmer = min(i32(calm + there), i32(CALMEST))
    result: int = i32(0) if i32(abs(k)) >= jump else calmer
    return result


@njit("int32(int32, int32)", cache=True, nogil=True)
def residual(beam: int, expected: int) -> int:
    """Returns a beam's residual in whole steps, 0 of a lost one."""
    k = i32(beam - expected + UNITS // 2) >> i32(8)
    result: int = k if beam >= i32(0) else i32(0)
    return result


@njit(
    "int32(int32[::1], int32[::1], int32[::1], UniTuple(int32, 2), int32, int32[::1], int32[::1], "
    "int32[::1])",
    cache=True,
    nogil=True,
)
def residuals_of_ring(
    beams: I4,
    below: I4,
    slopes: I4,
    limits: tuple[int, int],
    rise: int,
    calms: I4,
    here: I4,
    steps: I4,
) -> int:
    """Finds the residuals of a ring; arrays are as in `describe_lower_ring`.

    Args:
        beams: ranges, `LOST` of lost beams.
        below: filtered ranges of the ring below.
        slopes: how it runs.
        limits: floor of the gain in 1/256, and steps of a jump.
        rise: how much farther than the one below it the ring below began.
        calms: filled with how many returns in a row came without a jump.
        here: filled with filtered ranges.
        steps: filled with folded residuals and one, 0 of lost beams.

    Returns:
        How much farther than the ring below this one begins.
    """
    (floor, jump), end = limits, len(steps) - SECTORS
    change = begins = rise
    for n in range(SECTORS, 2 * SECTORS):
        here[n - SECTORS] = below[n] + change
        expected = expect(here[n - SECTORS], below[n], slopes[n])
        k = residual(beams[n], expected)
        here[n] = expected + follow(k, i32(0), floor, jump)
        calms[n] = still_calm(k, i32(0), i32(beams[n] >= 0), jump)
        change = i32(here[n] - below[n])
        begins = change if n == SECTORS else begins
    for n in range(2 * SECTORS, end):
        at, last, calm = u64(n), here[u64(n - SECTORS)], calms[u64(n - SECTORS)]
        expected = expect(last, below[at], slopes[at])
        k = residual(beams[at], expected)
        here[at] = expected + follow(k, calm, floor, jump)
        calms[at] = still_calm(k, calm, i32(beams[at] >= 0), jump)
    for n in range(SECTORS, end):
        at, last = u64(n), here[u64(n - SECTORS)]
        k = residual(beams[at], expect(last, below[at], slopes[at]))
        folded = i32((k << i32(1)) ^ (k >> i32(31))) + i32(1)
        steps[at] = folded if beams[at] >= i32(0) else i32(0)
    return begins


@njit(
    "int32(int32[::1], uint8[::1], int32[::1], int32[::1], UniTuple(int32, 2), int32, "
    "int32[::1], int32[::1], int32[::1], int32[::1])",
    cache=True,
    nogil=True,
)
def ranges_of_ring(
    steps: I4,
    kinds: U1,
    below: I4,
    slopes: I4,
    limits: tuple[int, int],
    rise: int,
    calms: I4,
    moves: I4,
    here: I4,
    beams: I4,
) -> int:
    """Reverses `residuals_of_ring`.

    Args:
        steps: residuals, 0 of lost beams.
        kinds: `GONE` or more for lost beams.
        below: as there, and so on.
        slopes: as there.
        limits: as there.
        rise: as there.
        calms: as there.
        moves: filled with how far the filtered ranges follow the residuals.
        here: as there.
        beams: filled with ranges.
    """
    (floor, jump), end = limits, len(steps) - SECTORS
    calms[:SECTORS] = 0
    for n in range(SECTORS, end):
        at, calm = u64(n), calms[u64(n - SECTORS)]
        moves[at] = follow(steps[at], calm, floor, jump)
        calms[at] = still_calm(steps[at], calm, i32(kinds[at] < GONE), jump)
    change = begins = rise
    for n in range(SECTORS, 2 * SECTORS):
        here[n - SECTORS] = below[n] + change
        here[n] = expect(here[n - SECTORS], below[n], slopes[n]) + moves[n]
        change = i32(here[n] - below[n])
        begins = change if n == SECTORS else begins
    for n in range(2 * SECTORS, end):
        at, last = u64(n), here[u64(n - SECTORS)]
        here[at] = expect(last, below[at], slopes[at]) + moves[at]
    for n in range(SECTORS, end):
        at = u64(n)
        beams[at] = here[at] - moves[at] + UNITS * steps[at]
    return begins
