"""Duplicates and own poses."""

from __future__ import annotations

from dataclasses import replace
from random import Random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge_server.config import FusionConfig
from edge_server.fusion import CERTAIN_STD_M, from_poses, fuse
from perception.detector import Vehicles
from protocol.messages import AgentPose, Equipment, ObjectClass

CENTRE = np.zeros((1, 3))


def boxes(*places: tuple[float, float], yaw: float = 0.0) -> Vehicles:
    rows = np.array([(x, y, 0.75, 4.5, 1.8, 1.5, yaw) for x, y in places]).reshape(-1, 7)
    return Vehicles.from_lidar(rows, np.full(len(rows), 0.5))


def pose(agent: str, x: float, y: float, kind: Equipment = Equipment.CAV) -> AgentPose:
    return AgentPose(
        frame=0,
        sim_time_ns=0,
        agent=agent,
        equipment=kind,
        pose=np.array([x, y, 0, 0, 0, 0.0]),
        length_m=4.5,
        width_m=1.8,
        height_m=1.5,
        position_std_m=1.5 if kind is Equipment.CV else 0.05,
    )


def places(found: Vehicles) -> list[tuple[float, float]]:
    return [(float(x), float(y)) for x, y in found.boxes[:, :2]]


def test_of_two_boxes_the_one_farther_from_the_junction_goes() -> None:
    found = fuse(boxes((33, 0), (30, 0.3)), [], centres=CENTRE, config=FusionConfig())
    assert places(found) == [(30, 0.3)]


def test_neighbours_in_the_next_lane_stay_two_but_not_under_the_papers_radius() -> None:
    queue = boxes((30, 0), (30, 3.5), (37, 0), (37, 3.5))
    assert len(fuse(queue, [], centres=CENTRE, config=FusionConfig())) == 4
    by_radius = fuse(queue, [], centres=CENTRE, config=FusionConfig(rule="radius"))
    assert places(by_radius) == [(30, 0), (37, 0)]


def test_along_and_across_turn_with_the_vehicle() -> None:
    pair = boxes((0, 30), (0, 33.5), (3.5, 30), yaw=np.pi / 2)
    assert places(fuse(pair, [], centres=CENTRE, config=FusionConfig())) == [(0, 30), (3.5, 30)]


def test_an_own_pose_wins_over_boxes_of_the_same_vehicle() -> None:
    found = fuse(
        boxes((29, 0.1), (32, 0), (40, 0)),
        [pose("b", 31, 0), pose("rsu-0", 0, 0, Equipment.NONE)],
        centres=CENTRE,
        config=FusionConfig(),
    )
    assert found.sources == ["b", "lidar"]
    assert places(found) == [(31, 0), (40, 0)]


def test_an_uncertain_pose_stands_for_the_nearest_box_only() -> None:
    found = fuse(
        boxes((30, 0), (30, 3.5)),
        [pose("cv", 31, 1.6, Equipment.CV)],
        centres=CENTRE,
        config=FusionConfig(),
    )
    assert places(found) == [(31, 1.6), (30, 3.5)]


def test_poses_are_never_duplicates_of_each_other() -> None:
    both = [pose("a", 30, 0), pose("b", 31, 0)]
    assert len(fuse(boxes(), both, centres=CENTRE, config=FusionConfig())) == 2


spots = st.lists(
    st.tuples(st.integers(-30, 30), st.integers(-8, 8), st.sampled_from([0.0, 0.4, 1.6])),
    max_size=12,
)


@settings(deadline=None)
@given(found=spots, own=spots, order=st.randoms(use_true_random=False))
def test_the_order_of_boxes_and_poses_is_no_matter(
    found: list[tuple[int, int, float]], own: list[tuple[int, int, float]], order: Random
) -> None:
    rows = np.array([(x, y, 0.75, 4.5, 1.8, 1.5, yaw) for x, y, yaw in found]).reshape(-1, 7)
    vehicles = Vehicles.from_lidar(rows, np.linspace(0.1, 0.9, len(rows)))
    kinds = [Equipment.CAV, Equipment.CV]
    agents = [pose(f"v{i}", x, y, kinds[i % 2]) for i, (x, y, _) in enumerate(own)]
    shuffled = list(range(len(rows)))
    order.shuffle(shuffled)
    one = fuse(vehicles, agents, centres=CENTRE, config=FusionConfig())
    chosen = np.array(shuffled, np.int64)
    other = fuse(vehicles.take(chosen), agents[::-1], centres=CENTRE, config=FusionConfig())
    np.testing.assert_array_equal(one.boxes, other.boxes)
    assert one.sources == other.sources


