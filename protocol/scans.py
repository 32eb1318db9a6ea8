"""LiDAR scans of a known firing pattern, clouds of points, and the profiles to encode them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from protocol.errors import CodecError
from protocol.limits import MAX_BEAMS, MAX_KEPT_BEAMS, MAX_KEPT_PATTERNS


class Profile(StrEnum):
    """Compression profile: encoding time against size. Every profile keeps the same bound.

    FAST: differences and zstd, the least time. DEFAULT: a model of the scene and an entropy coder,
    a third to a half of those bytes.
    """

    FAST = "fast"
    DEFAULT = "default"


def profile_named(name: str) -> Profile:
    """Returns the profile of this name.

    Raises:
        CodecError: there is none.
    """
    try:
        return Profile(name)
    except ValueError:
        known = ", ".join(Profile)
        raise CodecError(f"profile {name!r}: must be one of {known}") from None


Floats = npt.NDArray[np.float64]
Floats32 = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class ScanPattern:
    """A LiDAR's firing pattern: rings from top to bottom, columns of equal azimuth.

    `elevations_deg` are those of the rings, to 0.01 deg; without, the spacing is equal.
    """

    channels: int
    columns: int
    upper_fov_deg: float
    lower_fov_deg: float
    elevations_deg: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        check_beams(self.channels, self.columns)
        if not -90 <= self.lower_fov_deg <= self.upper_fov_deg <= 90:
            raise CodecError(
                f"field of view {self.lower_fov_deg} to {self.upper_fov_deg} deg: "
                "needs -90 <= lower <= upper <= 90"
            )
        if self.elevations_deg:
            self._check_elevations()

    @classmethod
    def of_rings(cls, elevations_deg: Sequence[float], columns: int) -> ScanPattern:
        """Returns the pattern of rings of these elevations, from top to bottom.

        Raises:
            CodecError: they do not go down by 0.01 deg at least, or are no elevations.
        """
        rings = tuple(round(float(one), 2) for one in elevations_deg)
        if not rings:
            raise CodecError("elevations of rings: there are none")
        return cls(len(rings), columns, rings[0], rings[-1], rings)

    def _check_elevations(self) -> None:
        rings = self.elevations_deg
        if len(rings) != self.channels or (rings[0], rings[-1]) != (
            self.upper_fov_deg,
            self.lower_fov_deg,
        ):
            raise CodecError(
                f"elevations of {len(rings)} rings from {rings[0]} to {rings[-1]} deg: the pattern "
                f"has {self.channels} from {self.upper_fov_deg} to {self.lower_fov_deg} deg"
            )
        if any(upper <= lower for upper, lower in pairwise(rings)):
            raise CodecError(f"elevations of rings {rings}: each must lie below the one before")

    @property
    def elevations_rad(self) -> Floats:
        """Elevations of the rings (channels,), from top to bottom."""
        if self.elevations_deg:
            return np.radians(np.array(self.elevations_deg, np.float64))
        return np.radians(np.linspace(self.upper_fov_deg, self.lower_fov_deg, self.channels))

    @property
    def directions(self) -> Floats32:
        """Unit vectors (channels, columns, 3) in the sensor frame.

        Row 0 is the uppermost ring; column c looks to azimuth 2 pi c / columns, CCW from +x.
        """
        return (_directions if self._is_kept else _directions.__wrapped__)(self)

    @property
    def spin(self) -> tuple[Floats, Floats]:
        """What the directions are products of.

        (channels, 3): how far out, how far round (0) and how far up each ring points; and
        (columns, 2): cosine and sine of each column's azimuth.
        """
        return (_spin if self._is_kept else _spin.__wrapped__)(self)

    @property
    def _is_kept(self) -> bool:
        """Whether its size is usual: others must not fill the memory of a receiver."""
        return self.channels * self.columns <= MAX_KEPT_BEAMS


@dataclass(frozen=True, slots=True, eq=False)
class RangeScan:
    """One revolution. `range_m` (channels, columns) is 0 where nothing came back."""

    pattern: ScanPattern
    range_m: Floats32
    intensity: Floats32

    def __post_init__(self) -> None:
        shape = (self.pattern.channels, self.pattern.columns)
        if self.range_m.shape != shape or self.intensity.shape != shape:
            raise CodecError(
                f"range has shape {self.range_m.shape}, intensity {self.intensity.shape}, "
                f"the pattern {shape}"
            )

    def cloud(self) -> PointCloud:
        """Returns the points in the sensor frame, ring by ring."""
        hit = np.flatnonzero(self.range_m > 0)
        points = self.pattern.directions.reshape(-1, 3).take(hit, axis=0)
        points *= self.range_m.take(hit)[:, None]
        return PointCloud(points, self.intensity.take(hit))


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud:
    """Points (N, 3) in the sensor frame, metres; intensity (N,) from 0 to 1, 0 where not sent."""

    points: Floats32
    intensity: Floats32


def check_beams(channels: int, columns: int) -> None:
    """Checks the number of beams of a pattern against the limit.

    Raises:
        CodecError: no beams, or more than the limit.
    """
    if not (channels >= 1 and columns >= 1 and channels * columns <= MAX_BEAMS):
        raise CodecError(f"pattern {channels} x {columns}: 1 to {MAX_BEAMS} beams")


@lru_cache(maxsize=MAX_KEPT_PATTERNS)
def _spin(pattern: ScanPattern) -> tuple[Floats, Floats]:
    elevation = pattern.elevations_rad
    azimuth = np.arange(pattern.columns) * (2 * np.pi / pattern.columns)
    turns = np.stack([np.cos(elevation), np.zeros(pattern.channels), np.sin(elevation)], -1)
    azimuths = np.stack([np.cos(azimuth), np.sin(azimuth)], -1)
    turns.setflags(write=False)
    azimuths.setflags(write=False)
    return turns, azimuths


@lru_cache(maxsize=MAX_KEPT_PATTERNS)
def _directions(pattern: ScanPattern) -> Floats32:
    turns, azimuths = pattern.spin
    flat = turns[:, :1]
    up = np.broadcast_to(turns[:, 2:], (pattern.channels, pattern.columns))
    sides = [flat * azimuths[:, 0], flat * azimuths[:, 1], up]
    result = np.stack(sides, -1).astype(np.float32)
    result.setflags(write=False)
    return result
