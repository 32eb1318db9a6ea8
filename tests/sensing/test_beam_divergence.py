"""Beams with a width: how edges look."""

from __future__ import annotations

import numpy as np
import pytest

from sensing.beam_divergence import PULSE_M
from sensing.config import LidarConfig
from sensing.lidar import RayHits, returns
from sensing.noise import stream

LINES = LidarConfig(dropoff_general_rate=0, noise_stddev=0, range_at_10_percent_m=50)
SHAPE = LINES.channels, LINES.columns


def wide(divergence_mrad: float) -> LidarConfig:
    return LINES.model_copy(update={"beam_divergence_mrad": divergence_mrad})


def posts(near_m: float, far_m: float, near: float = 0.5, far: float = 0.5) -> RayHits:
    """Surfaces ten columns wide at two distances by turns."""
    is_near = np.broadcast_to(np.arange(SHAPE[1]) // 10 % 2 == 0, SHAPE)
    distance_m = np.where(is_near, near_m, far_m).astype(np.float32)
    strength = np.where(is_near, near, far).astype(np.float32)
    return RayHits(distance_m, np.full(SHAPE, -1, np.int32), strength)


def test_beams_that_are_lines_see_either_surface() -> None:
    range_m, _ = returns(posts(10, 10.5), LINES, stream(1))
    assert set(np.unique(range_m)) == {np.float32(10), np.float32(10.5)}


@pytest.mark.parametrize("divergence_mrad", [1.0, 3.0])
def test_as_many_beams_are_mixed_as_their_width_reaches_over_edges(divergence_mrad: float) -> None:
    range_m, _ = returns(posts(10, 10.5), wide(divergence_mrad), stream(1))
    between = (range_m > 10) & (range_m < 10.5)
    half_steps = divergence_mrad * 1e-3 / 2 / (2 * np.pi / SHAPE[1])
    assert between.mean() == pytest.approx(0.2 * half_steps, rel=0.05)


def test_a_beam_across_two_surfaces_far_apart_returns_from_one_of_them() -> None:
    view = posts(10, 10 + 2 * PULSE_M)
    range_m, _ = returns(view, wide(3), stream(1))
    assert set(np.unique(range_m)) == {np.float32(10), np.float32(10 + 2 * PULSE_M)}
    moved = range_m != view.distance_m
    assert 0 < moved.mean() < 0.05
    assert np.all(range_m[moved] == 10)  # the nearer one sends back more


def test_a_brighter_surface_pulls_the_range_to_itself() -> None:
    means = []
    for far in (0.1, 0.9):
        range_m, _ = returns(posts(10, 10.5, far=far), wide(3), stream(1))
        means.append(range_m[(range_m > 10) & (range_m < 10.5)].mean())
    assert means[0] < 10.15 < 10.25 < means[1]


def test_an_edge_before_the_sky_costs_power_and_is_seen_from_beside_it() -> None:
    view = posts(10, LINES.range, far=0.0)
    range_m, intensity = returns(view, wide(3), stream(1))
    near = view.distance_m == 10
    assert np.all(range_m[near] == 10)
    assert set(np.unique(range_m[~near])) == {0, 10}
    assert 0 < (range_m[~near] == 10).mean() < 0.1
    assert np.all(intensity[near] >= 0.25)
    assert (intensity[near] < 0.5).mean() == pytest.approx(0.086, abs=0.01)


def test_a_slope_is_no_edge() -> None:
    columns = np.arange(SHAPE[1], dtype=np.float32)
    slope_m = np.broadcast_to(10 + 0.05 * np.minimum(columns, SHAPE[1] - columns), SHAPE)
    view = RayHits(
        np.ascontiguousarray(slope_m), np.full(SHAPE, -1, np.int32), np.full(SHAPE, 0.9, np.float32)
    )
    range_m, _ = returns(view, wide(3), stream(1))
    hit = range_m > 0
    assert hit.mean() > 0.5
    assert np.array_equal(range_m[hit], view.distance_m[hit])
