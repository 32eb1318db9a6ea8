"""Boxes that lie in front of their points."""

from __future__ import annotations

import numpy as np
import pytest

from perception.arrays import Floats, Floats32, Ints
from perception.pillars.seen_side import behind_their_points

HEIGHT_M = np.full(20, 0.8, np.float32)


def wall(across_m: float, yaw: float, origin: tuple[float, float]) -> Floats32:
    """Returns a strip (20, 3) along a car's side, so far across its middle."""
    along = np.linspace(-2, 2, 20)
    cos, sin = np.cos(yaw), np.sin(yaw)
    x = origin[0] + cos * along - sin * across_m
    y = origin[1] + sin * along + cos * across_m
    return np.column_stack([x, y, np.full(20, 0.8)]).astype(np.float32)


def seen_from(across_m: float, yaw: float, origin: tuple[float, float]) -> Floats:
    return np.array([[origin[0] - np.sin(yaw) * across_m, origin[1] + np.cos(yaw) * across_m, 2.0]])


def sizes(points: Floats32) -> Ints:
    return np.array([len(points)], np.int64)


@pytest.mark.parametrize("yaw", [0.0, 0.7, 2.0, -1.3])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_box_through_which_the_sensor_would_look_moves_behind_its_points(
    yaw: float, side: float
) -> None:
    origin = (30.0, -12.0)
    box = np.array([[*origin, 0.8, 4.5, 1.8, 1.5, yaw]])
    points = wall(-0.9 * side, yaw, origin)
    sensor = seen_from(12.0 * side, yaw, origin)
    moved = behind_their_points(box, points, HEIGHT_M, sizes(points), sensor)
    middle = np.array(origin) + 1.8 * side * np.array([np.sin(yaw), -np.cos(yaw)])
    np.testing.assert_allclose(moved[0, :2], middle, atol=1e-3)
    np.testing.assert_array_equal(moved[0, 2:], box[0, 2:])


@pytest.mark.parametrize(
    ("across_m", "sensor_m"), [(0.9, 12.0), (-0.9, -12.0), (-0.9, 1.0), (0.9, 0.0)]
)
def test_a_box_whose_points_may_be_the_side_seen_stays(across_m: float, sensor_m: float) -> None:
    box = np.array([[5.0, 5.0, 0.8, 4.5, 1.8, 1.5, 0.3]])
    points = wall(across_m, 0.3, (5.0, 5.0))
    sensor = seen_from(sensor_m, 0.3, (5.0, 5.0))
    moved = behind_their_points(box, points, HEIGHT_M, sizes(points), sensor)
    np.testing.assert_array_equal(moved, box)


def test_the_ground_in_front_of_a_car_is_none_of_its_points() -> None:
    box = np.array([[0.0, 0.0, 0.8, 4.5, 1.8, 1.5, 0.0]])
    side, ground = wall(-0.9, 0.0, (0.0, 0.0)), wall(0.9, 0.0, (0.0, 0.0))
    heights = np.concatenate([HEIGHT_M, np.zeros(20, np.float32)])
    both = np.concatenate([side, ground])
    moved = behind_their_points(box, both, heights, sizes(both), np.array([[0.0, 12.0, 2.0]]))
    assert moved[0, 1] == pytest.approx(-1.8, abs=1e-3)


def test_the_sensor_that_counts_is_the_one_that_saw_most_points() -> None:
    box = np.array([[0.0, 0.0, 0.8, 4.5, 1.8, 1.5, 0.0]])
    side = wall(-0.9, 0.0, (0.0, 0.0))
    sensors = np.array([[0.0, 12.0, 2.0], [0.0, -12.0, 2.0]])
    moved = behind_their_points(box, side, HEIGHT_M, np.array([5, 15]), sensors)
    np.testing.assert_array_equal(moved, box)
    moved = behind_their_points(box, side, HEIGHT_M, np.array([15, 5]), sensors)
    assert moved[0, 1] == pytest.approx(-1.8, abs=1e-3)


def test_a_box_without_points_and_no_boxes_at_all_stay() -> None:
    nothing = np.zeros((0, 3), np.float32)
    box = np.array([[0.0, 0.0, 0.8, 4.5, 1.8, 1.5, 0.0]])
    none, sensor = np.zeros(1, np.int64), np.array([[0.0, 12.0, 2.0]])
    heights = np.zeros(0, np.float32)
    np.testing.assert_array_equal(behind_their_points(box, nothing, heights, none, sensor), box)
    assert len(behind_their_points(box[:0], nothing, heights, none[:0], sensor[:0])) == 0
