"""The road as a raster."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from perception.roadway import Placed, Roadway, merge
from protocol.geometry import SE3
from protocol.roadmap import RoadMap
from tests.roads import bridge


def test_points_on_the_road_stay_and_others_go(road_map: RoadMap) -> None:
    roadway = Roadway.of(road_map, margin_m=0.5)
    on = [(-50, 0, 0.2), (-50, 3.9, 1.0), (1.75, -60, 1.0), (3, -4, 4.9)]
    off = [(-50, 6, 0.2), (-50, 0, 6.0), (-50, 0, -3.0), (1e9, 0, 0), (-1e9, 1e9, 0), (6, 60, 1)]
    points = np.array([p for pair in zip(on, off[:4], strict=True) for p in pair], np.float32)
    points = np.concatenate([points, np.array(off[4:], np.float32)])
    placed = roadway.place(points, SE3.identity(), below_m=2.0, above_m=5.0)
    kept, road_m = placed.points, placed.road_m
    np.testing.assert_array_equal(kept, np.array(on, np.float32))
    np.testing.assert_array_equal(road_m, 0.0)


def test_height_and_direction_follow_the_lane(climbing_road: RoadMap) -> None:
    roadway = Roadway.of(climbing_road, margin_m=0.5)
    points = np.array([[-200.0, 0, -7], [100, 1.75, 3.5]], np.float32)
    placed = roadway.place(points, SE3.identity(), below_m=2.0, above_m=5.0)
    kept, road_m = placed.points, placed.road_m
    assert len(kept) == 2
    np.testing.assert_allclose(road_m, 0.035 * kept[:, 0], atol=0.02)
    yaw = roadway.yaw_at(np.array([[-200.0, 0], [1.75, -60], [0, 500]]))
    np.testing.assert_allclose(yaw, [0, np.pi / 2, 0], atol=1e-6)


def test_points_that_are_not_finite_are_off_the_road(road_map: RoadMap) -> None:
    roadway = Roadway.of(road_map, margin_m=0.5)
    points = np.array([[np.inf, 0, 0], [np.nan, 0, 0], [-50, 0, np.nan]], np.float32)
    placed = roadway.place(points, SE3.identity(), below_m=2.0, above_m=5.0)
    assert len(placed.points) == 0


def test_points_are_moved_before_they_are_looked_up(road_map: RoadMap) -> None:
    roadway = Roadway.of(road_map, margin_m=0.5)
    map_SE3_sensor = SE3.from_pose([-50.0, 1, 2.4, 0.01, -0.02, 2.0])
    points = np.random.default_rng(1).uniform(-4, 4, (500, 3)).astype(np.float32)
    placed = roadway.place(points, map_SE3_sensor, below_m=2.0, above_m=5.0)
    moved = map_SE3_sensor.apply(points)
    by_hand = roadway.place(moved.astype(np.float32), SE3.identity(), below_m=2.0, above_m=5.0)
    assert 0 < len(placed.points) < len(points)
    np.testing.assert_allclose(placed.points, by_hand.points, atol=1e-4)


def test_parts_follow_each_other() -> None:
    points, road_m = np.ones((5, 3), np.float32), np.arange(5, dtype=np.float32)
    merged, merged_m = merge([Placed.of(points, road_m), Placed.of(points[:3], road_m[:3])])
    np.testing.assert_array_equal(merged, np.concatenate([points, points[:3]]))
    np.testing.assert_array_equal(merged_m, np.concatenate([road_m, road_m[:3]]))
    assert merge([])[0].shape == (0, 3)


def test_votes_are_the_lowest_points_of_square_metres(road_map: RoadMap) -> None:
    roadway = Roadway.of(road_map, margin_m=0.5)
    rng = np.random.default_rng(4)
    for _ in range(3):  # the table is clean again each time
        points = rng.uniform([-60, -60, -3], [60, 60, 6], (20_000, 3)).astype(np.float32)
        placed = roadway.place(points, SE3.identity(), below_m=2.0, above_m=5.0)
        by_hand = Placed.of(placed.points, placed.road_m).lowest
        assert len(placed.lowest) == len(by_hand) > 100
        np.testing.assert_array_equal(
            placed.lowest[np.lexsort(placed.lowest.T)], by_hand[np.lexsort(by_hand.T)]
        )


def test_threads_do_not_share_their_tables(road_map: RoadMap) -> None:
    roadway = Roadway.of(road_map, margin_m=0.5)
    points = np.random.default_rng(4).uniform(-60, 60, (40_000, 3)).astype(np.float32)
    poses = [SE3.from_pose([0, 0, 0, 0, 0, yaw]) for yaw in (0.0, 0.5, 1.0, 1.5)]

    def votes(pose: SE3) -> np.ndarray:
        return roadway.place(points, pose, below_m=80, above_m=80).lowest

    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(votes, poses * 5))
    for pose, found in zip(poses * 5, together, strict=True):
        np.testing.assert_array_equal(found, votes(pose))


def test_points_belong_to_the_road_that_they_are_on_where_roads_cross_at_different_heights() -> (
    None
):
    roadway = Roadway.of(bridge(7.0), margin_m=0.5)
    heights_m = np.array([0.0, 1.5, 4.9, 6.0, 7.0, 8.5], np.float32)
    points = np.column_stack([np.full(6, 61.0), np.full(6, 2.0), heights_m]).astype(np.float32)
    placed = roadway.place(points, SE3.identity(), below_m=2.0, above_m=5.0)
    np.testing.assert_allclose(placed.points[:, 2], [0.0, 1.5, 4.9, 7.0, 8.5])
    np.testing.assert_allclose(placed.road_m, [0, 0, 0, 7, 7])
    over = np.array([[61.0, 2, 1.5], [61.0, 2, 8.5]])
    np.testing.assert_allclose(roadway.height_at(over), [0, 7])
    np.testing.assert_allclose(np.abs(roadway.yaw_at(over)), [np.pi, np.pi / 2], atol=1e-6)
    beside = roadway.place(
        np.array([[61, 30, 0], [61, 30, 7.5]], np.float32), SE3.identity(), below_m=2, above_m=5
    )
    np.testing.assert_allclose(beside.road_m, [7])
