"""What the walks over a range image share, whatever model says what each beam should return.

Only what is done once a scan or once a ring: helpers that take arrays at each beam are not inlined,
and can double the time of a walk.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from protocol.codec.rans import START, STATES
from protocol.codec.tokens import I4, TAIL_ALPHABET, U1, U2, U8, u64
from protocol.scans import Floats, Floats32

STRIDE = TAIL_ALPHABET
UNITS = 256  # in one step
GONE = 4  # the smallest kind of a lost beam


@njit("void(uint16[::1], uint64[::1])", cache=True, nogil=True)
def open_states(words: U2, states: U8) -> None:
    """Fills the states of the entropy coder."""
    for n in range(STATES):
        states[n] = (u64(words[2 * n]) << u64(16)) | u64(words[2 * n + 1])


@njit("boolean(uint64[::1])", cache=True, nogil=True)
def are_done(states: U8) -> bool:
    """Returns whether all states are where they began: if not, the payload is damaged."""
    done = True
    for n in range(STATES):
        done &= states[n] == u64(START)
    return done


@njit(
    "void(int32[::1], uint8[::1], int64, float64, Array(float64, 2, 'C', readonly=True), int64, "
    "Array(float64, 2, 'C', readonly=True), float32[:,::1], int64, int64)",
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
        xyz: filled from `first` on; has at least one row behind the ring's points.
        first: row of the ring's first point.
        returns: how many points.
    """
    # A beam without return writes too, and is overwritten by the next, but for the ring's last.
    taken, columns = first + returns, len(azimuths)
    wide = (columns + sectors - 1) // sectors
    next_x, next_y, next_z = xyz[taken, 0], xyz[taken, 1], xyz[taken, 2]
    out, side, up = turns[row, 0], turns[row, 1], np.float32(turns[row, 2])
    point, column = u64(first), u64(0)
    for sector in range(sectors):
        at = u64(sectors + sector)
        for _ in range(min(wide, columns - sector * wide)):
            metres = np.float32(beams[at] * m_per_unit)
            a, b = azimuths[column, 0], azimuths[column, 1]
            xyz[point, 0] = np.float32(out * a - side * b) * metres
            xyz[point, 1] = np.float32(side * a + out * b) * metres
            xyz[point, 2] = up * metres
            point += u64(kinds[at] < GONE)
            at += u64(sectors)
            column += u64(1)
    xyz[taken, 0], xyz[taken, 1], xyz[taken, 2] = next_x, next_y, next_z
