"""Rain and fog: attenuation of LiDAR beams, and the points that drops return (backscatter).

Rain drops are distributed as Marshall and Palmer (1948) measured: N(D) = 8000 exp(-4.1 R^-0.21 D)
per m^3 and mm of diameter D, mm, at R mm/h. Drops are large against the wavelength: each takes
twice its cross-section from the beam. Fog takes so much that 5 % of the light is left at the
meteorological optical range. Drops send back 1/19 per sr of what they take (O'Connor, Illingworth
and Hogan 2004: 18.8 sr for clouds of water drops).

A single rain drop is a point of its own if it sends back as much as is detected; fog is seen as far
as a pulse's length of it does. Both show where nothing else returns: a solid target is stronger.
Wet surfaces, which are darker, and spray are not modelled.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from perception.arrays import Floats, Floats32
from sensing.beam_divergence import PULSE_M
from sensing.config import LidarConfig
from sensing.reflectivity import TARGET

_DROPS_PER_M3_MM = 8000.0
_LIDAR_RATIO_SR = 19.0
_APERTURE_M = 0.01  # a beam's width as it leaves; ours
_FARTHEST_M, _STEP_M = 60.0, 0.05  # beyond, no drop is detected
_NEAREST_M = 0.9  # nearer, the receiver does not see the beam (Hahner et al., ICCV 2021)
_NEARLY_ALL = 0.999  # of the points: the rest are the farthest
_QUANTILES = 256
# A drop's backscatter is 2 / ratio of its cross-section, a target's reflectivity / pi.
_OF_DROP = 2.0 * np.pi / _LIDAR_RATIO_SR
WEAK = 0.01  # of reflectivity: a step of a sensor that reports per cent
_FILTERED_M = 20.0
_LEAST_CHANCE = 1e-7  # a point in a hundred scans
_DRAW_UNITS = np.float32(4096.0)


def attenuation_per_m(config: LidarConfig) -> float:
    """Returns the extinction coefficient of the air, 1/m; light passes it there and back."""
    fog = 0.0 if config.fog_visibility_m is None else float(-np.log(0.05)) / config.fog_visibility_m
    return _rain_per_m(config.rain_mm_h) + fog


def _slope_per_mm(rain_mm_h: float) -> float:
    return float(4.1 * rain_mm_h**-0.21)


def _rain_per_m(rain_mm_h: float) -> float:
    if rain_mm_h <= 0:
        return 0.0
    return float(np.pi * _DROPS_PER_M3_MM / _slope_per_mm(rain_mm_h) ** 3 * 1e-6)


@dataclass(frozen=True, slots=True, eq=False)
class Backscatter:
    """Points that the air returns on beams that hit nothing.

    Attributes:
        chance: of a beam to return one.
        table: (257, 3) by quantile: the range that n of 256 do not reach, m; the diameter of the
            least drop that is detected there, and what others are larger by on average, both over
            the beam's width.
        fog: the reflectivity of a target that sends back as much as fog.
    """

    chance: float
    table: Floats32
    fog: float


def backscatter(config: LidarConfig) -> Backscatter | None:
    """Returns what the air sends back; None in clear air, and where nothing of it is detected."""
    if not config.rain_mm_h and config.fog_visibility_m is None:
        return None
    range_m = np.arange(_NEAREST_M, _FARTHEST_M, _STEP_M)
    expected = np.cumsum(_drops_per_m(range_m, config) + _fog_per_m(range_m, config)) * _STEP_M
    reached = 1.0 - np.exp(-expected)
    within = max(int(np.searchsorted(reached, _NEARLY_ALL * reached[-1], side="right")), 1)
    reached = reached[:within]
    chance = float(reached[-1])
    if chance < _LEAST_CHANCE:
        return None
    shares = np.linspace(0, chance, _QUANTILES + 1)
    quantiles_m = np.interp(shares, reached, range_m[: len(reached)])
    table = np.zeros((_QUANTILES + 1, 3), np.float32)
    table[:, 0] = quantiles_m
    if config.rain_mm_h:
        table[:, 1] = _least_drop(quantiles_m, config)
        larger_mm = 1.0 / _slope_per_mm(config.rain_mm_h)
        table[:, 2] = larger_mm * 1e-3 / _width_m(quantiles_m, config)
    return Backscatter(chance, table, _fog_reflectivity(config))


def _least_reflectivity(range_m: Floats, config: LidarConfig) -> Floats:
    """Returns the reflectivity of the darkest target that fills the beam and is detected."""
    dark_m = config.range_at_10_percent_m or config.range
    weakened = np.exp(2.0 * attenuation_per_m(config) * range_m)
    result: Floats = TARGET * (range_m / dark_m) ** 2 * weakened
    return result


def _width_m(range_m: Floats, config: LidarConfig) -> Floats:
    """Returns the geometric mean of a beam's width and height."""
    spread_m = config.beam_divergence_mrad * 1e-3 * range_m
    result: Floats = np.sqrt((_APERTURE_M + spread_m) * (_APERTURE_M + spread_m / 2))
    return result


