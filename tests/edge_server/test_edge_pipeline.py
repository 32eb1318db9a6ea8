"""From points to counts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from edge_server.config import EdgeConfig
from edge_server.frame import (
    AgentDetections,
    Chunk,
    ChunkStage,
    Frame,
    FrameStage,
    FrameState,
)
from edge_server.pipeline import Merge, Pipeline, stages_of
from perception.config import GroundConfig
from perception.detector import Vehicles
from perception.roadway import Placed
from protocol.codec.payload import Form, Head
from protocol.messages import AgentPose, Equipment, Objects, Scan
from protocol.regions import RegionMap
from protocol.roadmap import RoadMap
from tests.edge_server.made_frames import CARS, ROADSIDE, frame_of


def pipeline_of(road_map: RoadMap, config: EdgeConfig, **given: Any) -> Pipeline:
    return Pipeline.of(RegionMap.whole(road_map), config, **given)


@pytest.mark.parametrize("merge", ["se3", "euler"])
def test_every_car_on_a_climbing_road_is_found_and_counted(
    climbing_road: RoadMap, car_shell: Callable[..., Any], ground: Callable[..., Any], merge: Any
) -> None:
    pipeline = pipeline_of(climbing_road, EdgeConfig(merge=merge), seed=1)
    result = pipeline.run(frame_of(car_shell, ground))
    found = result.detections
    near = np.linalg.norm(
        np.array([*CARS, (-60, -1.75)])[:, None] - found.boxes[None, :, :2], axis=2
    )
    assert near.min(axis=1).max() < 0.5
    assert len(found.boxes) == len(CARS) + 1
    assert result.counts["j"].upstream == {"in_0": 3, "in_1": 3, "side_0": 0}
    assert result.counts["j"].downstream == {"out_0": 1, "out_1": 1}
    assert found.sources.count("cav") == 1
    at = found.sources.index("cav")
    assert found.lanes[at] == "in_0"
    assert found.distances_m[at] == pytest.approx(50, abs=0.1)
    assert (
        result.counts["j"].sim_time_ns,
        result.counts["j"].tls,
        result.counts["j"].complete,
    ) == (7, "j", True)
    stages = [span.stage for span in result.spans if span.stage != "place"]
    assert stages == ["check", "merge", "ground", "detect", "fuse", "track", "count"]


def test_without_tracks_a_frame_gives_the_same_result_whatever_came_before_it(
    climbing_road: RoadMap, car_shell: Callable[..., Any], ground: Callable[..., Any]
) -> None:
    config = EdgeConfig.model_validate({"tracking": {"enabled": False}})
    fresh, used = (pipeline_of(climbing_road, config, seed=4) for _ in range(2))
    used.run(frame_of(car_shell, ground, seed=2, number=1))
    frame = frame_of(car_shell, ground, number=2)
    one, other = fresh.run(frame).detections, used.run(frame).detections
    np.testing.assert_array_equal(one.boxes, other.boxes)
    np.testing.assert_array_equal(one.scores, other.scores)


def test_a_frame_without_agents_counts_nothing(road_map: RoadMap) -> None:
    result = pipeline_of(road_map, EdgeConfig(), seed=1).run(Frame(0, 0, [], [], [], True, 0, 0))
    assert set(result.counts["j"].upstream.values()) == {0}
    assert len(result.detections.boxes) == 0


def test_a_frame_to_which_no_lidar_contributed_is_seen_by_nobody(road_map: RoadMap) -> None:
    nothing = Frame(0, 0, [], [], [], True, 0, 0)
    counts = pipeline_of(road_map, EdgeConfig(), seed=1).run(nothing).counts["j"]
    assert counts.coverage_upstream.keys() == counts.upstream.keys()
    assert {*counts.coverage_upstream.values(), *counts.coverage_downstream.values()} == {0.0}


def test_where_there_are_no_lidars_nothing_is_said_of_sight(road_map: RoadMap) -> None:
    nothing = Frame(0, 0, [], [], [], True, 0, 0)
    counts = pipeline_of(road_map, EdgeConfig(), seed=1, has_lidars=False).run(nothing).counts["j"]
    assert (counts.coverage_upstream, counts.coverage_downstream) == ({}, {})


@pytest.mark.parametrize(("agent", "is_known"), [("rsu-0", True), ("stranger", False)])
def test_who_sends_boxes_sees_what_is_around_it_and_nothing_else(road_map, agent, is_known):
    found = Objects(
        frame=0, sim_time_ns=0, agent=agent, boxes=np.zeros((0, 7), np.float32),
        scores=np.zeros(0, np.float32), classes=np.zeros(0, np.uint8),
        sense_start_ns=0, sense_end_ns=0, detect_end_ns=0,
    )  # fmt: skip
    frame = Frame(0, 0, [agent], [], [], True, 0, 0, found=[AgentDetections(found, 0)])
    far, near = np.array([1000.0, 0, 0]), ROADSIDE[:3]
    for place, sees in ((near, is_known), (far, False)):
        pipeline = pipeline_of(road_map, EdgeConfig(), seed=1, mounts={"rsu-0": place})
        seen = pipeline.run(frame).counts["j"].coverage_upstream
        assert (max(seen.values()) > 0) is sees


def test_a_scan_that_cannot_be_read_saw_nothing(road_map: RoadMap) -> None:
    points = np.zeros((0, 3), np.float32)
    scan = Chunk(0, 0, "rsu-0", 0, 1, ROADSIDE, points, 0)
    for chunk, nobody in ((scan, False), (replace(scan, is_undecodable=True), True)):
        frame = Frame(0, 0, ["rsu-0"], [], [chunk], True, 0, 0)
        counts = pipeline_of(road_map, EdgeConfig(), seed=1).run(frame).counts["j"]
        assert (max(counts.coverage_upstream.values()) == 0) is nobody


def test_the_papers_settings_work_on_a_level_road(
    road_map: RoadMap, car_shell: Callable[..., Any], ground: Callable[..., Any]
) -> None:
    config = EdgeConfig.model_validate(
        {
            "merge": "euler",
            "ground": GroundConfig(tile_m=None),
            "fusion": {"rule": "radius"},
        }
    )
    rng = np.random.default_rng(1)
    cars = [car_shell([x, -1.75, 0, 0, 0, 0], (0.0, 0.0), rng) for x in (-50, -30, 40)]
    points = np.concatenate([ground(rng), *cars])
    scan = Chunk(0, 0, "rsu-0", 0, 1, np.zeros(6), points, 0)
    frame = Frame(0, 0, ["rsu-0"], [], [scan], True, 0, 0)
    result = pipeline_of(road_map, config, seed=1).run(frame)
    assert (result.counts["j"].upstream["in_0"], result.counts["j"].downstream["out_0"]) == (2, 1)


def pose_of(agent: str, x: float, y: float, number: int, std_m: float = 0.05) -> AgentPose:
    return AgentPose(
        frame=number,
        sim_time_ns=number * 10**9,
        agent=agent,
        equipment=Equipment.CV,
        pose=np.array([x, y, 0, 0, 0, 0]),
        length_m=4.5,
        width_m=1.8,
        height_m=1.5,
        position_std_m=std_m,
    )


def frame_of_poses(number: int, *poses: AgentPose) -> Frame:
    agents = [pose.agent for pose in poses]
    return Frame(number, number * 10**9, agents, [*poses], [], True, 0, 0)


def test_stationary_vehicles_are_queued_and_moving_ones_are_not(road_map: RoadMap) -> None:
    pipeline = pipeline_of(road_map, EdgeConfig(), seed=1)
    for number in range(2):
        parked = [pose_of(f"p{n}", -15 - 10 * n, -1.75, number) for n in range(2)]
        moving = pose_of("m", -90 + 10 * number, 1.75, number)
        behind = pose_of("q", 30, -1.75, number)
        counts = pipeline.run(frame_of_poses(number, moving, *parked, behind)).counts["j"]
        assert counts.upstream == {"in_0": 2, "in_1": 1, "side_0": 0}
        assert counts.stationary_upstream == {"in_0": 2 * number, "in_1": 0, "side_0": 0}
        assert counts.stationary_downstream == {"out_0": number, "out_1": 0}


@pytest.mark.parametrize(("std_m", "counted"), [(0.05, 0), (1.5, 1)])
def test_a_vehicle_beside_its_lane_counts_as_far_as_its_position_error_reaches(
    road_map: RoadMap, std_m: float, counted: int
) -> None:
    off = pose_of("a", -50, 3.5 + 0.5 + 1.0, 0, std_m)  # 1 m beyond the margin of in_1
    counts = pipeline_of(road_map, EdgeConfig(), seed=1).run(frame_of_poses(0, off)).counts["j"]
    assert counts.upstream["in_1"] == counted


class KnownBefore(FrameStage):
    """Between fuse and count: keeps vehicles that one frame before this one had as well."""

    name = "known"

    def __init__(self) -> None:
        self.known: set[str] = set()

    def run(self, state: FrameState) -> None:
        seen = np.array([source in self.known for source in state.fused.sources], bool)
        self.known = set(state.fused.sources)
        state.fused = state.fused.take(seen)


def test_a_stage_is_added_by_adding_it_to_the_list(road_map: RoadMap) -> None:
    stages = stages_of(RegionMap.whole(road_map), EdgeConfig(), seed=1)
    pipeline = Pipeline([*stages[:-2], KnownBefore(), *stages[-2:]])
    assert [stage.name for stage in pipeline.stages] == [
        "decode", "place", "check", "merge", "detect", "fuse", "known", "track", "count",
    ]  # fmt: skip
    states = [pipeline.run(frame_of_poses(n, pose_of("a", -50, 1.75, n))) for n in range(2)]
    assert [state.counts["j"].upstream["in_1"] for state in states] == [0, 1]
    assert [span.stage for span in states[1].spans][-4:] == ["fuse", "known", "track", "count"]


class Thin(ChunkStage):
    """Keeps no point of a chunk."""

    name = "thin"

    def run(self, chunk: Chunk) -> Chunk:
        return replace(chunk, points=chunk.points[:0])


def test_a_stage_of_chunks_runs_as_they_arrive_and_has_a_span(
    climbing_road: RoadMap, car_shell: Callable[..., Any], ground: Callable[..., Any]
) -> None:
    stages = stages_of(RegionMap.whole(climbing_road), EdgeConfig(), seed=1)
    pipeline = Pipeline([stages[0], Thin(), *stages[1:]])
    frame = frame_of(car_shell, ground)
    chunk = pipeline.prepare(frame.chunks[0])
    assert [(span.stage, span.agent) for span in chunk.spans] == [
        (name, "rsu-0") for name in ("decode", "thin", "place")
    ]
    assert pipeline.prepare(chunk) is chunk
    assert pipeline.run(replace(frame, chunks=[chunk])).detections.sources == ["cav"]


def test_a_list_of_stages_out_of_order_or_with_one_twice_is_refused(road_map: RoadMap) -> None:
    stages = stages_of(RegionMap.whole(road_map), EdgeConfig(), seed=1)
    for wrong in ([*stages, stages[0]], [*stages, stages[-1]], [stages[-1], *stages[:-1]]):
        with pytest.raises(ValueError, match="stages of chunks first"):
            Pipeline(wrong)


def test_a_detector_divides_its_stage_and_one_that_does_not_is_one_span(road_map: RoadMap) -> None:
    class Silent:
        def detect(self, cloud: Any, rng: Any, stage: Any) -> Vehicles:
            return Vehicles.from_lidar(np.zeros((0, 7)), np.zeros(0))

    pipeline = pipeline_of(road_map, EdgeConfig(), seed=1, detector=lambda *_: Silent())
    spans = pipeline.run(frame_of_poses(0)).spans
    assert [span.stage for span in spans] == ["check", "merge", "detect", "fuse", "track", "count"]
    assert all(a.end_ns <= b.start_ns for a, b in pairwise(spans))


def test_random_numbers_of_detection_depend_on_seed_and_frame_alone(road_map: RoadMap) -> None:
    drawn: list[int] = []

    class Drawing:
        def detect(self, cloud: Any, rng: np.random.Generator, stage: Any) -> Vehicles:
            drawn.append(int(rng.integers(1 << 60)))
            return Vehicles.from_lidar(np.zeros((0, 7)), np.zeros(0))

    for seed, number in ((1, 0), (1, 3), (1, 3), (2, 3)):
        pipeline = pipeline_of(road_map, EdgeConfig(), seed=seed, detector=lambda *_: Drawing())
        pipeline.run(frame_of_poses(number))
    assert drawn[1] == drawn[2]
    assert len(set(drawn)) == 3


def test_what_no_stage_has_filled_in_is_an_error() -> None:
    with pytest.raises(AttributeError, match="cloud"):
        FrameState(frame_of_poses(0)).cloud  # noqa: B018


def objects_of(agent: str, *x_m: float) -> AgentDetections:
    rows = [(x, -1.75, 0.75, 4.5, 1.8, 1.5, 0.0) for x in x_m]
    boxes = np.array(rows, np.float32).reshape(-1, 7)
    objects = Objects(
        frame=0, sim_time_ns=0, agent=agent, boxes=boxes, scores=np.full(len(x_m), 0.5, np.float32),
        classes=np.zeros(len(x_m), np.uint8),
        sense_start_ns=0, sense_end_ns=0, detect_end_ns=0,
    )  # fmt: skip
    return AgentDetections(objects, 0)


def test_boxes_of_several_agents_are_all_counted(road_map: RoadMap) -> None:
    sent = [objects_of("a", -50.0), objects_of("b", -30.0, 40.0)]
    frame = Frame(0, 0, ["a", "b"], [], [], True, 0, 0, found=sent)
    result = pipeline_of(road_map, EdgeConfig(), seed=1).run(frame)
    assert sorted(result.detections.boxes[:, 0].tolist()) == [-50, -30, 40]
    assert result.detections.scores.tolist() == [0.5] * 3
    assert (result.counts["j"].upstream["in_0"], result.counts["j"].downstream["out_0"]) == (2, 1)


def test_a_vehicle_on_the_first_lane_of_the_map_is_on_the_road(road_map: RoadMap) -> None:
    assert road_map.lanes[0].id == "far_0"
    frame = frame_of_poses(0, pose_of("a", -200, 0, 0))
    result = pipeline_of(road_map, EdgeConfig(), seed=1).run(frame)
    assert result.detections.lanes == ["far_0"]


def test_numbers_of_detections_are_sent_in_single_precision(road_map: RoadMap) -> None:
    found = pipeline_of(road_map, EdgeConfig(), seed=1).run(frame_of_poses(0)).detections
    assert {found.boxes.dtype, found.scores.dtype, found.distances_m.dtype} == {np.dtype("f4")}


def test_counts_carry_the_coverage_of_both_sides_and_the_frames_delay(road_map: RoadMap) -> None:
    pose = pose_of("a", 0, 1.75, 0)
    frame = Frame(0, 0, ["a"], [pose], [], True, 0, 0, found=[objects_of("a")])
    config = EdgeConfig(coverage_range_m=500)
    counts = pipeline_of(road_map, config, seed=1).run(replace(frame, delay_sim_ns=30)).counts["j"]
    assert counts.delay_sim_ns == 30
    assert counts.coverage_upstream == {"in_0": 1, "in_1": 1, "side_0": 1}
    assert counts.coverage_downstream == {"out_0": 1, "out_1": 1}
    assert counts.coverage_from_bar == counts.coverage_upstream


def test_without_the_misbehaviour_check_it_is_no_stage(road_map: RoadMap) -> None:
    config = EdgeConfig.model_validate({"misbehaviour": {"enabled": False}})
    names = [stage.name for stage in stages_of(RegionMap.whole(road_map), config, seed=1)]
    assert names == ["decode", "place", "merge", "detect", "fuse", "track", "count"]


def test_the_paper_merge_places_a_whole_frame_and_the_exact_one_each_chunk(
    road_map: RoadMap,
) -> None:
    exact, euler = (
        stages_of(RegionMap.whole(road_map), EdgeConfig.model_validate({"merge": merge}), seed=1)[1]
        for merge in ("se3", "euler")
    )
    assert isinstance(exact, ChunkStage)
    assert isinstance(euler, FrameStage)


def test_the_height_of_a_vehicle_is_no_motion(road_map: RoadMap) -> None:
    pipeline = pipeline_of(
        road_map,
        EdgeConfig.model_validate({"misbehaviour": {"enabled": False}}),
        seed=1,
    )
    for number in range(2):
        place = np.array([-30, -1.75, 2.5 * number, 0, 0, 0])
        lifted = pose_of("a", -30, -1.75, number).model_copy(update={"pose": place})
        counts = pipeline.run(frame_of_poses(number, lifted)).counts["j"]
    assert counts.stationary_upstream["in_0"] == 1


def test_chunks_with_ground_and_without_are_merged_apart() -> None:
    empty = np.zeros((0, 3), np.float32)
    placed = [Placed(empty, empty[:, 0], empty) for _ in range(2)]
    chunk = Chunk(0, 0, "a", 0, 1, np.zeros(6), empty, 0)
    chunks = [
        chunk,
        replace(chunk, placed=placed[0], sensor_pose=np.arange(6.0)),
        replace(chunk, placed=placed[1], ground_free=True),
    ]
    state = FrameState(Frame(0, 0, ["a"], [], chunks, True, 0, 0))
    Merge().run(state)
    assert (state.cloud.near, state.cloud.bare) == ([placed[0]], [placed[1]])
    assert state.cloud.sensors.tolist() == [[0, 1, 2], [0, 0, 0]]


def test_a_scan_that_arrives_is_decoded_and_placed(road_map: RoadMap) -> None:
    scan = Scan(
        frame=3, sim_time_ns=4, agent="a", chunk=0, chunks=1, points=0, sensor_pose=np.zeros(6),
        sense_start_ns=0, sense_end_ns=0, encode_end_ns=0,
        payload=np.frombuffer(Head(Form.TREE, 0, 0.02).seal(), np.uint8),
    )  # fmt: skip
    chunk = pipeline_of(road_map, EdgeConfig(), seed=1).open(scan, 99)
    assert (chunk.frame, chunk.agent, chunk.received_ns, chunk.payload) == (3, "a", 99, None)
    assert chunk.placed is not None
    assert [span.stage for span in chunk.spans] == ["decode", "place"]


def test_unless_said_otherwise_a_scenario_has_lidars(road_map: RoadMap) -> None:
    state = Pipeline(stages_of(RegionMap.whole(road_map), EdgeConfig(), seed=1)).run(
        frame_of_poses(0)
    )
    assert state.counts["j"].coverage_upstream == {"in_0": 0.0, "in_1": 0.0, "side_0": 0.0}


def test_of_an_agent_that_sends_its_own_part_no_other_is_covered(road_map: RoadMap) -> None:
    """The agent stands at the stop bars, and its part is what lies behind them."""
    points = np.zeros((0, 3), np.float32)
    chunk = Chunk(0, 0, "rsu-0", 0, 1, np.array([0, 0, 5.0, 0, 0, 0]), points, 0, plan_frame=0)
    config = EdgeConfig(coverage_range_m=500)
    behind = np.array([(0.0, -600.0), (600.0, -600.0), (600.0, 600.0), (0.0, 600.0)])
    whole = Frame(0, 0, ["rsu-0"], [], [chunk], complete=True, first_ns=0, ready_ns=0)
    shares = []
    for cells in ({}, {"rsu-0": behind}):
        counts = pipeline_of(road_map, config, seed=1).run(replace(whole, cells=cells)).counts["j"]
        shares.append((counts.coverage_from_bar["in_0"], counts.coverage_downstream["out_0"]))
    assert shares == [(1.0, 1.0), (0.0, pytest.approx(0.95, abs=0.03))]
