"""CARLA's model of loss, intensity and noise."""

from __future__ import annotations

import numpy as np
import pytest

from sensing.config import LidarConfig
from sensing.lidar import MIN_RANGE_M, returns
from sensing.noise import stream

SHAPE = (64, 1800)


def at(distance_m: float) -> np.ndarray:
    return np.full(SHAPE, distance_m, np.float32)


def test_intensity_falls_off_exponentially() -> None:
    config = LidarConfig(dropoff_general_rate=0, noise_stddev=0)
    range_m, intensity = returns(at(50.0), config, stream(1))
    assert np.all(range_m == 50.0)
    assert intensity == pytest.approx(np.exp(-0.004 * 50), rel=1e-5)


@pytest.mark.parametrize(("distance_m", "zero", "kept"), [(20, 0.4, 0.9), (115, 0.4, None)])
def test_losses_have_the_shares_of_carla(distance_m: float, zero: float, kept: float) -> None:
    config = LidarConfig(dropoff_general_rate=0.1, dropoff_zero_intensity=zero)
    range_m, intensity = returns(at(distance_m), config, stream(2))
    if kept is None:
        kept = 0.9 * (1 - zero + np.exp(-0.004 * distance_m) * zero / 0.8)
    assert np.mean(range_m > 0) == pytest.approx(kept, abs=0.005)
    assert np.array_equal(range_m > 0, intensity > 0)


def test_noise_has_its_standard_deviation() -> None:
    config = LidarConfig(dropoff_general_rate=0, noise_stddev=0.03)
    range_m, _ = returns(at(30.0), config, stream(3))
    assert range_m.mean() == pytest.approx(30.0, abs=1e-3)
    assert range_m.std() == pytest.approx(0.03, rel=0.02)


def test_nothing_returns_from_beyond_the_range_or_from_too_near() -> None:
    config = LidarConfig(dropoff_general_rate=0)
    for distance_m in (0.0, MIN_RANGE_M - 0.01, config.range, 1e30):
        range_m, intensity = returns(at(distance_m), config, stream(4))
        assert not range_m.any()
        assert not intensity.any()


def test_a_rays_noise_does_not_depend_on_the_other_rays() -> None:
    config = LidarConfig()
    changed = at(30.0)
    changed[10:] = 1e30
    one, _ = returns(at(30.0), config, stream(5))
    other, _ = returns(changed, config, stream(5))
    assert np.array_equal(one[:10], other[:10])
