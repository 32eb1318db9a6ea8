"""Duplicates and own poses."""

from __future__ import annotations

from random import Random

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from edge_server.config import FusionConfig
from edge_server.fusion import fuse
from perception.detector import Vehicles
from protocol.messages import AgentPose, Equipment

CENTRE = np.zeros(3)


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
    found = fuse(boxes((33, 0), (30, 0.3)), [], centre=CENTRE, config=FusionConfig())
    assert places(found) == [(30, 0.3)]


def test_neighbours_in_the_next_lane_stay_two_but_not_under_the_papers_radius() -> None:
    queue = boxes((30, 0), (30, 3.5), (37, 0), (37, 3.5))
    assert len(fuse(queue, [], centre=CENTRE, config=FusionConfig())) == 4
    by_radius = fuse(queue, [], centre=CENTRE, config=FusionConfig(rule="radius"))
    assert places(by_radius) == [(30, 0), (37, 0)]


def test_along_and_across_turn_with_the_vehicle() -> None:
    pair = boxes((0, 30), (0, 33.5), (3.5, 30), yaw=np.pi / 2)
    assert places(fuse(pair, [], centre=CENTRE, config=FusionConfig())) == [(0, 30), (3.5, 30)]


def test_an_own_pose_wins_over_boxes_of_the_same_vehicle() -> None:
    found = fuse(
        boxes((29, 0.1), (32, 0), (40, 0)),
        [pose("b", 31, 0), pose("rsu-0", 0, 0, Equipment.NONE)],
        centre=CENTRE,
        config=FusionConfig(),
    )
    assert found.sources == ["b", "lidar"]
    assert places(found) == [(31, 0), (40, 0)]


def test_an_uncertain_pose_stands_for_the_nearest_box_only() -> None:
    found = fuse(
        boxes((30, 0), (30, 3.5)),
        [pose("cv", 31, 1.6, Equipment.CV)],
        centre=CENTRE,
        config=FusionConfig(),
    )
    assert places(found) == [(31, 1.6), (30, 3.5)]


def test_poses_are_never_duplicates_of_each_other() -> None:
    both = [pose("a", 30, 0), pose("b", 31, 0)]
    assert len(fuse(boxes(), both, centre=CENTRE, config=FusionConfig())) == 2


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
    one = fuse(vehicles, agents, centre=CENTRE, config=FusionConfig())
    chosen = np.array(shuffled, np.int64)
    other = fuse(vehicles.take(chosen), agents[::-1], centre=CENTRE, config=FusionConfig())
    np.testing.assert_array_equal(one.boxes, other.boxes)
    assert one.sources == other.sources
