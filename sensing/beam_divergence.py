"""Beams with a width: at an edge, both surfaces return light (mixed pixels).

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
_RIGHT, _LEFT, _ABOVE = 0, 1, 2  # sides of a beam; the fourth is below


@dataclass(frozen=True, slots=True, eq=False)
class BeamWidths:
    """How far beams reach.

    Attributes:
        along: half a beam's width in steps between its ring's beams.
        across: (channels,) half a beam's height in steps between a ring and the next; 0 for the
            last.
    """

    along: float
    across: Floats32

    @classmethod
    def of(cls, pattern: ScanPattern, divergence_mrad: float) -> BeamWidths:
        """Returns those of a full divergence along the ring, across it half of that."""
        half_rad = divergence_mrad * 1e-3 / 2
        apart = -np.diff(pattern.elevations_rad)
        across = np.append(half_rad / 2 / np.maximum(apart, 1e-6), 0.0).astype(np.float32)
        return cls(half_rad * pattern.columns / (2 * np.pi), across)


@njit("UniTuple(float32, 2)(float32, float32, float32, float32, float32)", cache=True)
def _returned(
    own_m: np.float32, own: np.float32, other_m: np.float32, other: np.float32, share: np.float32
) -> tuple[np.float32, np.float32]:
    """Returns distance and strength of a beam of which a share is on another surface."""
    own_power = (1 - share) * own / (own_m * own_m)
    other_power = share * other / (other_m * other_m)
    if own_power > 0 and other_power > 0 and abs(other_m - own_m) < PULSE_M:
        both = own_power + other_power
        middle_m = (own_power * own_m + other_power * other_m) / both
        return np.float32(middle_m), np.float32(both * middle_m * middle_m)
    if other_power > own_power:
        return other_m, np.float32(share * other)
    return own_m, np.float32((1 - share) * own)


@njit("UniTuple(int64, 2)(int64, int64, int64, int64, int64)", cache=True)
def _neighbour(ring: int, column: int, side: int, channels: int, columns: int) -> tuple[int, int]:
    """Returns the ring and column beside a beam; the beam itself above the first, below the last.

    In the order of `side`: to the right, to the left, above, below.
    """
    if side == _RIGHT:
        return ring, (column + 1) % columns
    if side == _LEFT:
        return ring, column - 1 if column else columns - 1
    if side == _ABOVE:
        return max(ring - 1, 0), column
    return min(ring + 1, channels - 1), column


@njit("float32(float32, int64, float32)", cache=True)
def _share_of_other(draw: np.float32, side: int, half: np.float32) -> np.float32:
    """Returns the share of a beam, by half its width, beyond the edge to a side; 0 for none.

    Where the edge lies follows from the last bits of the beam's draw, others for each side.
    """
    scaled = draw * np.float32(1024 << side)
    edge = scaled - np.floor(scaled)  # from the own axis to the other one
    if edge < half:
        return min((half - edge) / (2 * half), np.float32(0.5))
    return np.float32(0.0)


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
    first ones whether the beam returns.

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
    mixed_m[:], mixed[:] = distance_m, strength
    for ring in range(channels):
        for column in range(columns):
            own_m, own = distance_m[ring, column], strength[ring, column]
            for side in range(4):
                other_ring, other_column = _neighbour(ring, column, side, channels, columns)
                other_m = distance_m[other_ring, other_column]
                if abs(other_m - own_m) < _LEAST_STEP_M:
                    continue
                half = across[min(ring, other_ring)] if side >= _ABOVE else np.float32(along)
                share = _share_of_other(draw[ring, column], side, half)
                if share > 0:
                    other = strength[other_ring, other_column]
                    mixed_m[ring, column], mixed[ring, column] = _returned(
                        own_m, own, other_m, other, share
                    )
                    break
