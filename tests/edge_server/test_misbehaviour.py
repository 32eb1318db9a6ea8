"""Misbehaviour detection: agents are trusted unless their data is implausible."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from edge_server.config import EdgeConfig, MisbehaviourConfig
from edge_server.frame import AgentDetections, Chunk, Frame, FrameState
from edge_server.misbehaviour import MAX_PUBLISHED, MAX_REMEMBERED, Check
from edge_server.pipeline import Pipeline
from perception.arrays import Floats
from perception.roadway import Roadway
from protocol.geometry import SE3
from protocol.messages import AgentPose, Equipment, Objects
from protocol.regions import RegionMap
from protocol.roadmap import RoadMap

RSU, RSU_POSE = "rsu-0", np.array([0, 0, 3.0, 0, 0, 0.7])
CARS = [(-35, 1.75), (-24, -1.75), (-12, 1.75), (14, -1.75), (24, 1.75), (35, -1.75)]
MOUNTS = {RSU: np.array([0, 0, 0.7])}
FRAMES = 40


class Scene:
    """A street with cars, two CAVs in it and a post, all seen by all."""

    def __init__(
        self, road_map: RoadMap, car_shell: Callable[..., Any], ground: Callable[..., Any]
    ):
        self.road_map = road_map
        self.roadway = Roadway.of(road_map, margin_m=0.5)
        rng = np.random.default_rng(1)
        earth = ground(rng, count=60_000)
        near = np.zeros(len(earth), bool)
        for x, y in [*CARS, (-40, -1.75), (44, 1.75)]:  # not visible under and around cars
            near |= (np.abs(earth[:, 0] - x) < 2.4) & (np.abs(earth[:, 1] - y) < 1.1)
        self.earth = earth[~near]
        self.car_shell, self.rng = car_shell, rng
        self.clouds: dict[str, Floats] = {}

    def cloud(self, sensor: Floats) -> Floats:
        """Returns what a sensor (6,) sees, in the map frame."""
        key = repr(sensor.tolist())
        if key not in self.clouds:
            cars = [
                self.car_shell([x, y, 0, 0, 0, 0], tuple(sensor[:2]), self.rng)
                for x, y in CARS
                if abs(x - sensor[0]) > 3
            ]
            self.clouds[key] = np.concatenate([self.earth, *cars]).astype(float)
        return self.clouds[key]

    def frame(self, number: int, **moved: Floats) -> Frame:
        """Returns a frame; named agents claim poses that are off by (6,), and scan from these."""
        poses, chunks = [], []
        for agent, x, y in (("a", -40.0, -1.75), ("b", 44.0, 1.75)):
            true_pose = np.array([x, y, 0, 0, 0, 0])
            claimed = true_pose + moved.get(agent, 0)
            poses.append(pose_of(number, agent, claimed))
            chunks.append(self.chunk(number, agent, true_pose, claimed, 2.4))
        off = moved.get("rsu", np.zeros(6))
        chunks.append(self.chunk(number, RSU, RSU_POSE, RSU_POSE + off, 0.0))
        return frame_of(number, poses, chunks)

    def chunk(self, number: int, agent: str, true: Floats, claimed: Floats, up_m: float) -> Chunk:
        up = np.array([0, 0, up_m, 0, 0, 0])
        points = SE3.from_pose(true + up).inverse().apply(self.cloud(true + up))
        return self.placed(number, agent, claimed + up, points.astype(np.float32))

    def placed(self, number: int, agent: str, sensor: Floats, points: Any) -> Chunk:
        pose = SE3.from_pose(sensor)
        placed = self.roadway.place(points, pose, below_m=2.0, above_m=5.0)
        one = Chunk(number, number * 10**8, agent, 0, 1, sensor, points, 0)
        return replace(one, placed=placed, returns=len(points))

    def check(self, frames: Sequence[Frame]) -> list[FrameState]:
        stage = self.stage()
        return [checked(stage, frame) for frame in frames]

    def stage(self) -> Check:
        return Check(RegionMap.whole(self.road_map), self.roadway, MisbehaviourConfig(), MOUNTS)


def checked(stage: Check, frame: Frame) -> FrameState:
    state = FrameState(frame)
    stage.run(state)
    return state


def pose_of(
    number: int, agent: str, pose: Floats, kind: Equipment = Equipment.CAV, std_m: float = 0.05
) -> AgentPose:
    return AgentPose(
        frame=number,
        sim_time_ns=number * 10**8,
        agent=agent,
        equipment=kind,
        pose=pose,
        length_m=4.5,
        width_m=1.8,
        height_m=1.5,
        position_std_m=std_m,
    )


def frame_of(number: int, poses: list[AgentPose], chunks: list[Chunk]) -> Frame:
    agents = sorted({*(pose.agent for pose in poses), *(chunk.agent for chunk in chunks)})
    return Frame(number, number * 10**8, agents, poses, chunks, True, 0, 0)


def excluded(frames: Sequence[Frame], judged: Sequence[FrameState]) -> set[str]:
    """Returns the agents excluded from the last frame; no other one ever was."""
    lost = [set(f.agents) - set(j.frame.agents) for f, j in zip(frames, judged, strict=True)]
    assert set().union(*lost) == lost[-1]
    return lost[-1]


@pytest.fixture(scope="module")
def scene(road_map: RoadMap, car_shell: Callable[..., Any], ground: Callable[..., Any]) -> Scene:
    return Scene(road_map, car_shell, ground)


def test_honest_agents_are_trusted_and_no_score_is_published(scene: Scene):
    frames = [scene.frame(number) for number in range(FRAMES)]
    judged = scene.check(frames)
    assert excluded(frames, judged) == set()
    assert not any(one.scores or one.excluded for one in judged)


@pytest.mark.parametrize(
    "off",
    [
        pytest.param((0, 0, 1, 0, 0, 0), id="raised"),
        pytest.param((0, 0, 0, 0, 0.09, 0), id="pitched"),
        pytest.param((0, 12, 0, 0, 0, 0), id="off the road"),
    ],
)
def test_a_vehicle_in_the_wrong_place_is_excluded_and_nobody_else(
    scene: Scene, off: tuple[float, ...]
) -> None:
    frames = [scene.frame(number, a=np.array(off, float)) for number in range(FRAMES)]
    judged = scene.check(frames)
    assert excluded(frames, judged) == {"a"}
    last = judged[-1]
    assert [pose.agent for pose in last.frame.poses] == ["b"]
    assert "a" not in {chunk.agent for chunk in last.frame.chunks}
    assert sum(last.excluded.values()) == 1
    assert all(reason.startswith("implausible_") for reason in last.excluded)
    assert [(one.agent, one.trusted) for one in last.scores] == [("a", False)]


def test_a_roadside_unit_that_moves_is_excluded(scene: Scene):
    off = np.array([3.0, 0, 0, 0, 0, 0])
    frames = [scene.frame(number, rsu=off * (number > 5)) for number in range(FRAMES)]
    judged = scene.check(frames)
    assert RSU in excluded(frames, judged)


def test_a_vehicle_returns_once_its_data_are_plausible_again(scene: Scene):
    off = np.array([0, 0, 1.0, 0, 0, 0])
    frames = [scene.frame(number, a=off * (number < 20)) for number in range(120)]
    judged = scene.check(frames)
    assert "a" not in judged[19].frame.agents
    assert "a" in judged[-1].frame.agents


def test_a_whole_scan_without_a_point_on_the_road_is_no_scan(scene: Scene):
    frames = []
    for number in range(FRAMES):
        whole = scene.frame(number)
        nothing = scene.placed(
            number, "a", whole.chunks[0].sensor_pose, np.zeros((0, 3), np.float32)
        )
        frames.append(frame_of(number, whole.poses, [nothing, *whole.chunks[1:]]))
    judged = scene.check(frames)
    assert excluded(frames, judged) == {"a"}
    assert judged[-1].excluded == {"implausible_ground": 1}


def test_an_undecodable_scan_lowers_no_score(scene: Scene):
    frames = []
    for number in range(FRAMES):
        whole = scene.frame(number)
        points = np.zeros((0, 3), np.float32)
        undecodable = scene.placed(number, "a", whole.chunks[0].sensor_pose, points)
        chunks = [replace(undecodable, is_undecodable=True), *whole.chunks[1:]]
        frames.append(frame_of(number, whole.poses, chunks))
    assert excluded(frames, scene.check(frames)) == set()


def test_a_vehicle_with_a_poor_position_is_trusted_within_its_error(scene: Scene):
    rng = np.random.default_rng(5)
    frames = []
    for number in range(FRAMES):
        off = rng.normal(0, [0.5, 0.5, 0.3, 0.005, 0.005, 0.02])
        whole = scene.frame(number, a=off)
        poses = [pose.model_copy(update={"position_std_m": 0.5}) for pose in whole.poses]
        frames.append(replace(whole, poses=poses))
    judged = scene.check(frames)
    assert excluded(frames, judged) == set()
    assert not any(one.scores for one in judged)


def test_chunks_from_two_places_are_not_of_one_scan(scene: Scene):
    frames = []
    for number in range(FRAMES):
        whole = scene.frame(number)
        other = replace(whole.chunks[0], index=1, sensor_pose=whole.chunks[0].sensor_pose + 2.0)
        frames.append(frame_of(number, whole.poses, [*whole.chunks, other]))
    judged = scene.check(frames)
    assert excluded(frames, judged) == {"a"}
    assert judged[-1].excluded == {"implausible_motion": 1}


def test_scores_do_not_depend_on_the_order_of_agents(scene: Scene):
    off = np.array([0, 0, 1.0, 0, 0, 0])
    frames = [scene.frame(number, a=off) for number in range(12)]
    turned = [
        replace(f, agents=f.agents[::-1], poses=f.poses[::-1], chunks=f.chunks[::-1])
        for f in frames
    ]
    for one, other in zip(scene.check(frames), scene.check(turned), strict=True):
        assert one.scores == other.scores


def test_what_is_remembered_is_bounded(scene: Scene):
    stage = scene.stage()
    for number in range(20):
        place = np.array([-20.0, 0, 0, 0, 0, 0])
        poses = [pose_of(number, f"{number}-{n}", place, Equipment.CV) for n in range(100)]
        checked(stage, frame_of(number, poses, []))
    assert len(stage._remembered) == MAX_REMEMBERED


def test_boxes_of_an_excluded_agent_do_not_count(road_map: RoadMap):
    boxes = np.array([[-30, -1.75, 0.75, 4.5, 1.8, 1.5, 0]], np.float32)
    counts = []
    config = EdgeConfig.model_validate({"tracking": {"enabled": False}})
    pipeline = Pipeline.of(RegionMap.whole(road_map), config, seed=1)
    for number in range(10):
        off_m = 0.0 if number == 0 else 60.0 * (number % 2)
        pose = pose_of(number, "a", np.array([-60.0 - off_m, -1.75, 0, 0, 0, 0]))
        claimed = Objects(
            frame=number,
            sim_time_ns=number * 10**8,
            agent="a",
            boxes=boxes,
            scores=np.ones(1, np.float32),
            classes=np.zeros(1, np.uint8),
            sense_start_ns=0,
            sense_end_ns=0,
            detect_end_ns=0,
        )
        frame = replace(frame_of(number, [pose], []), found=[AgentDetections(claimed, 0)])
        counts.append(pipeline.run(frame).counts["j"].upstream["in_0"])
    assert (counts[0], counts[-1]) == (2, 0)


def test_the_check_can_be_turned_off(road_map: RoadMap):
    config = EdgeConfig(misbehaviour=MisbehaviourConfig(enabled=False))
    pipeline = Pipeline.of(RegionMap.whole(road_map), config, seed=1)
    for number in range(10):
        pose = pose_of(number, "a", np.array([-60.0 * (number % 2), -1.75, 0, 0, 0, 0]))
        result = pipeline.run(frame_of(number, [pose], []))
    assert (result.counts["j"].agents, result.scores) == (["a"], [])


def test_of_many_low_scores_some_are_published_in_each_frame(scene: Scene):
    stage = scene.stage()
    published = []
    for number in range(6):
        place = np.array([-20.0 + 50 * (number % 2), 0, 0, 0, 0, 0])
        poses = [pose_of(number, f"{n}", place, Equipment.CV) for n in range(300)]
        published.append(len(checked(stage, frame_of(number, poses, [])).scores))
    assert published[0] == 0
    assert max(published) == MAX_PUBLISHED
