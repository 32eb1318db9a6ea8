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
        above, below = max(ring - 1, 0), min(ring + 1, channels - 1)
        for column in range(columns):
            left, right = column - 1 if column else columns - 1, (column + 1) % columns
            own_m, own = distance_m[ring, column], strength[ring, column]
            if (
                abs(distance_m[ring, right] - own_m) < _LEAST_STEP_M
                and abs(distance_m[ring, left] - own_m) < _LEAST_STEP_M
                and abs(distance_m[above, column] - own_m) < _LEAST_STEP_M
                and abs(distance_m[below, column] - own_m) < _LEAST_STEP_M
            ):
                continue
            for side in range(4):
                other_ring, other_column, half = ring, right, np.float32(along)
                if side == 1:
                    other_column = left
                elif side == 2:
                    other_ring, other_column, half = above, column, across[above]
                elif side == 3:
                    other_ring, other_column, half = below, column, across[ring]
                other_m = distance_m[other_ring, other_column]
                if abs(other_m - own_m) < _LEAST_STEP_M:
                    continue
                scaled = draw[ring, column] * np.float32(1024 << side)
                edge = scaled - np.floor(scaled)  # from the own axis to the other one
                if edge < half:
                    share = min((half - edge) / (2 * half), np.float32(0.5))
                    other = strength[other_ring, other_column]
                    mixed_m[ring, column], mixed[ring, column] = _returned(
                        own_m, own, other_m, other, share
                    )
                    break
