"""Beam divergence: at an edge, both surfaces return light (mixed pixels).

An edge between two beams lies anywhere between their axes. A beam whose width reaches over it
brings back the power of both surfaces by their share of the beam. If they lie within a pulse's
length of each other, the pulses merge and the range lies in between, weighted by power (Tuley,
Vandapel and Hebert 2005, Analysis and Removal of Artifacts in 3-D LADAR Data); else the stronger
return is the one that counts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from perception.arrays import Floats32
from protocol.scans import ScanPattern

PULSE_M = 0.75  # 5 ns there and back, as of the HDL-64E's data sheet
_LEAST_STEP_M = 0.1  # between neighbours; less is a slope, not an edge
_RIGHT, _LEFT, _ABOVE, _BELOW = 0, 1, 2, 3  # sides of a beam


@dataclass(frozen=True, slots=True, eq=False)
class BeamWidths:
    """Widths of beams.

    Attributes:
        along: half a beam's width in steps between its ring's beams.
        across: (channels,) half a beam's height in steps between a ring and the next; 0 for the
            last.
    """

    along: float
    across: Floats32

    @classmethod
    def of(cls, pattern: ScanPattern, divergence_mrad: float) -> BeamWidths:
        """Returns the widths for a full divergence along the ring, and half of it across."""
        half_rad = divergence_mrad * 1e-3 / 2
        apart = -np.diff(pattern.elevations_rad)
        across = np.append(half_rad / 2 / np.maximum(apart, 1e-6), 0.0).astype(np.float32)
        return cls(half_rad * pattern.columns / (2 * np.pi), across)


@njit("void(float32[:,::1], int64, int64, int64, float32[:,::1])", cache=True)
def _beside(image: Floats32, ring: int, above: int, below: int, sides: Floats32) -> None:
    """Writes what is beside each beam of a ring (4, N): to the right, the left, above, below."""
    last = image.shape[1] - 1
    for n in range(last):
        sides[_RIGHT, n], sides[_LEFT, n + 1] = image[ring, n + 1], image[ring, n]
    sides[_RIGHT, last], sides[_LEFT, 0] = image[ring, 0], image[ring, last]
    for n in range(last + 1):
        sides[_ABOVE, n], sides[_BELOW, n] = image[above, n], image[below, n]


@njit("float32(float32, float32, float32, int64, float32)", cache=True, inline="always")
def _share_beyond(
    own_m: np.float32, other_m: np.float32, draw: np.float32, side: int, half: np.float32
) -> np.float32:
    """Returns the share of a beam, by half its width, beyond the edge to a side; 0 for none.

    Where the edge lies follows from the last bits of the beam's draw, others for each side.
    """
    scaled = draw * np.float32(1024 << side)
    edge = scaled - np.float32(np.int32(scaled))  # from the own axis to the other one
    reaches = (abs(other_m - own_m) >= np.float32(_LEAST_STEP_M)) & (edge < half)
    share = (half - edge) / (np.float32(2) * half)
    return min(share, np.float32(0.5)) if reaches else np.float32(0)


@njit(
    "void(float32[::1], float32[::1], float32[::1], float32[:,::1], float32[:,::1], "
    "float32[::1], float32[::1], float32[::1])",
    cache=True,
    error_model="numpy",
)
def _mix_ring(
    own_m: Floats32,
    own: Floats32,
    draw: Floats32,
    sides_m: Floats32,
    sides: Floats32,
    halves: Floats32,
    mixed_m: Floats32,
    mixed: Floats32,
) -> None:
    """Writes distances and strengths of a ring's beams (N,).

    Of what is beside them, distances and strengths are (4, N), and half the beams' widths (4,): the
    first side with an edge within a beam counts. Choices take no branch, so that beams are worked
    on side by side.
    """
    for n in range(own_m.size):
        one_m, other_m, other, share = own_m[n], own_m[n], np.float32(0), np.float32(0)
        for back in range(4):
            side = 3 - back
            beyond = _share_beyond(one_m, sides_m[side, n], draw[n], side, halves[side])
            is_this = beyond > 0
            share = beyond if is_this else share
            other_m = sides_m[side, n] if is_this else other_m
            other = sides[side, n] if is_this else other
        own_power = (1 - share) * own[n] / (one_m * one_m)
        other_power = share * other / (other_m * other_m)
        both = own_power + other_power
        middle_m = (own_power * one_m + other_power * other_m) / both
        merges = (own_power > 0) & (other_power > 0) & (abs(other_m - one_m) < PULSE_M)
        stronger = other_power > own_power
        apart_m = other_m if stronger else one_m
        apart = np.float32(share * other if stronger else (1 - share) * own[n])
        mixed_m[n] = np.float32(middle_m) if merges else apart_m
        mixed[n] = np.float32(both * middle_m * middle_m) if merges else apart


@njit(
    "void(float32[:,::1], float32[:,::1], float32[:,::1], float64, float32[::1], float32[:,::1], "
    "float32[:,::1])",
    cache=True,
)
def mix_at_edges(
    distance_m: Floats32,
    strength: Floats32,
    draw: Floats32,
    along: float,
    across: Floats32,
    mixed_m: Floats32,
    mixed: Floats32,
) -> None:
    """Writes distances and strengths (channels, columns) of beams that have a width.

    Where the edge lies follows from the last bits of each beam's draw, which decides with its
    first ones whether the beam returns. The first ring has none above, the last none below.

    Args:
        distance_m: what the beams' axes hit; the range's end where nothing.
        strength: reflectivity times cosine; 0 where nothing is hit.
        draw: uniform from 0 to 1.
        along: see `BeamWidths`.
        across: see `BeamWidths`.
        mixed_m: filled with distances.
        mixed: filled with strengths.
    """
    channels, columns = distance_m.shape
    sides_m, sides = np.empty((4, columns), np.float32), np.empty((4, columns), np.float32)
    halves = np.empty(4, np.float32)
    for ring in range(channels):
        above, below = max(ring - 1, 0), min(ring + 1, channels - 1)
        halves[_RIGHT] = halves[_LEFT] = along
        halves[_ABOVE], halves[_BELOW] = across[above], across[ring]
        _beside(distance_m, ring, above, below, sides_m)
        _beside(strength, ring, above, below, sides)
        given = distance_m[ring], strength[ring], draw[ring]
        _mix_ring(*given, sides_m, sides, halves, mixed_m[ring], mixed[ring])
