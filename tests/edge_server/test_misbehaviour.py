"""What agents say is believed unless it cannot be so."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from edge_server.config import EdgeConfig, PlausibilityConfig
from edge_server.frame import AgentDetections, Chunk, Frame
from edge_server.misbehaviour import MOST_DOUBTS, MOST_KNOWN, Judged, Plausibility
from edge_server.pipeline import Pipeline
from perception.arrays import Floats
from perception.roadway import Roadway
from protocol.geometry import SE3
from protocol.messages import AgentPose, Equipment, Objects
from protocol.roadmap import RoadMap

POST, POST_POSE = "rsu-0", np.array([0, 0, 3.0, 0, 0, 0.7])
CARS = [(-35, 1.75), (-24, -1.75), (-12, 1.75), (14, -1.75), (24, 1.75), (35, -1.75)]
POSTS = {POST: np.array([0, 0, 0.7])}
FRAMES = 40


class Scene:
    """A street with cars, two CAVs in it and a post, all seen by all."""

    def __init__(self, road_map: RoadMap, shell: Callable[..., Any], ground: Callable[..., Any]):
        self.road_map = road_map
        self.roadway = Roadway.of(road_map, margin_m=0.5)
        rng = np.random.default_rng(1)
        earth = ground(rng, count=60_000)
        near = np.zeros(len(earth), bool)
        for x, y in [*CARS, (-40, -1.75), (44, 1.75)]:  # under and around cars nobody sees it
            near |= (np.abs(earth[:, 0] - x) < 2.4) & (np.abs(earth[:, 1] - y) < 1.1)
        self.earth = earth[~near]
        self.shell, self.rng = shell, rng
        self.clouds: dict[str, Floats] = {}

    def cloud(self, sensor: Floats) -> Floats:
        """Returns what a sensor (6,) sees, in the map frame."""
        key = repr(sensor.tolist())
        if key not in self.clouds:
            cars = [
                self.shell([x, y, 0, 0, 0, 0], tuple(sensor[:2]), self.rng)
                for x, y in CARS
                if abs(x - sensor[0]) > 3
            ]
            self.clouds[key] = np.concatenate([self.earth, *cars]).astype(float)
        return self.clouds[key]

    def frame(self, number: int, **moved: Floats) -> Frame:
        """Returns a frame; who is named says that it stands so far off, (6,), and looks from it."""
        poses, chunks = [], []
        for agent, x, y in (("a", -40.0, -1.75), ("b", 44.0, 1.75)):
            true_pose = np.array([x, y, 0, 0, 0, 0])
            said = true_pose + moved.get(agent, 0)
            poses.append(pose_of(number, agent, said))
            chunks.append(self.chunk(number, agent, true_pose, said, 2.4))
        off = moved.get("rsu", np.zeros(6))
        chunks.append(self.chunk(number, POST, POST_POSE, POST_POSE + off, 0.0))
        return frame_of(number, poses, chunks)

    def chunk(self, number: int, agent: str, true: Floats, said: Floats, up_m: float) -> Chunk:
        up = np.array([0, 0, up_m, 0, 0, 0])
        points = SE3.from_pose(true + up).inverse().apply(self.cloud(true + up))
        return self.placed(number, agent, said + up, points.astype(np.float32))

    def placed(self, number: int, agent: str, sensor: Floats, points: Any) -> Chunk:
        pose = SE3.from_pose(sensor)
        placed = self.roadway.place(points, pose, below_m=2.0, above_m=5.0)
        one = Chunk(number, number * 10**8, agent, 0, 1, sensor, points, 0, 0, 0)
        return replace(one, placed=placed, returns=len(points))

    def judge(self, frames: Sequence[Frame]) -> list[Judged]:
        edge = Plausibility(self.road_map, self.roadway, PlausibilityConfig(), POSTS)
        return [edge.judge(frame) for frame in frames]


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


def outcasts(frames: Sequence[Frame], judged: Sequence[Judged]) -> set[str]:
    """Returns who was left out of the last frame, and nobody else ever was."""
    lost = [set(f.agents) - set(j.frame.agents) for f, j in zip(frames, judged, strict=True)]
    assert set().union(*lost) == lost[-1]
    return lost[-1]


@pytest.fixture(scope="module")
def scene(road_map: RoadMap, shell: Callable[..., Any], ground: Callable[..., Any]) -> Scene:
    return Scene(road_map, shell, ground)


def test_honest_agents_are_believed_and_nothing_is_told_of_them(scene: Scene):
    frames = [scene.frame(number) for number in range(FRAMES)]
    judged = scene.judge(frames)
    assert outcasts(frames, judged) == set()
    assert not any(one.doubts or one.left_out for one in judged)


@pytest.mark.parametrize(
    "off",
    [
        pytest.param((0, 3.5, 0, 0, 0, 0), id="a lane to the left"),
        pytest.param((5, 0, 0, 0, 0, 0), id="5 m ahead"),
        pytest.param((0, 0, 1, 0, 0, 0), id="raised"),
        pytest.param((0, 0, 0, 0.09, 0, 0), id="tilted"),
        pytest.param((0, 0, 0, 0, 0, 0.26), id="turned"),
        pytest.param((0, 12, 0, 0, 0, 0), id="off the road"),
    ],
)
def test_a_vehicle_in_the_wrong_place_is_left_out_and_nobody_else(
    scene: Scene, off: tuple[float, ...]
) -> None:
    frames = [scene.frame(number, a=np.array(off, float)) for number in range(FRAMES)]
    judged = scene.judge(frames)
    assert outcasts(frames, judged) == {"a"}
    last = judged[-1]
    assert [pose.agent for pose in last.frame.poses] == ["b"]
    assert "a" not in {chunk.agent for chunk in last.frame.chunks}
    assert sum(last.left_out.values()) == 1
    assert all(reason.startswith("implausible_") for reason in last.left_out)
    assert [(one.agent, one.believed) for one in last.doubts] == [("a", False)]


def test_a_post_that_moves_is_left_out(scene: Scene):
    off = np.array([3.0, 0, 0, 0, 0, 0])
    frames = [scene.frame(number, rsu=off * (number > 5)) for number in range(FRAMES)]
    judged = scene.judge(frames)
    assert POST in outcasts(frames, judged)


def test_a_vehicle_is_believed_again_once_it_is_right_again(scene: Scene):
    off = np.array([0, 3.5, 0, 0, 0, 0])
    frames = [scene.frame(number, a=off * (number < 20)) for number in range(120)]
    judged = scene.judge(frames)
    assert "a" not in judged[19].frame.agents
    assert "a" in judged[-1].frame.agents


def test_word_against_word_leaves_nobody_out(scene: Scene):
    off = np.array([5.0, 0, 0, 0, 0, 0])
    frames = []
    for number in range(FRAMES):
        whole = scene.frame(number, a=off)
        chunks = [chunk for chunk in whole.chunks if chunk.agent != POST]
        frames.append(frame_of(number, whole.poses, chunks))
    assert outcasts(frames, scene.judge(frames)) == set()


@pytest.mark.parametrize("std_m", [0.05, 1.5])
def test_a_vehicle_where_others_see_the_road_is_a_ghost(scene: Scene, std_m: float) -> None:
    frames = []
    for number in range(FRAMES):
        whole = scene.frame(number)
        place = np.array([-18.0, 1.75, 0, 0, 0, 0])
        if std_m > 1:
            place[:2] = (7.0, 1.75)
        ghost = pose_of(number, "ghost", place, Equipment.CV, std_m)
        frames.append(frame_of(number, [*whole.poses, ghost], whole.chunks))
    assert outcasts(frames, scene.judge(frames)) == ({"ghost"} if std_m < 1 else set())


def test_a_vehicle_with_a_radio_alone_that_is_there_is_believed(scene: Scene):
    rng = np.random.default_rng(3)
    frames = []
    for number in range(FRAMES):
        whole = scene.frame(number)
        place = np.array([*(CARS[1] + rng.normal(0, 1.5, 2)), 0, 0, 0, 0])
        seen = pose_of(number, "cv", place, Equipment.CV, 1.5)
        frames.append(frame_of(number, [*whole.poses, seen], whole.chunks))
    assert outcasts(frames, scene.judge(frames)) == set()


def test_a_whole_scan_without_a_point_on_the_road_is_no_scan(scene: Scene):
    frames = []
    for number in range(FRAMES):
        whole = scene.frame(number)
        nothing = scene.placed(
            number, "a", whole.chunks[0].sensor_pose, np.zeros((0, 3), np.float32)
        )
        frames.append(frame_of(number, whole.poses, [nothing, *whole.chunks[1:]]))
    judged = scene.judge(frames)
    assert outcasts(frames, judged) == {"a"}
    assert judged[-1].left_out == {"implausible_ground": 1}


def test_a_scan_that_does_not_decode_is_held_against_nobody(scene: Scene):
    frames = []
    for number in range(FRAMES):
        whole = scene.frame(number)
        points = np.zeros((0, 3), np.float32)
        spoilt = scene.placed(number, "a", whole.chunks[0].sensor_pose, points)
        chunks = [replace(spoilt, is_undecodable=True), *whole.chunks[1:]]
        frames.append(frame_of(number, whole.poses, chunks))
    assert outcasts(frames, scene.judge(frames)) == set()


def test_whoever_is_not_sure_of_its_place_is_neither_confirmed_nor_contradicted(scene: Scene):
    rng = np.random.default_rng(5)
    frames = []
    for number in range(FRAMES):
        off = rng.normal(0, [0.5, 0.5, 0.3, 0.005, 0.005, 0.02])
        whole = scene.frame(number, a=off)
        poses = [pose.model_copy(update={"position_std_m": 0.5}) for pose in whole.poses]
        frames.append(replace(whole, poses=poses))
    judged = scene.judge(frames)
    assert outcasts(frames, judged) == set()
    assert not any(one.doubts for one in judged)


def test_chunks_from_two_places_are_not_of_one_scan(scene: Scene):
    frames = []
    for number in range(FRAMES):
        whole = scene.frame(number)
        other = replace(whole.chunks[0], index=1, sensor_pose=whole.chunks[0].sensor_pose + 2.0)
        frames.append(frame_of(number, whole.poses, [*whole.chunks, other]))
    judged = scene.judge(frames)
    assert outcasts(frames, judged) == {"a"}
    assert judged[-1].left_out == {"implausible_motion": 1}


def test_scores_do_not_depend_on_the_order_of_agents(scene: Scene):
    off = np.array([0, 3.5, 0, 0, 0, 0])
    frames = [scene.frame(number, a=off) for number in range(12)]
    turned = [
        replace(f, agents=f.agents[::-1], poses=f.poses[::-1], chunks=f.chunks[::-1])
        for f in frames
    ]
    for one, other in zip(scene.judge(frames), scene.judge(turned), strict=True):
        assert one.doubts == other.doubts


def test_what_is_remembered_is_bounded(scene: Scene):
    edge = Plausibility(scene.road_map, scene.roadway, PlausibilityConfig(), POSTS)
    for number in range(20):
        place = np.array([-20.0, 0, 0, 0, 0, 0])
        poses = [pose_of(number, f"{number}-{n}", place, Equipment.CV) for n in range(100)]
        edge.judge(frame_of(number, poses, []))
    assert len(edge._known) == MOST_KNOWN


def test_boxes_of_an_agent_that_is_not_believed_do_not_count(road_map: RoadMap):
    boxes = np.array([[-30, -1.75, 0.75, 4.5, 1.8, 1.5, 0]], np.float32)
    counts = []
    pipeline = Pipeline(road_map, EdgeConfig(), seed=1)
    for number in range(10):
        off_m = 0.0 if number == 0 else 60.0 * (number % 2)
        pose = pose_of(number, "a", np.array([-60.0 - off_m, -1.75, 0, 0, 0, 0]))
        said = Objects(
            frame=number,
            sim_time_ns=number * 10**8,
            agent="a",
            boxes=boxes,
            scores=np.ones(1, np.float32),
            sense_start_ns=0,
            sense_end_ns=0,
            detect_end_ns=0,
        )
        frame = replace(frame_of(number, [pose], []), found=[AgentDetections(said, 0)])
        counts.append(pipeline.run(frame).counts.upstream["in_0"])
    assert (counts[0], counts[-1]) == (2, 0)


def test_the_check_can_be_turned_off(road_map: RoadMap):
    config = EdgeConfig(plausibility=PlausibilityConfig(enabled=False))
    pipeline = Pipeline(road_map, config, seed=1)
    for number in range(10):
        pose = pose_of(number, "a", np.array([-60.0 * (number % 2), -1.75, 0, 0, 0, 0]))
        result = pipeline.run(frame_of(number, [pose], []))
    assert (result.counts.agents, result.doubts) == (["a"], [])


def test_of_many_that_are_doubted_some_are_told_in_each_frame(scene: Scene):
    edge = Plausibility(scene.road_map, scene.roadway, PlausibilityConfig(), POSTS)
    told = []
    for number in range(6):
        place = np.array([-20.0 + 50 * (number % 2), 0, 0, 0, 0, 0])
        poses = [pose_of(number, f"{n}", place, Equipment.CV) for n in range(300)]
        told.append(len(edge.judge(frame_of(number, poses, [])).doubts))
    assert told[0] == 0
    assert max(told) == MOST_DOUBTS
