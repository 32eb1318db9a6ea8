"""Vehicles on ground that lies lower than the road, where a hedge hides it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import places
import pytest

from edge_server.config import EdgeConfig
from learning.kitti import line_of
from learning.kitti_object import kitti_frames
from perception.detector import Vehicles
from perception.pillars.hidden_ground import MOST_SEEN, WEIGHT, ground_squares, with_lower
from protocol.geometry import SE3
from protocol.messages import ObjectClass
from studies.kitti_eval import hits_of, judge

pytest.importorskip("torch", reason="needs the extra `learn`")

NOWHERE = np.zeros((0, 3), np.float32), np.zeros(0, np.float32)


def cars(*rows: tuple[float, float, float]) -> Vehicles:
    """Cars along x at x, with the height of their middle, and scores."""
    boxes = np.array([[x, 0, z, 4.5, 1.8, 1.5, 0] for x, z, _ in rows]).reshape(-1, 7)
    return Vehicles.from_lidar(boxes, np.array([score for *_, score in rows]))


def ground(x: float, squares: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of the road in so many squares along x, and their heights over it."""
    at = np.array([[x + n, 0.5 + y, -1.8] for n in range(squares) for y in (0.0, 0.2)])
    return at.reshape(-1, 3).astype(np.float32), np.full(2 * squares, 0.02, np.float32)


def test_lower_vehicles_are_added_where_the_ground_is_hidden() -> None:
    found = with_lower(cars((0, 0.75, 0.6)), cars((20, 0.25, 0.5)), *NOWHERE)
    assert found.boxes[:, 0].tolist() == [0, 20]
    assert found.scores.tolist() == pytest.approx([0.6, WEIGHT * 0.5])


def test_where_the_ground_is_seen_nothing_is_lower_than_it() -> None:
    lower = cars((20, 0.25, 0.9))
    for squares, is_found in ((MOST_SEEN, True), (MOST_SEEN + 1, False)):
        points, height_m = ground(18.5, squares)
        assert ground_squares(lower.boxes, points, height_m).tolist() == [squares]
        assert len(with_lower(cars(), lower, points, height_m)) == is_found
    # What stands in a square, and ground that lies as low as the vehicle, hide nothing.
    for off_m in (0.5, -0.5):
        points, height_m = ground(18.5, 8)
        height_m[::2] += off_m
        assert len(with_lower(cars(), lower, points, height_m)) == 1


def test_of_a_vehicle_found_twice_the_box_on_the_road_is_taken_with_the_better_score() -> None:
    found = with_lower(cars((0, 0.75, 0.3), (20, 0.75, 0.1)), cars((0.3, 0.25, 0.5)), *NOWHERE)
    assert found.boxes[:, [0, 2]].tolist() == [[0, 0.75], [20, 0.75]]
    assert found.scores.tolist() == pytest.approx([WEIGHT * 0.5, 0.1])


def test_a_box_on_the_road_that_hardly_counts_does_not_replace_one_below() -> None:
    found = with_lower(cars((0, 0.75, 0.1)), cars((0.3, 0.25, 0.5)), *NOWHERE)
    assert found.boxes[:, [0, 2]].tolist() == [[0, 0.75], [0.3, 0.25]]
    assert found.scores.tolist() == pytest.approx([0.1, WEIGHT * 0.5])


def test_a_car_is_not_taken_for_a_person_on_the_road_but_for_a_lorry() -> None:
    lower = cars((0.3, 0.25, 0.8))
    for kind, boxes in ((ObjectClass.PEDESTRIAN, 2), (ObjectClass.TRUCK, 1)):
        road = replace(cars((0, 0.75, 0.5)), classes=np.array([kind], np.uint8))
        assert len(with_lower(road, lower, *NOWHERE)) == boxes


def test_of_two_boxes_on_the_road_the_better_one_alone_is_raised() -> None:
    found = with_lower(cars((0, 0.75, 0.4), (0.2, 0.75, 0.05)), cars((0, 0.25, 0.8)), *NOWHERE)
    assert found.scores.tolist() == pytest.approx([WEIGHT * 0.8, 0.05])


def test_without_any_on_one_of_them_the_others_stay() -> None:
    assert len(with_lower(cars(), cars(), *NOWHERE)) == 0
    assert with_lower(cars((0, 0.75, 0.4)), cars(), *NOWHERE).scores.tolist() == [0.4]


@pytest.mark.parametrize("lower_m", [0.0, 0.7])
def test_a_row_of_cars_behind_a_hedge_is_found_on_level_and_on_lower_ground(
    tmp_path: Path, lower_m: float
) -> None:
    row = [(x, 20.0, np.pi / 2) for x in (-9, -6, -3, 0, 3, 6, 9)]
    sensor = SE3.from_pose([0, 0, 1.8, 0, 0, 0])
    for part in ("velodyne", "label_2"):
        (tmp_path / part).mkdir()
    seen = places.seen(_behind_a_hedge(row, lower_m), sensor)
    np.save(tmp_path / "velodyne" / "row.npy", seen.astype(np.float32))
    labels = [
        line_of(np.array([x, y, 0.75 - lower_m - 1.8, *places.CAR_M, yaw]), ObjectClass.CAR)
        for x, y, yaw in row
    ]
    (tmp_path / "label_2" / "row.txt").write_text("\n".join(labels) + "\n")
    (frame,) = kitti_frames(tmp_path)
    judged = judge(frame, ["pointpillars"], EdgeConfig(), 50.0)["pointpillars"]
    hits = hits_of(judged, 50.0)
    assert hits.vehicles == len(row)
    assert hits.found == hits.right == hits.boxes == len(row)
    boxes = judged.found.boxes[judged.certain]
    foot_m = boxes[:, 2] - boxes[:, 5] / 2 + 1.8
    assert (foot_m < -lower_m - 0.3).sum() <= 1  # in the ground, which is hidden


def _behind_a_hedge(row: list[tuple[float, float, float]], lower_m: float) -> np.ndarray:
    """Points (N, 3) of a road, a hedge along it, and lower ground behind it with cars."""
    rng = np.random.default_rng(3)
    down = np.array([0, 0, lower_m])
    level = places.scene([], walls=False)
    behind = places.scene(row, walls=False)
    hedge = rng.uniform([-30, 12, -lower_m], [30, 13, 0.8], (30_000, 3))
    return np.concatenate([level[level[:, 1] < 12], behind[behind[:, 1] > 12] - down, hedge])