def _least_drop(range_m: Floats, config: LidarConfig) -> Floats:
    """Returns the diameter of the least drop that is detected, over the beam's width."""
    result: Floats = np.sqrt(_least_reflectivity(range_m, config) / _OF_DROP)
    return result


def _drops_per_m(range_m: Floats, config: LidarConfig) -> Floats:
    """Returns how many detected drops a metre of the beam holds, by range."""
    if not config.rain_mm_h:
        return np.zeros_like(range_m)
    width_m, slope = _width_m(range_m, config), _slope_per_mm(config.rain_mm_h)
    least_mm = 1e3 * width_m * _least_drop(range_m, config)
    per_m3 = _DROPS_PER_M3_MM / slope * np.exp(-slope * least_mm)
    result: Floats = np.pi / 4 * width_m**2 * per_m3
    return result


def _fog_reflectivity(config: LidarConfig) -> float:
    if config.fog_visibility_m is None:
        return 0.0
    fog_per_m = float(-np.log(0.05)) / config.fog_visibility_m
    return float(np.pi * fog_per_m / _LIDAR_RATIO_SR * PULSE_M)


def _fog_per_m(range_m: Floats, config: LidarConfig) -> Floats:
    """Returns the rate of points in fog: sure within a pulse's length where it is detected."""
    seen = _fog_reflectivity(config) >= _least_reflectivity(range_m, config)
    return np.where(seen, 1.0 / PULSE_M, 0.0)


@njit(
    "void(float32[::1], float32[::1], float32[::1], float32[::1], float32[::1], float32[:,::1], "
    "float32, float32)",
    cache=True,
)
def add_backscatter(
    distance_m: Floats32,
    draw: Floats32,
    noise: Floats32,
    range_m: Floats32,
    intensity: Floats32,
    table: Floats32,
    chance: np.float32,
    fog: np.float32,
) -> None:
    """Adds the air's points to beams (N,) that nothing returned, this side of what they hit.

    The last bits of the draw decide: the first ones have decided whether the beam returned. The
    noise (N,), normal, determines a drop's size: diameters fall off exponentially.
    """
    for n in range(distance_m.size):
        if range_m[n] > 0:
            continue
        scaled = draw[n] * _DRAW_UNITS
        share = (scaled - np.floor(scaled)) / chance
        if share >= 1:
            continue
        at = share * np.float32(_QUANTILES)
        low = int(at)
        part = at - np.float32(low)
        metres = table[low, 0] + part * (table[low + 1, 0] - table[low, 0])
        least = table[low, 1] + part * (table[low + 1, 1] - table[low, 1])
        if metres < distance_m[n]:
            larger = -math.log(max(0.5 * math.erfc(noise[n] / math.sqrt(2.0)), 1e-9))
            drop = least + larger * table[low, 2]
            range_m[n] = metres
            intensity[n] = min(max(_OF_DROP * drop * drop, fog), 1.0)


def drop_weak(range_m: Floats32, intensity: Floats32) -> None:
    """Removes near returns as weak as the air's, as a sensor's noise filter does.

    After LIOR (Park, Kim and Kim 2020, Fast and Accurate Desnowing Algorithm for LiDAR Point
    Clouds), whose limits of intensity and range are of one sensor in snow; these are ours.
    """
    weak = (intensity < WEAK) & (range_m < _FILTERED_M)
    range_m[weak] = intensity[weak] = 0
