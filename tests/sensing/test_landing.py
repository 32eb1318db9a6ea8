"""Steep rays and the ground."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sensing.config import SceneConfig
from sensing.landing import REACH_M, Landing
from sensing.terrain import Terrain
from tests.sensing.conftest import SEED, street

HILLY = Terrain(street(climb_m=8.0), SceneConfig(terrain_amplitude_m=1.0), SEED)
LANDING = Landing(HILLY)


@settings(deadline=None, max_examples=60)
@given(st.floats(-150, 150), st.floats(-6, 6), st.floats(1.0, 10.0), st.floats(1.0, 8.0))
def test_steep_rays_end_on_the_ground_where_they_first_meet_it(
    x: float, y: float, above_m: float, factor: float
) -> None:
    position = np.array([x, y, HILLY.height_m([[x, y]])[0] + above_m])
    fall = LANDING.steepness(position) * factor
    angle = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    rays = np.column_stack([np.cos(angle), np.sin(angle), np.full(90, -fall)]).astype(np.float32)
    limits = np.full(90, 1e6, np.float32)
    LANDING.cast(position, rays, limits)
    ends = position + rays * limits[:, None]
    assert limits.max() <= REACH_M * 1.01
    assert np.abs(ends[:, 2] - HILLY.height_m(ends[:, :2])).max() < 1e-3
    for share in (0.2, 0.5, 0.8, 0.95):
        on_the_way = position + rays * (limits * share)[:, None]
        assert (on_the_way[:, 2] > HILLY.height_m(on_the_way[:, :2])).all()


def test_a_nearer_limit_stays() -> None:
    position = np.array([50.0, 0.0, HILLY.height_m([[50.0, 0.0]])[0] + 2.0])
    limits = np.array([0.5, 100.0], np.float32)
    LANDING.cast(position, np.array([[0, 0, -1], [0, 0, -1]], np.float32), limits)
    assert limits.tolist() == [0.5, 2.0]


def test_no_ray_is_steep_enough_from_under_the_ground_or_outside() -> None:
    under = np.array([0.0, 0.0, -100.0])
    outside = np.array([1e5, 0.0, 3.0])
    assert LANDING.steepness(under) == math.inf
    assert LANDING.steepness(outside) == math.inf
