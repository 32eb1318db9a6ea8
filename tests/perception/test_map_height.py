"""The map's height, corrected by what scans show."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perception.detector import Cloud
from perception.map_height import TRUSTED_M, on_the_ground
from perception.roadway import Placed

NOWHERE = np.zeros((1, 3))


def road(error_m: float, slope: float = 0.0, cars: int = 30) -> Placed:
    """Returns a road's points, 200 m x 14 m, over a map that is off; car roofs among them."""
    rng = np.random.default_rng(1)
    ground = rng.uniform((-100, -7, 0), (100, 7, 0), (30_000, 3))
    ground[:, 2] = error_m + slope * ground[:, 0] + rng.normal(0, 0.03, len(ground))
    roofs = np.concatenate(
        [
            rng.uniform((x, y, error_m + 1.4), (x + 4.5, y + 1.8, error_m + 1.5), (200, 3))
            for x, y in rng.uniform((-95, -7), (90, 5), (cars, 2))
        ]
    )
    roofs[:, 2] += slope * roofs[:, 0]
    points = np.concatenate([ground, roofs]).astype(np.float32)
    return Placed.of(points, np.zeros(len(points), np.float32))


@settings(max_examples=20)
@given(st.floats(-1.0, 1.0), st.floats(-0.006, 0.006))
def test_the_ground_is_found_wherever_the_map_has_it(error_m: float, slope: float) -> None:
    part = road(error_m, slope)
    found = on_the_ground(Cloud([part], [], NOWHERE)).near[0]
    is_ground = np.arange(len(part.points)) < 30_000
    over_m = (found.points[:, 2] - found.road_m)[is_ground]
    inside = np.abs(part.points[is_ground, 0]) < 85
    assert np.abs(np.median(over_m[inside])) < TRUSTED_M + 0.1
    assert np.quantile(np.abs(over_m[inside]), 0.95) < TRUSTED_M + 0.15


@pytest.mark.parametrize("error_m", [0.0, 0.1, -0.1])
def test_a_map_that_is_right_is_left_alone(error_m: float) -> None:
    cloud = Cloud([road(error_m)], [], NOWHERE)
    assert on_the_ground(cloud) is cloud


def test_parts_without_ground_move_with_the_others() -> None:
    bare = Placed.of(np.array([[5.0, 0, 2.0]], np.float32), np.zeros(1, np.float32))
    found = on_the_ground(Cloud([road(1.0)], [bare], np.zeros((2, 3))))
    assert found.bare[0].road_m[0] == pytest.approx(1.0, abs=0.1)
    alone = Cloud([], [bare], NOWHERE)
    assert on_the_ground(alone) is alone


def test_an_empty_cloud_stays_empty() -> None:
    none = np.zeros((0, 3), np.float32)
    cloud = Cloud([Placed(none, none[:, 0], none)], [], NOWHERE)
    assert on_the_ground(cloud) is cloud
