"""Leaves scatter, vehicles do not, and of hedges a vehicle's outline tells smooth ones."""

from __future__ import annotations

import numpy as np
import pytest

from perception.roughness import LEAST_POINTS, are_leafy
from protocol.geometry import SE3

NOISE_M = 0.02
BOX = np.array([12.0, 3.0, 0.8, 4.4, 1.8, 1.6, 0.5])


def placed(local: np.ndarray, box: np.ndarray = BOX) -> np.ndarray:
    """Moves points (N, 3), x along a box and z over the road, to where it stands."""
    road_SE3_box = SE3.from_pose([box[0], box[1], 0.0, 0.0, 0.0, box[6]])
    return road_SE3_box.apply(local).astype(np.float32)


def side(seed: int, depth_m: float, height_m=lambda x: np.full_like(x, 1.6)) -> np.ndarray:
    """A box's near side, its points so deep, up to a height along it."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-2.2, 2.2, 600)
    z = rng.uniform(0.3, 1.0, 600) * height_m(x)
    return placed(np.column_stack([x, -0.9 + np.abs(rng.normal(0, depth_m, 600)), z]))


def bonnet(x: np.ndarray) -> np.ndarray:
    """The height of a car along it."""
    return np.where(x > 0.9, 0.9, 1.6)


def bush(seed: int) -> np.ndarray:
    """Points scattered through an ellipsoid."""
    rng = np.random.default_rng(seed)
    ball = rng.normal(size=(2000, 3))
    ball *= (rng.uniform(0, 1, 2000) ** (1 / 3) / np.linalg.norm(ball, axis=1))[:, None]
    return placed(ball * [2.2, 0.9, 0.8] + [0, 0, 0.8])


def leafy(*parts: np.ndarray, boxes: np.ndarray = BOX) -> list[bool]:
    points = np.concatenate(parts)
    sizes = np.array([len(part) for part in parts])
    return are_leafy(np.atleast_2d(boxes), points, points[:, 2].copy(), sizes).tolist()


@pytest.mark.parametrize("seed", range(5))
def test_bushes_and_trimmed_hedges_are_told_from_cars_and_vans(seed: int) -> None:
    assert leafy(bush(seed)) == [True]
    assert leafy(side(seed, 0.15)) == [True], "a hedge"
    assert leafy(side(seed, NOISE_M)) == [False], "a van"
    assert leafy(side(seed, NOISE_M, bonnet)) == [False], "a car"
    assert leafy(side(seed, 0.1, bonnet)) == [False], "a car that moved while it was scanned"


def test_each_scan_is_judged_by_itself() -> None:
    one = side(1, NOISE_M)
    off = one + np.float32([0.4, -0.3, 0.0])
    assert leafy(one, off) == [False], "the same side twice, the poses half a metre apart"


def test_few_points_and_points_of_the_road_tell_nothing() -> None:
    assert leafy(bush(1)[: LEAST_POINTS - 10]) == [False]
    road = bush(1) * np.float32([1, 1, 0.1])
    assert leafy(road) == [False]
    assert leafy(np.zeros((0, 3), np.float32)) == [False]
    assert leafy(bush(1), boxes=np.zeros((0, 7))) == []


def test_a_turned_scene_is_judged_alike() -> None:
    for yaw in np.linspace(-3, 3, 7):
        road_SE3_scene = SE3.from_pose([5.0, -2.0, 0.0, 0.0, 0.0, yaw])
        box = BOX.copy()
        box[:2] = road_SE3_scene.apply(np.array([[*BOX[:2], 0.0]]))[0, :2]
        box[6] += yaw
        for points, expected in ((bush(2), True), (side(2, NOISE_M), False)):
            turned = road_SE3_scene.apply(points.astype(np.float64)).astype(np.float32)
            assert leafy(turned, boxes=box) == [expected]
