"""RANSAC planes: the ground goes, cars stay."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from perception.config import GroundConfig
from perception.ground import remove_ground
from perception.roadway import Placed

CLIMB = 0.035


def scene(ground: Callable[..., Any], car_shell: Callable[..., Any]) -> tuple[Any, Any, int]:
    """Returns a climbing road with cars (N, 3), its mapped height (N,) and the ground's size."""
    rng = np.random.default_rng(3)
    flat = ground(rng, climb=CLIMB)
    cars = [
        car_shell([x, 1.75, CLIMB * x, 0, -np.arctan(CLIMB), 0], (0.0, 0.0), rng)
        for x in (-90, -40, -12, 15, 60, 120)
    ]
    points = np.concatenate([flat, *cars])
    return points, (CLIMB * points[:, 0]).astype(np.float32), len(flat)


def test_tiles_take_the_ground_of_a_climbing_road_and_leave_the_cars(
    ground: Callable[..., Any], car_shell: Callable[..., Any]
) -> None:
    points, road_m, flat = scene(ground, car_shell)
    above, ground_m, _ = remove_ground(
        [Placed.of(points, road_m)], config=GroundConfig(), rng=np.random.default_rng(1)
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
    above, _, _ = remove_ground(
        [Placed.of(points, np.zeros(len(points), np.float32))], config=GroundConfig(), rng=rng
    )
    assert len(above) == 20_000
    assert above[:, 2].min() > 1.0


@pytest.mark.parametrize("mapped_m", [0.0, 1.0], ids=["as mapped", "mapped too high"])
def test_far_away_a_piece_of_a_ring_on_the_mapped_road_goes_and_a_vehicle_stays(
    mapped_m: float,
) -> None:
    """One ring crosses the road beside a vehicle's front; where the map is wrong, all stays."""
    across_m = np.arange(3.0, 9.0, 0.4)
    ring = np.column_stack([np.full(15, 93.0), across_m, np.full(15, 0.05)])
    front = np.array([(93.5, y, z) for y in (3.5, 4.0, 4.5, 5.0) for z in (0.3, 0.6, 1.3)])
    points = np.concatenate([ring, front]).astype(np.float32)
    road_m = np.full(len(points), mapped_m, np.float32)
    above, ground_m, _ = remove_ground(
        [Placed.of(points, road_m)], config=GroundConfig(), rng=np.random.default_rng(1)
    )
    left = points if mapped_m else front.astype(np.float32)
    np.testing.assert_array_equal(above, left)
    assert ground_m.tolist() == [mapped_m] * len(left)


def test_global_planes_serve_a_level_road(ground: Callable[..., Any]) -> None:
    points = ground(np.random.default_rng(3))
    config = GroundConfig(tile_m=None)
    none = np.zeros(len(points), np.float32)
    above, _, _ = remove_ground(
        [Placed.of(points, none)], config=config, rng=np.random.default_rng(1)
    )
    assert len(above) < 0.001 * len(points)


def test_the_same_seed_gives_the_same_points_and_arguments_are_left_alone(
    ground: Callable[..., Any], car_shell: Callable[..., Any]
) -> None:
    points, road_m, _ = scene(ground, car_shell)
    before = points.copy(), road_m.copy()
    one, other = (
        remove_ground(
            [Placed.of(points, road_m)], config=GroundConfig(), rng=np.random.default_rng(9)
        )
        for _ in range(2)
    )
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(points, before[0])
    np.testing.assert_array_equal(road_m, before[1])


@pytest.mark.parametrize("count", [0, 1, 2, 7])
def test_hardly_any_points_are_no_trouble(count: int) -> None:
    points = np.full((count, 3), 2.0, np.float32)
    placed = Placed.of(points, np.zeros(count, np.float32))
    above, ground_m, _ = remove_ground(
        [placed], config=GroundConfig(), rng=np.random.default_rng(1)
    )
    assert len(above) == len(ground_m) == count


def test_no_parts_give_no_points() -> None:
    above, ground_m, _ = remove_ground([], config=GroundConfig(), rng=np.random.default_rng(1))
    assert above.shape == (0, 3)
    assert ground_m.shape == (0,)


@pytest.mark.parametrize("tile_m", [20.0, None])
def test_a_cloud_in_parts_is_one_cloud(
    ground: Callable[..., Any], car_shell: Callable[..., Any], tile_m: float | None
) -> None:
    points, road_m, _ = scene(ground, car_shell)
    config = GroundConfig(tile_m=tile_m)
    cuts = [0, 1, 7000, 7000, len(points)]
    parts = [Placed.of(points[a:b], road_m[a:b]) for a, b in pairwise(cuts)]
    whole, parted = (
        remove_ground(given, config=config, rng=np.random.default_rng(4))
        for given in ([Placed.of(points, road_m)], parts)
    )
    for a, b in zip(whole[:2], parted[:2], strict=True):
        np.testing.assert_array_equal(a, b)
    assert parted[2].sum() == whole[2][0] == len(whole[0])
    assert len(parted[2]) == len(parts)