def uncertain(agent: str, x: float, y: float, std_m: float) -> AgentPose:
    return pose(agent, x, y).model_copy(update={"position_std_m": std_m})


def test_the_box_of_an_own_pose_has_its_centre_half_its_height_above_the_ground() -> None:
    own = pose("a", 30, 2).model_copy(update={"pose": np.array([30, 2, 5.0, 0.1, 0.2, 0.3])})
    found = from_poses([own])
    assert found.boxes.tolist() == [[30, 2, 5.75, 4.5, 1.8, 1.5, 0.3]]
    assert (found.scores.tolist(), found.sources) == ([1.0], ["a"])
    assert found.position_std_m.tolist() == [0.05]


def test_without_poses_there_are_no_boxes_and_their_numbers_are_floats() -> None:
    found = from_poses([pose("rsu-0", 0, 0, Equipment.NONE)])
    assert (found.boxes.shape, found.boxes.dtype) == ((0, 7), np.float64)
    assert found.position_std_m.dtype == np.float64


def test_the_distance_from_the_junction_counts_from_its_centre() -> None:
    config, centre = FusionConfig(), np.array([[100.0, 10.0, 0.0]])
    found = fuse(boxes((69, 10), (72, 10)), [], centres=centre, config=config)
    assert places(found) == [(72, 10)]


def test_equally_near_boxes_are_ordered_by_x_then_by_y() -> None:
    ring = boxes((3, -40), (-40, 3), (40, 3), (-40, -3), (-3, 40))
    found = fuse(ring, [], centres=CENTRE, config=FusionConfig())
    assert places(found) == [(-40, -3), (-40, 3), (-3, 40), (3, -40), (40, 3)]


@pytest.mark.parametrize("yaw", [0.5, -0.5])
def test_along_is_the_direction_of_a_vehicle_that_stands_at_any_angle(yaw: float) -> None:
    cos, sin = np.cos(yaw), np.sin(yaw)
    ahead = (30 + 4 * cos, 4 * sin)
    beside = (30 - 3.5 * sin, 3.5 * cos)
    ahead_only = fuse(boxes((30, 0), ahead, yaw=yaw), [], centres=CENTRE, config=FusionConfig())
    assert places(ahead_only) == [(30, 0)]
    farther = boxes((30, 0), (30 + 5 * cos, 5 * sin), yaw=yaw)
    assert len(fuse(farther, [], centres=CENTRE, config=FusionConfig())) == 2
    both = fuse(boxes((30, 0), beside, yaw=yaw), [], centres=CENTRE, config=FusionConfig())
    assert len(both) == 2


@pytest.mark.parametrize("rule", ["oriented", "radius"])
@pytest.mark.parametrize(("gap_m", "left"), [(4.49, 1), (4.5, 2), (5.0, 2)])
def test_boxes_a_vehicles_length_apart_are_two(rule: str, gap_m: float, left: int) -> None:
    config = FusionConfig.model_validate({"rule": rule, "duplicate_m": 4.5})
    pair = boxes((16, 0), (16 + gap_m, 0))
    assert len(fuse(pair, [], centres=CENTRE, config=config)) == left


@pytest.mark.parametrize("rule", ["oriented", "radius"])
@pytest.mark.parametrize(("gap_m", "left"), [(5.9, 0), (6.1, 1)])
def test_an_uncertain_pose_claims_a_box_as_far_as_its_error_reaches(
    rule: str, gap_m: float, left: int
) -> None:
    config = FusionConfig.model_validate({"rule": rule, "duplicate_m": 4.5})
    own = [uncertain("a", 30, 0, 1.5)]
    found = fuse(boxes((30 + gap_m, 0)), own, centres=CENTRE, config=config)
    assert found.sources == ["a", *["lidar"] * left]


