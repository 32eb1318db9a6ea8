"""Rain and fog: what they take and what they send back."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from sensing.config import LidarConfig
from sensing.lidar import RayHits, returns
from sensing.noise import stream
from sensing.weather import WEAK, attenuation_per_m, backscatter

CLEAR = LidarConfig(
    dropoff_general_rate=0, noise_stddev=0, range_at_10_percent_m=50, beam_divergence_mrad=3
)
SHAPE = CLEAR.channels, CLEAR.columns


def with_air(**air: float) -> LidarConfig:
    return CLEAR.model_copy(update=air)


def at(distance_m: float, strength: float) -> RayHits:
    shape = np.full(SHAPE, distance_m, np.float32), np.full(SHAPE, -1, np.int32)
    return RayHits(*shape, np.full(SHAPE, strength, np.float32))


SKY = at(CLEAR.range, 0.0)


def test_clear_air_takes_and_sends_nothing() -> None:
    assert attenuation_per_m(CLEAR) == 0
    assert backscatter(CLEAR) is None
    assert not returns(SKY, CLEAR, stream(1))[0].any()


@pytest.mark.parametrize(("rain_mm_h", "db_per_km"), [(2, 1.71), (12.5, 5.84), (25, 9.29)])
def test_rain_takes_what_was_measured_over_kilometres(rain_mm_h: float, db_per_km: float) -> None:
    """Against 1.076 R^0.67 dB/km (Carbonneau, in ITU-R P.1814), which others measured up to 1.6."""
    taken = attenuation_per_m(with_air(rain_mm_h=rain_mm_h)) * 1e3 * 10 / np.log(10)
    assert db_per_km < taken < 1.7 * db_per_km


def test_at_the_visibility_a_twentieth_of_the_light_is_left() -> None:
    extinction = attenuation_per_m(with_air(fog_visibility_m=200.0))
    assert np.exp(-extinction * 200) == pytest.approx(0.05)


def test_a_target_in_fog_is_detected_as_far_as_it_sends_back_as_much() -> None:
    extinction = attenuation_per_m(with_air(fog_visibility_m=500.0))
    strength = 0.1 * (30 / 50) ** 2 * np.exp(2 * extinction * 30)
    range_m, _ = returns(at(30.0, strength), with_air(fog_visibility_m=500.0), stream(2))
    assert np.mean(range_m == 30) == pytest.approx(0.9, abs=0.005)


@pytest.mark.parametrize("air", [{"rain_mm_h": 5.0}, {"fog_visibility_m": 300.0}])
def test_the_air_returns_near_weak_points_where_nothing_else_does(
    air: dict[str, float],
) -> None:
    range_m, intensity = returns(SKY, with_air(**air), stream(3))
    model = backscatter(with_air(**air))
    assert model is not None
    assert np.mean(range_m > 0) == pytest.approx(model.chance, abs=0.005)
    found_m = range_m[range_m > 0]
    assert found_m.min() >= 0.9
    assert found_m.max() < 20
    middle_m = model.table[len(model.table) // 2, 0]
    assert np.mean(found_m < middle_m) == pytest.approx(0.5, abs=0.01)
    assert 0 < intensity[range_m > 0].max() < 0.2
    assert np.mean(intensity[range_m > 0] < WEAK) > 0.9


@pytest.mark.parametrize(
    "air",
    [
        *({"fog_visibility_m": visibility_m} for visibility_m in (11_000.0, 20_000.0, 100_000.0)),
        *({"rain_mm_h": rain_mm_h} for rain_mm_h in (1e-12, 1e-6, 1e-3)),
    ],
)
def test_air_that_is_nearly_clear_returns_points_close_by_at_most(air: dict[str, float]) -> None:
    range_m, _ = returns(SKY, with_air(**air), stream(3))
    assert np.mean(range_m > 0) < 0.1
    assert range_m.max() < 5.0


def test_more_rain_and_thicker_fog_return_more_and_from_farther_off() -> None:
    light, heavy = (backscatter(with_air(rain_mm_h=rain)) for rain in (2.0, 25.0))
    thin, thick = (backscatter(with_air(fog_visibility_m=fog)) for fog in (2000.0, 100.0))
    for less, more in ((light, heavy), (thin, thick)):
        assert less is not None
        assert more is not None
        assert less.chance < more.chance
        assert less.table[-2, 0] < more.table[-2, 0]


def test_a_target_hides_the_air_behind_it_and_outshines_that_before_it() -> None:
    wet = with_air(rain_mm_h=25.0)
    assert np.all(returns(at(5.0, 0.5), wet, stream(4))[0] == 5)
    dark_m, _ = returns(at(2.0, 0.0), wet, stream(4))
    assert np.all(dark_m < 2)
    assert dark_m.any()


def test_a_drop_is_detected_where_a_target_that_sends_back_as_much_would_be() -> None:
    range_m, intensity = returns(SKY, with_air(rain_mm_h=10.0), stream(5))
    found = range_m > 0
    extinction = attenuation_per_m(with_air(rain_mm_h=10.0))
    least = 0.1 * (range_m[found] / 50) ** 2 * np.exp(2 * extinction * range_m[found])
    assert np.all(intensity[found] > 0.95 * least)


def test_the_noise_filter_removes_the_air_and_leaves_the_rest() -> None:
    air = {"rain_mm_h": 2.0, "fog_visibility_m": 1000.0}
    raw, filtered = (
        returns(SKY, with_air(**air, noise_filter=on), stream(6))[0] for on in (False, True)
    )
    assert np.mean(filtered > 0) < 0.05 * np.mean(raw > 0)
    asphalt = at(8.0, 0.05)
    raw, filtered = (
        returns(asphalt, with_air(**air, noise_filter=on), stream(6))[0] for on in (False, True)
    )
    assert np.array_equal(raw[raw == 8], filtered[filtered == 8])


@pytest.mark.parametrize(
    "key",
    [{"noise_filter": 1}, {"rain_mm_h": 1}, {"fog_visibility_m": 100}, {"beam_divergence_mrad": 3}],
)
def test_what_acts_on_power_needs_a_range_that_follows_from_it(key: dict[str, float]) -> None:
    with pytest.raises(ValidationError, match="needs range_at_10_percent_m"):
        LidarConfig(**key)
