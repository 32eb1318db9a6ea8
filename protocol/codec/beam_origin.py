"""Where the beams of a spinning LiDAR begin: on a circle about its axis, at a height.

Files give points in the frame of a housing, whose origin is at its foot, and lasers stand some
centimetres off the axis (Ouster's sensors 4 to 8 cm up and 1 to 3 cm out). Seen from the origin of
the frame a laser's points then lie at another elevation for each range; seen from where the beams
begin, at one. There the slopes of points gather in as few values as there are lasers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from protocol.codec.rans import I8
from protocol.limits import MAX_BEAM_HEIGHT_M, MAX_BEAM_RADIUS_M
from protocol.scans import Floats

_HEIGHTS_M = np.arange(-24, 25) * 0.005
_RADII_M = np.array([0.0, 0.02])
_NEAR_HEIGHTS_M, _NEAR_RADII_M = np.arange(-6, 7) * 0.001, np.arange(-4, 5) * 0.005
_WIDTH, _NEAR_WIDTH = 1e-3, 2.5e-4  # of the bins of slopes
_SLOPE = 2.0  # the steepest that is looked at
_SAMPLE, _NEAR_SAMPLE = 512, 2048  # of points
_CLEARLY = 1.1  # times as many pairs share a slope as from the origin of the frame
_BY_CHANCE = 6.0  # standard deviations of the number of these pairs: of some 100 places one has 3
_AS_GOOD = 0.99  # of the most: the middle of such places is taken
_LEAST_AWAY_M = 0.05


@dataclass(frozen=True, slots=True)
class BeamOrigin:
    """Height over the origin of the frame, and distance from its z axis, in m, float32."""

    height_m: float = 0.0
    radius_m: float = 0.0

    @property
    def is_allowed(self) -> bool:
        """Whether it may stand in a payload."""
        return abs(self.height_m) <= MAX_BEAM_HEIGHT_M and 0 <= self.radius_m <= MAX_BEAM_RADIUS_M

    def seen_from(self, points: Floats) -> Floats:
        """Returns points (N, 3) of the sensor frame as seen from where their beams begin."""
        away_m = np.hypot(points[:, 0], points[:, 1])
        share = np.maximum(1.0 - self.radius_m / np.maximum(away_m, 1e-9), 0.0)
        x, y = points[:, 0] * share, points[:, 1] * share
        return np.stack([x, y, points[:, 2] - self.height_m], -1)


FRAME_ORIGIN = BeamOrigin()


def find_origin(points: Floats) -> BeamOrigin:
    """Returns where the beams of a cloud (N, 3) begin, the frame's origin if none is better."""
    zero, radii_m = np.zeros(1), _RADII_M
    given = *_sample(points, _SAMPLE), _WIDTH, np.zeros(_bins(_WIDTH), np.int64)
    at_zero = float(_shared(*given, zero, zero)[0, 0])
    found = _shared(*given, _HEIGHTS_M, radii_m)
    if found.max() <= max(_CLEARLY * at_zero, at_zero + _BY_CHANCE * math.sqrt(at_zero + 1)):
        return FRAME_ORIGIN
    height, radius = np.unravel_index(int(found.argmax()), found.shape)
    heights_m = _HEIGHTS_M[height] + _NEAR_HEIGHTS_M
    radii_m = np.unique(np.maximum(radii_m[radius] + _NEAR_RADII_M, 0.0))
    given = *_sample(points, _NEAR_SAMPLE), _NEAR_WIDTH, np.zeros(_bins(_NEAR_WIDTH), np.int64)
    found = _shared(*given, heights_m, radii_m)
    if found.max() <= _CLEARLY * _shared(*given, zero, zero)[0, 0]:
        return FRAME_ORIGIN
    heights, radii = np.nonzero(found >= _AS_GOOD * found.max())
    height_m, radius_m = heights_m[heights].mean(), radii_m[radii].mean()
    return BeamOrigin(float(np.float32(height_m)), float(np.float32(radius_m)))


def _sample(points: Floats, size: int) -> tuple[Floats, Floats]:
    """Returns how far from the axis some of the points are, and how high."""
    some = points[:: max(1, len(points) // size)]
    return np.hypot(some[:, 0], some[:, 1]), np.ascontiguousarray(some[:, 2])


def _bins(width: float) -> int:
    return math.ceil(2 * _SLOPE / width) + 2


@njit(
    "int64[:,::1](float64[::1], float64[::1], float64, int64[::1], float64[::1], float64[::1])",
    cache=True,
    nogil=True,
)
def _shared(
    away_m: Floats, z: Floats, width: float, counts: I8, heights_m: Floats, radii_m: Floats
) -> I8:
    """Returns how many pairs of points share a bin of slopes, by height and radius of the origin.

    Args:
        away_m: distances of points from the axis.
        z: their heights.
        width: of the bins.
        counts: zeros for each bin, and one for steeper points; zeros again afterwards.
        heights_m: that are tried.
        radii_m: that are tried.
    """
    result = np.zeros((len(heights_m), len(radii_m)), np.int64)
    at, last, per_slope = np.empty(len(away_m), np.int64), counts.size - 1, 1.0 / width
    for one in range(len(heights_m)):
        for other in range(len(radii_m)):
            for n in range(len(away_m)):
                slope = (z[n] - heights_m[one]) / max(away_m[n] - radii_m[other], _LEAST_AWAY_M)
                at[n] = int((slope + _SLOPE) * per_slope) if abs(slope) < _SLOPE else last
            pairs = 0
            for n in range(len(away_m)):
                pairs += counts[at[n]] * (at[n] < last)
                counts[at[n]] += 1
            result[one, other] = pairs
            for n in range(len(away_m)):
                counts[at[n]] = 0
    return result
