"""RANSAC planes: the ground goes, cars stay."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from perception.config import GroundConfig
from perception.ground import remove_ground

CLIMB = 0.035


def scene(ground: Callable[..., Any], shell: Callable[..., Any]) -> tuple[Any, Any, int]:
    """Returns a climbing road with cars (N, 3), its mapped height (N,) and the ground's size."""
    rng = np.random.default_rng(3)
    flat = ground(rng, climb=CLIMB)
    cars = [
        shell([x, 1.75, CLIMB * x, 0, -np.arctan(CLIMB), 0], (0.0, 0.0), rng)
        for x in (-90, -40, -12, 15, 60, 120)
    ]
    points = np.concatenate([flat, *cars])
    return points, (CLIMB * points[:, 0]).astype(np.float32), len(flat)


def test_tiles_take_the_ground_of_a_climbing_road_and_leave_the_cars(
    ground: Callable[..., Any], shell: Callable[..., Any]
) -> None:
    points, road_m, flat = scene(ground, shell)
    above, ground_m = remove_ground(
        points, road_m, config=GroundConfig(), rng=np.random.default_rng(1)
    )
    high = (points[flat:, 2] - road_m[flat:] > 0.8).sum()
    assert (above[:, 2] - CLIMB * above[:, 0] > 0.8).sum() == high
    assert (above[:, 2] - CLIMB * above[:, 0] < 0.15).sum() < 0.001 * flat
    assert np.abs(ground_m - CLIMB * above[:, 0]).max() < 0.3


def test_a_wall_of_points_beside_a_sensor_does_not_tilt_the_ground() -> None:
    rng = np.random.default_rng(5)
    ground = np.column_stack([rng.uniform(0, 20, (4000, 2)), rng.normal(0, 0.02, 4000)])
    roofs = np.column_stack([rng.uniform(8, 12, (20_000, 2)), rng.normal(1.5, 0.02, 20_000)])
    points = np.concatenate([ground, roofs]).astype(np.float32)
    above, _ = remove_ground(
        points, np.zeros(len(points), np.float32), config=GroundConfig(), rng=rng
    )
    assert len(above) == 20_000
    assert above[:, 2].min() > 1.0


def test_global_planes_serve_a_level_road(ground: Callable[..., Any]) -> None:
    points = ground(np.random.default_rng(3))
    config = GroundConfig(tile_m=None)
    none = np.zeros(len(points), np.float32)
    above, _ = remove_ground(points, none, config=config, rng=np.random.default_rng(1))
    assert len(above) < 0.001 * len(points)


def test_the_same_seed_gives_the_same_points_and_arguments_are_left_alone(
    ground: Callable[..., Any], shell: Callable[..., Any]
) -> None:
    points, road_m, _ = scene(ground, shell)
    before = points.copy(), road_m.copy()
    one, other = (
        remove_ground(points, road_m, config=GroundConfig(), rng=np.random.default_rng(9))
        for _ in range(2)
    )
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(points, before[0])
    np.testing.assert_array_equal(road_m, before[1])


@pytest.mark.parametrize("count", [0, 1, 2, 7])
def test_hardly_any_points_are_no_trouble(count: int) -> None:
    points = np.full((count, 3), 2.0, np.float32)
    above, ground_m = remove_ground(
        points, np.zeros(count, np.float32), config=GroundConfig(), rng=np.random.default_rng(1)
    )
    assert len(above) == len(ground_m) == count
