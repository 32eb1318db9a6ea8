"""From a clean distance to a LiDAR's return: CARLA's model of intensity, loss and noise."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from perception.arrays import Floats32
from protocol.geometry import Floats
from sensing.config import LidarConfig

MIN_RANGE_M = 0.5


def returns(
    distance_m: Floats32, config: LidarConfig, rng: np.random.Generator
) -> tuple[Floats32, Floats32]:
    """Returns range, 0 for none, and intensity, each of the distance's shape.

    After CARLA 0.9's `ARayCastLidar` (`RayCastLidar.cpp`): intensity is exp(-attenuation * d).
    `PreprocessRays` loses a ray with the general rate; `PostprocessDetection` moves the point
    along its ray by normal noise, then keeps one of intensity I above the limit always, any other
    with probability (1 - zero) + I * zero / limit. Here both losses are decided by one draw, with
    the product of the probabilities. Numbers are drawn for every ray, so that a ray's noise does
    not depend on what other rays hit.

    Args:
        distance_m: to the first surface along each ray; the range's end or more for none.
        config: the sensor's parameters.
        rng: two draws per ray.
    """
    lot = rng.random(distance_m.shape, np.float32)
    noise = rng.standard_normal(distance_m.shape, np.float32)
    intensity = distance_m * np.float32(-config.atmosphere_attenuation_rate)
    np.exp(intensity, out=intensity)
    range_m = np.empty_like(distance_m)
    rates = np.array(
        [
            np.float32(config.range),
            1.0 - config.dropoff_general_rate,
            config.dropoff_intensity_limit,
            config.dropoff_zero_intensity,
            config.noise_stddev,
        ]
    )
    flat = [a.reshape(-1) for a in (distance_m, lot, noise, range_m, intensity)]
    _lose(*flat, rates)
    return range_m, intensity


def share_kept(distance_m: Floats, config: LidarConfig) -> Floats:
    """Returns the probability that a ray which hits something at this distance returns."""
    intensity = np.exp(-config.atmosphere_attenuation_rate * distance_m)
    zero, limit = config.dropoff_zero_intensity, config.dropoff_intensity_limit
    weak = np.where(intensity <= limit, 1.0 - zero + intensity * zero / limit, 1.0)
    result: Floats = (1.0 - config.dropoff_general_rate) * weak
    return result


@njit(
    "void(float32[::1], float32[::1], float32[::1], float32[::1], float32[::1], float64[::1])",
    cache=True,
)
def _lose(
    distance_m: Floats32,
    lot: Floats32,
    noise: Floats32,
    range_m: Floats32,
    intensity: Floats32,
    rates: npt.NDArray[np.float64],
) -> None:
    farthest, keep, limit, zero, stddev = rates
    for n in range(len(distance_m)):
        value = intensity[n]
        chance = keep
        if value <= limit:
            chance *= 1.0 - zero + value * zero / limit
        if MIN_RANGE_M <= distance_m[n] < farthest and lot[n] < chance:
            range_m[n] = max(distance_m[n] + noise[n] * stddev, MIN_RANGE_M)
        else:
            range_m[n] = 0.0
            intensity[n] = 0.0