def test_a_pose_at_the_limit_of_certainty_stands_for_every_box_near_it() -> None:
    near = boxes((29, 0), (31, 0.5))
    certain = [uncertain("a", 30, 0, CERTAIN_STD_M)]
    assert fuse(near, certain, centres=CENTRE, config=FusionConfig()).sources == ["a"]


def test_two_uncertain_poses_claim_a_box_each_the_nearest_pair_first() -> None:
    own = [uncertain("a", 30, 0, 1.5), uncertain("b", 60, 0, 1.5)]
    found = fuse(boxes((31, 0), (61, 0), (30.5, 2.6)), own, centres=CENTRE, config=FusionConfig())
    assert places(found) == [(30, 0), (60, 0), (30.5, 2.6)]


def test_a_pose_at_the_limit_of_certainty_has_no_slack() -> None:
    own = [uncertain("a", 30, 0, CERTAIN_STD_M)]
    found = fuse(boxes((34.7, 0)), own, centres=CENTRE, config=FusionConfig())
    assert places(found) == [(30, 0), (34.7, 0)]


@pytest.mark.parametrize(("across_m", "left"), [(1.99, 1), (2.0, 2)])
def test_boxes_side_by_side_are_one_only_below_the_limit(across_m: float, left: int) -> None:
    pair = boxes((16, 0), (16, across_m))
    assert len(fuse(pair, [], centres=CENTRE, config=FusionConfig(across_m=2.0))) == left


def of_class(kind: ObjectClass, *rows: tuple[float, float, float, float]) -> Vehicles:
    """Returns boxes of a class at x, y, of a length and a width."""
    box_rows = np.array([(x, y, 0.9, long_m, wide_m, 1.8, 0) for x, y, long_m, wide_m in rows])
    found = Vehicles.from_lidar(box_rows, np.full(len(rows), 0.5))
    return replace(found, classes=np.full(len(rows), kind, np.uint8))


def test_a_pedestrian_is_no_box_of_a_cv_that_is_not_sure_where_it_is() -> None:
    person = of_class(ObjectClass.PEDESTRIAN, (33.0, 0.0, 0.6, 0.6))
    cv = pose("cv", 31.6, 0, Equipment.CV)
    found = fuse(boxes((30, 0)) + person, [cv], centres=CENTRE, config=FusionConfig())
    assert places(found) == [(31.6, 0), (33, 0)]


@pytest.mark.parametrize("off_m", [-8.0, 4.0, 8.0])
def test_a_cv_that_does_not_know_its_height_is_one_vehicle(off_m: float) -> None:
    cv = pose("cv", 31.0, 0, Equipment.CV)
    cv = cv.model_copy(update={"pose": cv.pose + np.array([0, 0, off_m, 0, 0, 0])})
    found = fuse(boxes((30, 0)), [cv], centres=CENTRE, config=FusionConfig())
    assert places(found) == [(31, 0)]


def test_of_two_levels_a_cvs_box_is_that_of_its_own() -> None:
    cv = pose("cv", 31.0, 0, Equipment.CV)
    below = boxes((31.0, 0.0))
    below.boxes[:, 2] -= 7.0
    found = fuse(boxes((29.5, 0)) + below, [cv], centres=CENTRE, config=FusionConfig())
    assert [z for _, _, z in found.boxes[:, :3]] == [0.75, 0.75 - 7.0]


def test_two_wheelers_stand_closer_than_cars() -> None:
    config = FusionConfig()
    file = of_class(ObjectClass.TWO_WHEELER, *((30 + 2.1 * n, 0, 1.6, 0.6) for n in range(5)))
    assert len(fuse(file, [], centres=CENTRE, config=config)) == 5
    behind = of_class(ObjectClass.TWO_WHEELER, (33.7, 0, 1.6, 0.6))
    assert len(fuse(boxes((30, 0)) + behind, [], centres=CENTRE, config=config)) == 2
    assert len(fuse(boxes((30, 0)), [pose("a", 33.7, 0)], centres=CENTRE, config=config)) == 1
    within = of_class(ObjectClass.TWO_WHEELER, (31.0, 0.3, 1.6, 0.6))
    assert places(fuse(boxes((30, 0)) + within, [], centres=CENTRE, config=config)) == [(30, 0)]
