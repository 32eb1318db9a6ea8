"""Lost beams that may be sent as if they had returned, where that says nothing untrue.

At a coarse bound a beam that was lost between two returns would have come back nearer to one of
them than any point may move. A point that is put there costs next to nothing, for it is put where
it was expected, while a hole costs some bits. Holes of one or two beams are filled; what is lost
beside the sky, or where the next measured point is farther away than the bound, stays a hole.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
from numba import njit

from protocol.codec.tokens import I4, U1
from protocol.scans import Floats, Floats32, ScanPattern

LOST = -1  # the range of a lost beam
SIDES = 2  # beams that are looked at to the left, and to the right
_FARTHEST = 1 << 20  # in units: float32 says an eighth of one up to here; none is filled beyond


@dataclass(frozen=True, slots=True, eq=False)
class Filling:
    """How far holes of an image (channels, columns) may be filled, and which were.

    Attributes:
        reach_m: how far a filled point may lie from a measured one; 0 if nothing is filled.
        chords: (channels,), squared distance between neighbouring beams of a ring, a metre along.
        filled: (channels, columns), set to 1 by the encoder where it fills; or (0, 0), not to know.
    """

    reach_m: float
    chords: Floats
    filled: U1

    @classmethod
    def of(cls, pattern: ScanPattern, turns: Floats, reach_m: float, *, known: bool) -> Self:
        """Returns the filling of an image of all columns.

        Args:
            pattern: of the scan.
            turns: of the image's rings; see `ScanPattern.spin`.
            reach_m: how far a filled point may lie from a measured one.
            known: whether to say which beams were filled.
        """
        chords = (2 * math.sin(math.pi / pattern.columns) * turns[:, 0]) ** 2
        shape = (len(turns), pattern.columns) if known else (0, 0)
        return cls(reach_m, chords, np.zeros(shape, np.uint8))

    @classmethod
    def nothing(cls, channels: int) -> Self:
        """Returns that of an image whose holes all stay."""
        return cls(0.0, np.zeros(channels), np.zeros((0, 0), np.uint8))

    @property
    def parts(self) -> tuple[float, Floats, U1]:
        """What the loops take."""
        return self.reach_m, self.chords, self.filled


@njit("void(int32[::1], int64, float64, float64, int32[::1], int32[::1])", cache=True, nogil=True)
def find_holes(beams: I4, stride: int, reach: float, chord: float, least: I4, most: I4) -> None:
    """Fills between which ranges each beam of a ring may be filled.

    Args:
        beams: (N + 2 * SIDES * stride,), ranges in units, or `LOST`; each beam's neighbours stand
            `stride` before it and behind it.
        stride: beams that stand between two neighbours, and one more.
        reach: how far a filled point may lie from a measured one, in units, less one.
        chord: squared distance between neighbours, a unit along their beams.
        least: (N,), filled.
        most: (N,), filled; -1 for beams that returned, or stay holes.
    """
    # No branches, and float32: many beams at once. Points on two beams, at ranges a and b, are
    # sqrt((a - b)^2 + a b chord) apart; b is a + reach at most, and a may be half a unit more.
    # 1 - x/2 - x^2/2 <= sqrt(1 - x).
    room, part = np.float32(reach), np.float32(chord / max(reach * reach, 1e-9))
    one, half, none, far = np.float32(1), np.float32(0.5), np.float32(0), np.float32(_FARTHEST)
    count = len(least)
    second, first = beams[:count], beams[stride : stride + count]
    own = beams[2 * stride : 2 * stride + count]
    next_, last = beams[3 * stride : 3 * stride + count], beams[4 * stride : 4 * stride + count]
    for n in range(count):
        left, right = np.float32(first[n]), np.float32(next_[n])
        a = left if left >= none else right
        x = (a + one) * (a + one + room) * part
        v = room * (one - x) * (one + half * x)
        hole = (max(left, np.float32(second[n])) >= none) & (
            max(right, np.float32(last[n])) >= none
        )
        hole &= (np.float32(own[n]) < none) & (a >= none) & (a < far) & (x < one)
        least[n] = np.int32(np.int32(max(a - v, none) if hole else far) + 2)
        most[n] = np.int32(np.int32(a + v if hole else none) - 1)


@njit("void(float32[::1], float64, int32[::1])", cache=True, nogil=True)
def ring_units(range_m: Floats32, units_per_m: float, beams: I4) -> None:
    """Fills a ring's ranges as whole units, with what lies behind its ends, for `find_holes`.

    Args:
        range_m: (columns,), 0 where nothing came back.
        units_per_m: in a metre.
        beams: (columns + 2 * SIDES,).
    """
    columns = len(range_m)
    for column in range(columns):
        metres = range_m[column]
        units = np.int32(metres * units_per_m + 0.5) if metres > 0 else np.int32(LOST)
        beams[column + SIDES] = units
    for n in range(SIDES):
        beams[n] = beams[SIDES + (columns - SIDES + n) % columns]
        beams[SIDES + columns + n] = beams[SIDES + n % columns]
