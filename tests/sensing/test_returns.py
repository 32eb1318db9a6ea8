"""Loss, intensity and noise: as CARLA has them, and by the power that comes back."""

from __future__ import annotations

import numpy as np
import pytest

from sensing.config import LidarConfig
from sensing.lidar import RayHits, returns
from sensing.noise import stream
from sensing.reflectivity import MIN_RANGE_M

SHAPE = (64, 1800)


def at(distance_m: float, strength: float | None = None) -> RayHits:
    shape = SHAPE if strength is not None else (0, 0)
    power = np.full(shape, strength or 0.0, np.float32)
    nobody = np.full(SHAPE, -1, np.int32)
    return RayHits(np.full(SHAPE, distance_m, np.float32), nobody, power)


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
    changed.distance_m[10:] = 1e30
    one, _ = returns(at(30.0), config, stream(5))
    other, _ = returns(changed, config, stream(5))
    assert np.array_equal(one[:10], other[:10])


DARK_50_M = LidarConfig(dropoff_general_rate=0, noise_stddev=0, range_at_10_percent_m=50)


def test_a_target_of_10_percent_is_detected_at_the_range_that_is_stated() -> None:
    range_m, intensity = returns(at(50.0, 0.1), DARK_50_M, stream(6))
    assert np.mean(range_m > 0) == pytest.approx(0.9, abs=0.005)
    assert intensity[range_m > 0] == pytest.approx(0.1)


@pytest.mark.parametrize("strength", [0.025, 0.1, 0.4])
def test_the_range_goes_with_the_root_of_the_power(strength: float) -> None:
    reach_m = 50.0 * np.sqrt(strength / 0.1)
    near, far = (returns(at(reach_m * k, strength), DARK_50_M, stream(7))[0] for k in (0.7, 1.5))
    assert np.mean(near > 0) > 0.995
    assert np.mean(far > 0) < 0.005


def test_what_sends_nothing_back_is_not_detected() -> None:
    range_m, intensity = returns(at(5.0, 0.0), DARK_50_M, stream(8))
    assert not range_m.any()
    assert not intensity.any()


def test_the_general_rate_is_lost_however_bright_a_target_is() -> None:
    config = DARK_50_M.model_copy(update={"dropoff_general_rate": 0.2})
    range_m, _ = returns(at(20.0, 3.0), config, stream(9))
    assert np.mean(range_m > 0) == pytest.approx(0.8, abs=0.01)
