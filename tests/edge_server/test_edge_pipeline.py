"""From points to counts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from edge_server.config import EdgeConfig
from edge_server.frame import AgentDetections, Chunk, Frame
from edge_server.pipeline import Pipeline
from perception.config import GroundConfig
from protocol.geometry import SE3
from protocol.messages import AgentPose, Equipment, Objects
from protocol.roadmap import RoadMap

CLIMB = 0.035
CARS = [(-90, 1.75), (-40, 1.75), (-40, -1.75), (-33, 1.75), (-15, -1.75), (40, 1.75), (80, -1.75)]
ROADSIDE = np.array([0, 0, 3.0, 0, 0, 0.7])


def frame_of(
    shell: Callable[..., Any], ground: Callable[..., Any], *, seed: int = 1, number: int = 0
) -> Frame:
    """What a post in the junction sees of a climbing road with cars, and a CAV that it does not."""
    rng = np.random.default_rng(seed)
    slope = -np.arctan(CLIMB)
    cars = [shell([x, y, CLIMB * x, 0, slope, 0], (0.0, 0.0), rng) for x, y in CARS]
    points = np.concatenate([ground(rng, climb=CLIMB), *cars])
    in_sensor = SE3.from_pose(ROADSIDE).inverse().apply(points).astype(np.float32)
    own = AgentPose(
        frame=number,
        sim_time_ns=7,
        agent="cav",
        equipment=Equipment.CAV,
        pose=np.array([-60, -1.75, -60 * CLIMB, 0, slope, 0]),
        length_m=4.5,
        width_m=1.8,
        height_m=1.5,
        position_std_m=0.05,
    )
    scan = Chunk(number, 7, "rsu-0", 0, 1, ROADSIDE, in_sensor, 0)
    return Frame(number, 7, ["cav", "rsu-0"], [own], [scan], True, 0, 0)


@pytest.mark.parametrize("merge", ["se3", "euler"])
def test_every_car_on_a_climbing_road_is_found_and_counted(
    climbing_road: RoadMap, shell: Callable[..., Any], ground: Callable[..., Any], merge: Any
) -> None:
    pipeline = Pipeline.of(climbing_road, EdgeConfig(merge=merge), seed=1)
    result = pipeline.run(frame_of(shell, ground))
    found = result.detections
    near = np.linalg.norm(
        np.array([*CARS, (-60, -1.75)])[:, None] - found.boxes[None, :, :2], axis=2
    )
    assert near.min(axis=1).max() < 0.5
    assert len(found.boxes) == len(CARS) + 1
    assert result.counts.upstream == {"in_0": 3, "in_1": 3, "side_0": 0}
    assert result.counts.downstream == {"out_0": 1, "out_1": 1}
    assert found.sources.count("cav") == 1
    at = found.sources.index("cav")
    assert found.lanes[at] == "in_0"
    assert found.distances_m[at] == pytest.approx(50, abs=0.1)
    assert (result.counts.sim_time_ns, result.counts.tls, result.counts.complete) == (7, "j", True)
    stages = [span.stage for span in result.spans if span.stage != "place"]
    assert stages == ["check", "merge", "ground", "detect", "fuse", "count"]


def test_a_frame_gives_the_same_result_whatever_came_before_it(
    climbing_road: RoadMap, shell: Callable[..., Any], ground: Callable[..., Any]
) -> None:
    fresh = Pipeline.of(climbing_road, EdgeConfig(), seed=4)
    used = Pipeline.of(climbing_road, EdgeConfig(), seed=4)
    used.run(frame_of(shell, ground, seed=2, number=1))
    frame = frame_of(shell, ground, number=2)
    one, other = fresh.run(frame).detections, used.run(frame).detections
    np.testing.assert_array_equal(one.boxes, other.boxes)
    np.testing.assert_array_equal(one.scores, other.scores)


def test_a_frame_without_agents_counts_nothing(road_map: RoadMap) -> None:
    result = Pipeline.of(road_map, EdgeConfig(), seed=1).run(Frame(0, 0, [], [], [], True, 0, 0))
    assert set(result.counts.upstream.values()) == {0}
    assert len(result.detections.boxes) == 0


def test_a_frame_to_which_no_lidar_contributed_is_seen_by_nobody(road_map: RoadMap) -> None:
    nothing = Frame(0, 0, [], [], [], True, 0, 0)
    counts = Pipeline.of(road_map, EdgeConfig(), seed=1).run(nothing).counts
    assert counts.coverage_upstream.keys() == counts.upstream.keys()
    assert {*counts.coverage_upstream.values(), *counts.coverage_downstream.values()} == {0.0}


def test_where_there_are_no_lidars_nothing_is_said_of_sight(road_map: RoadMap) -> None:
    nothing = Frame(0, 0, [], [], [], True, 0, 0)
    counts = Pipeline.of(road_map, EdgeConfig(), seed=1, has_lidars=False).run(nothing).counts
    assert (counts.coverage_upstream, counts.coverage_downstream) == ({}, {})


@pytest.mark.parametrize(("agent", "is_known"), [("rsu-0", True), ("stranger", False)])
def test_who_sends_boxes_sees_what_is_around_it_and_nothing_else(road_map, agent, is_known):
    found = Objects(
        frame=0, sim_time_ns=0, agent=agent, boxes=np.zeros((0, 7), np.float32),
        scores=np.zeros(0, np.float32), sense_start_ns=0, sense_end_ns=0, detect_end_ns=0,
    )  # fmt: skip
    frame = Frame(0, 0, [agent], [], [], True, 0, 0, found=[AgentDetections(found, 0)])
    far, near = np.array([1000.0, 0, 0]), ROADSIDE[:3]
    for place, sees in ((near, is_known), (far, False)):
        pipeline = Pipeline.of(road_map, EdgeConfig(), seed=1, mounts={"rsu-0": place})
        seen = pipeline.run(frame).counts.coverage_upstream
        assert (max(seen.values()) > 0) is sees


def test_a_scan_that_cannot_be_read_saw_nothing(road_map: RoadMap) -> None:
    points = np.zeros((0, 3), np.float32)
    scan = Chunk(0, 0, "rsu-0", 0, 1, ROADSIDE, points, 0)
    for chunk, nobody in ((scan, False), (replace(scan, is_undecodable=True), True)):
        frame = Frame(0, 0, ["rsu-0"], [], [chunk], True, 0, 0)
        counts = Pipeline.of(road_map, EdgeConfig(), seed=1).run(frame).counts
        assert (max(counts.coverage_upstream.values()) == 0) is nobody


def test_the_papers_settings_work_on_a_level_road(
    road_map: RoadMap, shell: Callable[..., Any], ground: Callable[..., Any]
) -> None:
    config = EdgeConfig.model_validate(
        {
            "merge": "euler",
            "ground": GroundConfig(tile_m=None),
            "boxes": {"complete": False},
            "fusion": {"rule": "radius"},
        }
    )
    rng = np.random.default_rng(1)
    cars = [shell([x, -1.75, 0, 0, 0, 0], (0.0, 0.0), rng) for x in (-50, -30, 40)]
    points = np.concatenate([ground(rng), *cars])
    scan = Chunk(0, 0, "rsu-0", 0, 1, np.zeros(6), points, 0)
    frame = Frame(0, 0, ["rsu-0"], [], [scan], True, 0, 0)
    result = Pipeline.of(road_map, config, seed=1).run(frame)
    assert (result.counts.upstream["in_0"], result.counts.downstream["out_0"]) == (2, 1)
