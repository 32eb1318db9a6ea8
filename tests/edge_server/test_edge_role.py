"""The edge role on in-process buses, with the agents' messages."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest

from edge_server.config import EdgeConfig
from edge_server.decoding import DecoderPool
from edge_server.frame import Chunk
from edge_server.role import EdgeRole, has_lidars
from protocol import messages as m
from protocol.codec import encode_cloud
from protocol.in_process import InProcessRouter
from protocol.inbox import Envelope, Inbox, Presence
from protocol.process import Context, loop
from protocol.roadmap import RoadMap
from protocol.scans import PointCloud
from protocol.topics import BusName
from tests.waiting import TIMEOUT_S, wait_until

M = TypeVar("M", bound=m.Message)


class Rig:
    """An edge role, two agent processes and a subscriber."""

    def __init__(
        self, road_map: RoadMap, mode: str = "lockstep", policy: str = "full", **edge: Any
    ) -> None:
        scenario = {
            "seed": 1,
            "mode": mode,
            "regions": {"r0": ["j"]},
            "upload": {"policy": policy},
            "edge": EdgeConfig(**edge).model_dump(mode="json"),
            "processes": {"vehicle": 1},
            "roadside_mounts": [{"id": "rsu-0", "tls": "j"}],
            "traffic": {"cav_rate": 0.05},
        }
        setup = m.Setup(
            scenario=scenario,
            road_map=road_map,
            vehicle_types=[],
            meshes=[],
            mesh_vertices=np.zeros((0, 3), np.float32),
            mesh_triangles=np.zeros((0, 3), np.int32),
        )
        world, v2x = InProcessRouter(BusName.WORLD), InProcessRouter()
        self.inbox, self.seen = Inbox(), Inbox()
        listener = v2x.bus(self.seen)
        for topic in ("detections", "lanes", "plan"):
            listener.subscribe(topic)
        listener.watch()
        world.bus(self.seen).subscribe("metrics")
        self.agents = {name: v2x.bus(Inbox()) for name in ("vehicle-0", "infra-r0")}
        self.radio = v2x.bus(Inbox())
        bus = v2x.bus(self.inbox)
        context = Context(
            "edge-r0",
            setup,
            Path(),
            world.bus(self.inbox),
            bus,
            self.inbox,
            threading.Event(),
            lambda: bus,
        )
        self.role = EdgeRole.build(context)

    def turn(self) -> list[Envelope | Presence]:
        """Lets the role handle all messages, and decode all scans; returns what it published."""
        published = self.poll()
        while len(self.role._decoders):
            published += self.poll()
        return published

    def poll(self) -> list[Envelope | Presence]:
        """Lets the role handle all messages, and act; returns what it published."""
        while (item := self.inbox.get()) is not None:
            self.role.on(item)
        self.role.poll()
        return self.listen()

    def listen(self) -> list[Envelope | Presence]:
        """Returns what the role published since the last time."""
        published = []
        while (item := self.seen.get()) is not None:
            published.append(item)
        return published

    def until_published(self, kind: type[m.Message]) -> list[Envelope | Presence]:
        published: list[Envelope | Presence] = []
        wait_until(lambda: published.extend(self.turn()) or of_kind(published, kind))
        return published

    def start(self) -> None:
        for name, bus in self.agents.items():
            bus.announce(name.partition("-")[0], name)
        self.turn()

    def publish_rosters(self, frame: int, agents: list[str], posts: list[str]) -> None:
        for process, names in (("vehicle-0", agents), ("infra-r0", posts)):
            roster = m.Roster(frame=frame, process=process, agents=names, scanning=names)
            self.radio.publish("roster", roster, region="r0", process=process)

    def publish_pose(self, frame: int, agent: str) -> None:
        pose = m.AgentPose(
            frame=frame,
            sim_time_ns=frame * 100,
            agent=agent,
            equipment=m.Equipment.CAV,
            pose=np.array([-40.0, -1.75, 0, 0, 0, 0]),
            length_m=4.5,
            width_m=1.8,
            height_m=1.5,
            position_std_m=0.05,
        )
        self.radio.publish("pose", pose, region="r0", process=host_of(agent), agent=agent)

    def publish_objects(self, frame: int, agent: str, boxes: int) -> None:
        found = m.Objects(
            frame=frame,
            sim_time_ns=frame * 100,
            agent=agent,
            boxes=np.tile(np.array([-30, -1.75, 0.8, 4.5, 1.8, 1.5, 0], np.float32), (boxes, 1)),
            scores=np.ones(boxes, np.float32),
            classes=np.zeros(boxes, np.uint8),
            sense_start_ns=1,
            sense_end_ns=2,
            detect_end_ns=3,
        )
        self.radio.publish("objects", found, region="r0", process=host_of(agent), agent=agent)

    def publish_scan(
        self,
        frame: int,
        agent: str,
        payload: bytes | None = None,
        chunk: tuple[int, int] = (0, 1),
        plan_frame: int = -1,
        key: str = "",
        process: str = "",
    ) -> None:
        points = np.random.default_rng(1).uniform(-50, 50, (100, 3)).astype(np.float32)
        cloud = PointCloud(points, np.zeros(100, np.float32))
        scan = m.Scan(
            frame=frame,
            sim_time_ns=frame * 100,
            agent=agent,
            chunk=chunk[0],
            chunks=chunk[1],
            points=100,
            plan_frame=plan_frame,
            sensor_pose=np.array([0.0 if agent == "rsu-0" else -40.0, 0, 3, 0, 0, 0]),
            sense_start_ns=1,
            sense_end_ns=2,
            encode_end_ns=3,
            payload=np.frombuffer(payload or encode_cloud(cloud, 0.02), np.uint8),
        )
        host = process or host_of(agent)
        where = {"process": host, "agent": key or agent, "chunk": str(chunk[0])}
        self.radio.publish("scan", scan, region="r0", **where)


def host_of(agent: str) -> str:
    return "infra-r0" if agent == "rsu-0" else "vehicle-0"


def of_kind(published: list[Envelope | Presence], kind: type[M]) -> list[M]:
    return [
        item.message
        for item in published
        if isinstance(item, Envelope) and isinstance(item.message, kind)
    ]


def test_the_edge_shows_itself_once_all_agents_are_there(road_map: RoadMap) -> None:
    rig = Rig(road_map)
    rig.agents["infra-r0"].announce("infra", "infra-r0")
    assert Presence("edge", "edge-r0", alive=True) not in rig.turn()
    rig.agents["vehicle-0"].announce("vehicle", "vehicle-0")
    assert Presence("edge", "edge-r0", alive=True) in rig.turn()


def test_a_whole_frame_gives_detections_counts_and_metrics(road_map: RoadMap) -> None:
    rig = Rig(road_map)
    rig.start()
    rig.publish_rosters(3, ["cav"], ["rsu-0"])
    rig.publish_pose(3, "cav")
    rig.publish_scan(3, "cav")
    assert not of_kind(rig.turn(), m.LaneCounts)
    rig.publish_scan(3, "rsu-0")
    published = rig.turn()
    (counts,) = of_kind(published, m.LaneCounts)
    (found,) = of_kind(published, m.Detections)
    (metrics,) = of_kind(published, m.Metrics)
    assert (counts.frame, counts.sim_time_ns, counts.complete) == (3, 300, True)
    assert counts.upstream["in_0"] >= 1
    assert "cav" in found.sources
    assert found.agents == ["cav", "rsu-0"]
    assert [(a.agent, a.chunk) for a in metrics.arrivals] == [("cav", 0), ("rsu-0", 0)]
    assert metrics.points == 200
    stages = [span.stage for span in metrics.spans]
    early = ["wait", "decode", "place", "decode", "place"]
    assert stages == [*early, "check", "merge", "ground", "detect", "fuse", "track", "count"]
    assert metrics.drops == {}


def test_a_frame_without_agents_still_gives_counts(road_map: RoadMap) -> None:
    rig = Rig(road_map)
    rig.start()
    state = m.SignalState(
        frame=0,
        sim_time_ns=55,
        tls="j",
        state="GGr",
        stage="green",
        green="GGr",
        source="plan",
        earliest_change_ns=0,
    )
    rig.radio.publish("state", state, tls="j")
    rig.publish_rosters(0, [], [])
    (counts,) = of_kind(rig.turn(), m.LaneCounts)
    assert counts.sim_time_ns == 55
    assert counts.upstream == {"in_0": 0, "in_1": 0, "side_0": 0}


def test_a_scan_that_does_not_decode_is_counted_and_holds_nobody_up(road_map: RoadMap) -> None:
    rig = Rig(road_map)
    rig.start()
    rig.publish_rosters(0, [], ["rsu-0"])
    rig.publish_scan(0, "rsu-0", payload=b"SCAN but no scan")
    published = rig.turn()
    (counts,) = of_kind(published, m.LaneCounts)
    assert counts.complete
    assert of_kind(published, m.Metrics)[0].drops == {"CodecError": 1}


def test_in_realtime_a_frame_ends_at_its_deadline(road_map: RoadMap) -> None:
    rig = Rig(road_map, mode="realtime", deadline_ms=0.001)
    rig.start()
    rig.publish_rosters(0, ["cav"], ["rsu-0"])
    rig.publish_pose(0, "cav")
    (counts,) = of_kind(rig.turn(), m.LaneCounts)
    assert not counts.complete
    assert counts.upstream["in_0"] == 1
    rig.publish_scan(0, "cav")
    rig.publish_rosters(1, [], [])
    rig.turn()
    assert rig.role._assembler.drops["late"] == 1


def test_an_agent_process_that_dies_in_lockstep_frees_the_frame(road_map: RoadMap) -> None:
    rig = Rig(road_map)
    rig.start()
    rig.publish_rosters(0, ["cav"], ["rsu-0"])
    rig.publish_scan(0, "rsu-0")
    assert not of_kind(rig.turn(), m.LaneCounts)
    rig.agents["vehicle-0"].close()
    (counts,) = of_kind(rig.turn(), m.LaneCounts)
    assert counts.agents == ["rsu-0"]


def test_a_message_on_the_key_of_another_sender_is_refused(road_map: RoadMap) -> None:
    rig = Rig(road_map)
    rig.start()
    ghost = m.Roster(frame=0, process="vehicle-0", agents=["ghost"], scanning=[])
    rig.radio.publish("roster", ghost, region="r0", process="vehicle-9")
    rig.publish_rosters(0, ["cav"], [])
    rig.publish_scan(0, "cav")
    rig.publish_pose(0, "cav")
    (metrics,) = of_kind(rig.turn(), m.Metrics)
    assert metrics.drops == {"wrong_sender": 1}


def test_nobody_speaks_for_an_agent_of_another_process(road_map: RoadMap) -> None:
    rig = Rig(road_map)
    rig.start()
    rig.publish_scan(0, "rsu-0", payload=b"SCAN but no scan", process="vehicle-0")
    rig.publish_rosters(0, ["cav", "rsu-0"], ["rsu-0"])
    rig.publish_scan(0, "cav", payload=b"SCAN but no scan", process="infra-r0")
    rig.publish_scan(0, "other", process="vehicle-9")
    rig.publish_scan(0, "rsu-0")
    rig.publish_scan(0, "cav")
    rig.publish_pose(0, "cav")
    (metrics,) = of_kind(rig.until_published(m.LaneCounts), m.Metrics)
    assert metrics.drops == {"wrong_sender": 3, "absent_process": 1}
    assert sorted(arrival.agent for arrival in metrics.arrivals) == ["cav", "rsu-0"]


def test_a_chunk_is_decoded_once(road_map: RoadMap) -> None:
    rig = Rig(road_map)
    rig.start()
    rig.publish_rosters(0, [], ["rsu-0"])
    rig.publish_scan(0, "rsu-0")
    rig.publish_scan(0, "rsu-0", payload=b"SCAN but no scan")
    (metrics,) = of_kind(rig.turn(), m.Metrics)
    assert metrics.drops == {"duplicate": 1}


class Gate:
    """Blocks the decoding of scans until it is opened."""

    def __init__(self, rig: Rig, error: Exception | None = None) -> None:
        self.event = threading.Event()
        self._open_scan = rig.role._pipeline.open
        self._error = error
        rig.role.close()
        rig.role._decoders = DecoderPool(self._pass, rig.inbox.wake)

    def _pass(self, scan: m.Scan, received_ns: int) -> Chunk:
        assert self.event.wait(TIMEOUT_S)
        if self._error is not None:
            raise self._error
        return self._open_scan(scan, received_ns)


def test_of_two_copies_that_come_at_once_one_is_opened(road_map: RoadMap) -> None:
    rig = Rig(road_map)
    rig.start()
    gate = Gate(rig)
    rig.publish_rosters(0, [], ["rsu-0"])
    rig.publish_scan(0, "rsu-0")
    rig.publish_scan(0, "rsu-0")
    assert not of_kind(rig.poll(), m.LaneCounts)
    gate.event.set()
    (metrics,) = of_kind(rig.turn(), m.Metrics)
    assert metrics.drops == {"duplicate": 1}
    assert metrics.points == 100


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_what_came_in_time_is_used_however_long_opening_it_takes(
    road_map: RoadMap, mode: str
) -> None:
    rig = Rig(road_map, mode=mode, deadline_ms=0.001, lockstep_timeout_s=1e-6)
    rig.start()
    gate = Gate(rig)
    rig.publish_rosters(0, [], ["rsu-0"])
    rig.publish_scan(0, "rsu-0")
    for _ in range(3):
        assert not of_kind(rig.poll(), m.LaneCounts)
    gate.event.set()
    (counts,) = of_kind(rig.turn(), m.LaneCounts)
    assert (counts.complete, counts.agents) == (True, ["rsu-0"])


def test_a_fault_of_the_opening_is_counted_and_the_frame_ends_without_the_scan(
    road_map: RoadMap,
) -> None:
    rig = Rig(road_map, mode="realtime", deadline_ms=0.001)
    rig.start()
    Gate(rig, error=ValueError("a fault")).event.set()
    rig.publish_rosters(0, [], ["rsu-0"])
    rig.publish_scan(0, "rsu-0")
    published = rig.until_published(m.Metrics)
    assert not of_kind(published, m.LaneCounts)[0].complete
    assert of_kind(published, m.Metrics)[0].drops == {"role_error": 1, "frame_incomplete": 1}


def test_a_frame_is_worked_on_as_soon_as_its_last_scan_is_open(
    road_map: RoadMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("protocol.process.POLL_S", 10 * TIMEOUT_S)
    rig = Rig(road_map, mode="realtime", deadline_ms=10_000)
    rig.start()
    gate, stop = Gate(rig), threading.Event()
    thread = threading.Thread(target=loop, args=(rig.role, rig.inbox, stop))
    thread.start()
    try:
        rig.publish_rosters(0, [], ["rsu-0"])
        rig.publish_scan(0, "rsu-0")
        wait_until(lambda: len(rig.role._decoders) == 1 and rig.inbox._queue.empty())
        gate.event.set()
        wait_until(lambda: of_kind(rig.listen(), m.LaneCounts))
    finally:
        stop.set()
        rig.inbox.wake()
        thread.join()
        rig.role.close()


@pytest.mark.parametrize("unwanted", [{"deadline": 3}, {"merge": "draco"}, {"deadline_ms": 0}])
def test_settings_that_cannot_be_are_refused(unwanted: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(unwanted))):
        EdgeConfig.model_validate(unwanted)


def test_a_size_filter_that_lets_nothing_through_is_refused() -> None:
    with pytest.raises(ValueError, match="min_width_m is 4.0, more than max_width_m, 3.0"):
        EdgeConfig.model_validate({"boxes": {"min_width_m": 4.0}})


def kinds(published: list[Envelope | Presence]) -> list[str]:
    return [type(item.message).__name__ for item in published if isinstance(item, Envelope)]


def test_in_lockstep_plans_go_out_before_the_counts_and_hold_no_measured_rate(
    road_map: RoadMap,
) -> None:
    rig = Rig(road_map, policy="power")
    rig.start()
    rig.publish_rosters(3, ["cav"], ["rsu-0"])
    rig.publish_pose(3, "cav")
    rig.publish_scan(3, "cav")
    rig.publish_scan(3, "rsu-0")
    published = rig.turn()
    assert kinds(published)[:3] == ["Plan", "Plan", "LaneCounts"]
    plans = of_kind(published, m.Plan)
    assert [plan.agent for plan in plans] == ["cav", "rsu-0"]
    for plan in plans:
        assert (plan.frame, plan.enough, plan.mbps) == (5, 3, 0)
        assert plan.agents == ["cav", "rsu-0"]
        np.testing.assert_allclose(plan.weights_m2[:, 1], [0, 0], atol=1e-6)


def test_who_sends_all_it_has_needs_no_plan_in_lockstep(road_map: RoadMap) -> None:
    rig = Rig(road_map)
    rig.start()
    rig.publish_rosters(0, [], ["rsu-0"])
    rig.publish_scan(0, "rsu-0")
    assert of_kind(rig.turn(), m.Plan) == []


def test_in_realtime_everybody_hears_its_rate_and_that_the_frame_is_over(
    road_map: RoadMap,
) -> None:
    rig = Rig(road_map, mode="realtime", deadline_ms=10_000)
    rig.start()
    rig.publish_rosters(0, [], ["rsu-0"])
    rig.publish_scan(0, "rsu-0")
    (plan,) = of_kind(rig.turn(), m.Plan)
    assert (plan.frame, plan.enough, plan.agents) == (2, 0, [])


def test_in_realtime_a_frame_ends_once_neighbours_cover_the_space_between_them(
    road_map: RoadMap,
) -> None:
    rig = Rig(road_map, mode="realtime", policy="reap", deadline_ms=10_000)
    rig.start()
    for frame, plan_frame, last in ((0, -1, 0), (1, -1, 0), (2, 2, 2)):
        chunks = 1 if frame < 2 else 4
        rig.publish_rosters(frame, ["cav"], ["rsu-0"])
        rig.publish_pose(frame, "cav")
        rig.publish_scan(frame, "cav", chunk=(0, chunks), plan_frame=plan_frame)
        assert not of_kind(rig.turn(), m.LaneCounts)
        for chunk in range(last + 1):
            assert not of_kind(rig.turn(), m.LaneCounts)
            rig.publish_scan(frame, "rsu-0", chunk=(chunk, chunks), plan_frame=plan_frame)
        published = rig.turn()
        (counts,) = of_kind(published, m.LaneCounts)
        assert (counts.frame, counts.complete) == (frame, True)
        assert {plan.enough for plan in of_kind(published, m.Plan)} == {frame}


def test_who_was_cut_by_another_plan_than_its_neighbour_must_have_sent_all(
    road_map: RoadMap,
) -> None:
    rig = Rig(road_map, mode="realtime", policy="reap", deadline_ms=10_000)
    rig.start()
    for frame in (0, 1):
        rig.publish_rosters(frame, ["cav"], ["rsu-0"])
        rig.publish_pose(frame, "cav")
        for agent in ("cav", "rsu-0"):
            rig.publish_scan(frame, agent)
        assert of_kind(rig.turn(), m.LaneCounts)
    rig.publish_rosters(3, ["cav"], ["rsu-0"])
    rig.publish_pose(3, "cav")
    for chunk in range(3):
        rig.publish_scan(3, "cav", chunk=(chunk, 4), plan_frame=2)
        rig.publish_scan(3, "rsu-0", chunk=(chunk, 4), plan_frame=3)
    assert not of_kind(rig.turn(), m.LaneCounts)
    rig.publish_scan(3, "cav", chunk=(3, 4), plan_frame=2)
    assert of_kind(rig.turn(), m.LaneCounts)


def test_whose_scan_is_always_late_still_gets_a_plan(road_map: RoadMap) -> None:
    rig = Rig(road_map, mode="realtime", policy="reap", deadline_ms=20)
    rig.start()
    for frame in (0, 1):
        rig.publish_rosters(frame, ["cav"], ["rsu-0"])
        rig.publish_pose(frame, "cav")
        rig.publish_scan(frame, "cav")
        published = rig.turn()
        while not of_kind(published, m.Plan):
            published = rig.turn()
        rig.publish_scan(frame, "rsu-0")
        rig.turn()
    plans = of_kind(published, m.Plan)
    assert [plan.agents for plan in plans] == [["cav", "rsu-0"]] * 2


def world_at(frame: int) -> m.SignalState:
    return m.SignalState(
        frame=frame,
        sim_time_ns=frame * 100,
        tls="j",
        state="GGr",
        stage="green",
        green="GGr",
        source="plan",
        earliest_change_ns=0,
    )


@pytest.mark.parametrize("chunks", [1, 64])
def test_a_flood_from_one_agent_delays_no_frame_of_the_others(
    road_map: RoadMap, chunks: int
) -> None:
    """One agent repeats its scan, or claims 64 chunks, of this frame, of old and of future ones."""
    rig = Rig(road_map, mode="realtime", deadline_ms=50)
    rig.start()
    for frame in range(4):
        rig.radio.publish("state", world_at(frame), tls="j")
        rig.publish_rosters(frame, ["cav"], ["rsu-0"])
        rig.publish_pose(frame, "cav")
        for repeat in range(200):
            for claimed in (frame, max(frame - 2, 0), frame + 50 + repeat):
                rig.publish_scan(claimed, "cav", chunk=(repeat % chunks, chunks))
            rig.publish_scan(frame, "rsu-0", chunk=(63, 64), key="cav")  # in another's name
        rig.publish_scan(frame, "rsu-0")
        assert rig.inbox._queue.qsize() <= 4 * (chunks + 1) + 8
        published = rig.until_published(m.LaneCounts)
        (counts,) = of_kind(published, m.LaneCounts)
        assert counts.frame == frame
        (metrics,) = of_kind(published, m.Metrics)
        assert "rsu-0" in {arrival.agent for arrival in metrics.arrivals}
        decoded = [span for span in metrics.spans if span.stage == "decode"]
        assert len(decoded) <= chunks + 1
    assert {"overtaken", "wrong_sender", "far_frame"} <= metrics.drops.keys()


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({}, True),
        ({"roadside_mounts": []}, True),
        ({"traffic": {"cav_rate": 0}}, True),
        ({"roadside_mounts": [], "traffic": {"cav_rate": 0}}, False),
        ({"roadside_mounts": [], "traffic": {"cav_rate": 0}, "recording": "somewhere"}, True),
        ({"upload": {"policy": "objects"}}, True),
        ({"upload": {"policy": "pose"}}, False),
        ({"upload": {"policy": "pose", "roadside": {"policy": "full"}}}, True),
        ({"upload": {"roadside": {"policy": "pose"}}, "traffic": {"cav_rate": 0}}, False),
    ],
)
def test_a_scenario_says_whether_anybody_sends_what_a_lidar_sees(
    changed: dict[str, Any], expected: bool
) -> None:
    scenario = {"roadside_mounts": [{}], "traffic": {"cav_rate": 0.05}, "upload": {}} | changed
    assert has_lidars(scenario, scenario["roadside_mounts"]) is expected


def test_strangers_who_fill_a_frame_do_not_end_the_edge(road_map: RoadMap) -> None:
    rig = Rig(road_map)
    rig.start()
    rig.publish_rosters(3, ["cav"], ["rsu-0"])
    nothing = encode_cloud(PointCloud(np.zeros((0, 3), np.float32), np.zeros(0, np.float32)), 0.02)
    for number in range(2100):
        stranger = f"{number:0128}"
        rig.publish_scan(3, stranger, payload=nothing)
        if number < 600:
            rig.publish_pose(3, stranger)
            rig.publish_objects(3, stranger, boxes=40)
        if number % 500 == 0:
            rig.turn()
    rig.publish_pose(3, "cav")
    rig.publish_scan(3, "cav")
    rig.publish_scan(3, "rsu-0")
    published = rig.until_published(m.Metrics)
    (counts,) = of_kind(published, m.LaneCounts)
    assert {"cav", "rsu-0"} <= set(counts.agents)
    assert len(counts.agents) == 512
    (metrics,) = of_kind(published, m.Metrics)
    assert metrics.drops["too_many_agents"] > 1000
    assert metrics.drops["frame_too_large"] > 300
    assert metrics.drops["untold"] > 100
