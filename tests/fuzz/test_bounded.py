"""Memory that senders can fill: measured with the most that a hostile one can publish."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest
from fuzz_watch import forget_peak, peak_kib

from cpnet.limits import MAX_UNEXPECTED
from cpnet.watch import PresenceTable
from edge_server import static_map
from edge_server.alignment import MOST_AGENTS, Align
from edge_server.assembler import (
    MAX_AGENTS,
    MAX_BOXES,
    MAX_CHUNKS,
    MAX_OPEN_FRAMES,
    MAX_PROCESSES,
    Assembler,
    FrameAssembly,
)
from edge_server.config import PlanConfig
from edge_server.decoding import PER_THREAD, DecoderPool
from edge_server.frame import Chunk, Frame
from edge_server.misbehaviour import MAX_PUBLISHED
from edge_server.planner import (
    KEPT_PLANS,
    MAX_SITES,
    MAX_UPLINKS,
    Bandwidth,
    Planner,
    SensorSites,
)
from edge_server.role import _arrivals, _waits, _within_message
from perception.parallel import threads
from protocol import messages as m
from protocol.errors import MessageError
from protocol.in_process import InProcessRouter
from protocol.inbox import Inbox, Presence, RawMessage
from protocol.limits import MAX_FRAMES_AHEAD, MAX_INBOX_BYTES, MAX_INBOX_ITEMS, MAX_KEY_CHARS
from protocol.messages import MAX_ITEMS
from protocol.process import Context
from protocol.topics import TOPICS, BusName
from protocol.wire import encode
from recording.limits import (
    MAX_ENTRIES,
    MAX_PENDING_BYTES,
    MAX_PENDING_ROWS,
    MAX_REASONS,
    MAX_WIRED,
)
from recording.limits import MAX_OPEN_FRAMES as MAX_RECORDED_FRAMES
from recording.limits import MAX_PROCESSES as MAX_RECORDED
from recording.limits import MAX_PROGRESS_AGENTS as MAX_RATED
from recording.losses import DropCounts
from recording.role import RecordRole
from recording.tables import CloudRow
from sensing.limits import MAX_AGE_FRAMES, MAX_AHEAD_FRAMES
from sensing.uplink import PlanHistory
from sim_host.limits import MAX_PROCESSES as MAX_HOSTS
from sim_host.presence import Fleet, Readiness
from tests.messages import tracked
from tests.roads import MAIN_AND_SIDE, no_road

LONG = "x" * 120  # of an agent's id
KEY = "cpnet/v4/r0/roster/p"


class Growth:
    """How much more memory the process had at most than when this began."""

    def __enter__(self) -> Growth:
        forget_peak()
        self._before_kib = peak_kib()
        return self

    def __exit__(self, *_: object) -> None:
        self.mib = (peak_kib() - self._before_kib) / 1024


def pose(agent: str, frame: int = 0) -> m.AgentPose:
    return m.AgentPose(
        frame=frame,
        sim_time_ns=frame,
        agent=agent,
        equipment=m.Equipment.CAV,
        pose=np.zeros(6),
        length_m=4.5,
        width_m=1.8,
        height_m=1.5,
        position_std_m=0.05,
    )


def objects(agent: str, boxes: int, frame: int = 0) -> m.Objects:
    return m.Objects(
        frame=frame,
        sim_time_ns=frame,
        agent=agent,
        boxes=np.ones((boxes, 7), np.float32),
        scores=np.ones(boxes, np.float32),
        classes=np.zeros(boxes, np.uint8),
        sense_start_ns=1,
        sense_end_ns=1,
        detect_end_ns=1,
    )


def chunk(agent: str, frame: int = 0) -> Chunk:
    points = np.zeros((0, 3), np.float32)
    late_ns = 1 << 60
    spans = tuple(
        m.Span(stage=stage, agent=agent, start_ns=late_ns, end_ns=late_ns)
        for stage in ("decode", "place")
    )
    return Chunk(frame, frame, agent, 0, 1, np.zeros(6), points, late_ns, returns=1, spans=spans)


def metrics(process: str, frame: int, spans: int, agents: int = 0) -> m.Metrics:
    span = m.Span(stage="s", start_ns=1, end_ns=2)
    uploads = [
        m.Upload(
            agent=f"{n}", region="r0", chunk=0, points=1, payload_bytes=1, sense_start_ns=1,
            sense_end_ns=1, encode_end_ns=1, sent_ns=1,
        )
        for n in range(agents)
    ]  # fmt: skip
    wire = [m.WireCount(agent=f"{n}", frame=frame, sent_bytes=1) for n in range(agents)]
    return m.Metrics(
        process=process,
        frame=frame,
        sim_time_ns=frame,
        spans=[span] * spans,
        uploads=uploads,
        wire=wire,
        drops={f"reason {n}": 1 for n in range(200)},
    )


def test_an_inbox_holds_no_more_than_its_bytes():
    inbox = Inbox()
    with Growth() as growth:
        for _ in range(6000):
            inbox.put(RawMessage(TOPICS["roster"], KEY, bytes(1 << 17), 0))
    assert inbox._queue.qsize() == MAX_INBOX_BYTES >> 17
    assert growth.mib < (MAX_INBOX_BYTES >> 20) + 8


def test_an_inbox_holds_no_more_than_its_messages_whatever_their_keys():
    inbox = Inbox()
    inbox.limit("roster", 4)
    with Growth() as growth:
        for number in range(3 * MAX_INBOX_ITEMS):
            key = f"{KEY}{number:01000}"
            inbox.put(RawMessage(TOPICS["roster"], key, b"", 0))
            inbox.put(Presence("edge", f"{number:0100}", alive=True))
            inbox.put(RawMessage(TOPICS["roster"], key * 9, b"", 0))
        assert inbox._queue.qsize() == MAX_INBOX_ITEMS
        assert len(inbox._waiting) <= MAX_INBOX_ITEMS
        while inbox._queue.qsize():
            inbox.get()
    assert len(inbox._complaints._logged) == 1
    assert len(inbox.drops) < 8
    assert growth.mib < MAX_INBOX_ITEMS * MAX_KEY_CHARS >> 20


def stuffed_frames(assembler: Assembler) -> None:
    for frame in range(2 * MAX_OPEN_FRAMES):
        for process in range(40):
            agents = [f"{process}-{n}" for n in range(MAX_ITEMS)]
            assembler.add_roster(
                m.Roster(frame=frame, process=f"{process}", agents=[], scanning=agents), 5
            )
        for n in range(3000):
            assembler.add_pose(pose(f"{n}{LONG}", frame), 5)
            assembler.add_chunk(chunk(f"{n}{LONG}", frame))
        for n in range(30):
            assembler.add_objects(objects(f"{n}{LONG}", MAX_ITEMS // 8, frame), 5)


def test_an_edge_gathers_no_more_than_a_few_frames_of_so_many_agents():
    assembler = Assembler(wait_ns=1, expected={"vehicle-0": "vehicle"})
    with Growth() as growth:
        for number in range(5000):
            assembler.hear(f"{number}", "vehicle", alive=True)
        stuffed_frames(assembler)
    assert len(assembler._alive) <= MAX_PROCESSES + 1
    assert len(assembler._roles) <= MAX_PROCESSES + 1
    assert assembler.drops["too_many_processes"] == 5000 - MAX_PROCESSES
    assert len(assembler._open) <= MAX_OPEN_FRAMES
    for part in assembler._open.values():
        named = sum(len({*r.agents, *r.scanning}) for r in part.rosters.values())
        assert named <= MAX_AGENTS
        assert len(part.poses) <= MAX_AGENTS
        assert len(part.chunks) <= MAX_CHUNKS
        assert sum(len(one.objects.boxes) for one in part.found.values()) <= MAX_BOXES
    assert growth.mib < 128


def test_processes_that_come_and_go_leave_nothing_behind():
    assembler = Assembler(wait_ns=1, expected={"vehicle-0": "vehicle"})
    for number in range(5000):
        for alive in (True, False):
            assembler.hear(f"{number}", "vehicle", alive=alive)
    assert (len(assembler._roles), len(assembler._alive)) == (1, 0)


def test_what_is_said_of_the_fullest_frame_fits_into_its_messages():
    part = FrameAssembly(0, Assembler(wait_ns=1, expected={}).drops)
    for n in range(4000):
        part.add_chunk(chunk(f"{n}{LONG}"))
        part.add_pose(pose(f"p{n}{LONG}"))
    names = part.named()
    assert len(names) == MAX_AGENTS
    frame = Frame(0, 0, names, [], [*part.chunks.values()], complete=True, first_ns=0, ready_ns=1)
    cut = _within_message(frame)
    spans, arrivals = _waits(cut), _arrivals(cut)
    scores = [
        m.AgentScore(agent=name, score=0.1, trusted=False, motion=1, place=1, ground=1)
        for name in names[:MAX_PUBLISHED]
    ]
    published = m.Metrics(
        process="edge", frame=0, sim_time_ns=0, spans=spans, arrivals=arrivals, scores=scores
    )
    assert len(encode(published)) > 1 << 16
    assert 300 < len(cut.chunks) < len(frame.chunks)
    few = Frame(0, 0, names, [], frame.chunks[:200], complete=True, first_ns=0, ready_ns=1)
    assert _within_message(few).chunks == few.chunks
    lidar, own = ["lidar"] * MAX_BOXES, names
    found = m.Detections(
        frame=0,
        sim_time_ns=0,
        agents=names,
        boxes=np.zeros((len(lidar + own), 7), np.float32),
        scores=np.zeros(len(lidar + own), np.float32),
        classes=np.zeros(len(lidar + own), np.uint8),
        lanes=["approach_of_the_east_0"] * len(lidar + own),
        distances_m=np.zeros(len(lidar + own), np.float32),
        sources=lidar + own,
        **tracked(len(lidar + own)),
    )
    assert len(encode(found)) > 1 << 17


def test_an_edge_opens_no_more_scans_than_its_threads_need():
    gate = threading.Event()

    def open_scan(scan: m.Scan, received_ns: int) -> Chunk:
        gate.wait(10)
        return chunk(scan.agent)

    pool = DecoderPool(open_scan)
    scan = m.Scan(
        frame=0, sim_time_ns=0, agent="a", chunk=0, chunks=1, points=0, sensor_pose=np.zeros(6),
        sense_start_ns=1, sense_end_ns=1, encode_end_ns=1, payload=np.zeros(9, np.uint8),
    )  # fmt: skip
    try:
        for _ in range(PER_THREAD * threads()):
            pool.put(scan, 1)
        gate.set()
        for _ in range(100):
            pool.put(scan, 1)
        assert len(pool) <= PER_THREAD * threads()
    finally:
        gate.set()
        pool.close()


def test_an_edge_remembers_no_more_agents_than_it_serves():
    sites, bandwidth = SensorSites(), Bandwidth()
    for n in range(3000):
        sites.add(pose(f"{n}"))
        bandwidth.add(f"{n}", 1, 100_000, sent_ns=1, received_ns=2)
    assert len(sites._sites) == MAX_SITES
    assert len(bandwidth._histories) == MAX_UPLINKS


def test_an_edge_aligns_so_many_agents_to_a_scene_of_so_many_voxels(monkeypatch):
    align = Align([])
    for n in range(2 * MOST_AGENTS):
        align._remember(f"{n}", n)
    assert len(align._known) == MOST_AGENTS
    monkeypatch.setattr(static_map, "MOST_VOXELS", 5000)
    scene, rng = static_map.StaticMap(), np.random.default_rng(1)
    for _ in range(20):
        scene.add(rng.uniform(-500, 500, (1000, 3)))
    assert 5000 <= len(scene._keys) < 5000 + 1000  # the scan that fills it is added whole


def test_an_edge_keeps_the_borders_of_a_few_plans():
    scenario = {
        "mode": "realtime",
        "upload": {"policy": "reap"},
        "link": {"profile": "5mbit,20ms"},
    }
    planner = Planner(scenario, PlanConfig(), MAIN_AND_SIDE)
    assert planner.ends_early
    for frame in range(500):
        planner.plans(Frame(frame, frame, ["a"], [], [], complete=True, first_ns=0, ready_ns=1))
        assert len(planner._borders) <= KEPT_PLANS


def test_an_agent_keeps_the_plans_of_a_few_frames():
    plans = PlanHistory()
    for frame in range(500):
        plans.receive(
            m.Plan(
                frame=frame,
                agent="a",
                mbps=1,
                enough=-1,
                agents=[f"{n}" for n in range(MAX_ITEMS)],
                sites=np.zeros((MAX_ITEMS, 2)),
                weights_m2=np.zeros((MAX_ITEMS, 3)),
            ),
            frame=frame // 2,
            arrival_sim_ns=0,
        )
        assert len(plans._received) <= MAX_AGE_FRAMES + MAX_AHEAD_FRAMES + 1


def test_the_world_counts_the_processes_it_expects_and_a_few_more():
    readiness, fleet = Readiness(["edge", "record"], 60), Fleet()
    for n in range(5000):
        readiness.note(Presence("vehicle", f"{n}", alive=True, bus=BusName.WORLD))
        fleet.join(f"{n}")
    readiness.note(Presence("edge", "edge", alive=True, bus=BusName.WORLD))
    assert len(readiness._here) == 1
    assert len(fleet.processes) == MAX_HOSTS


def test_whoever_watches_remembers_so_many_processes():
    presence_table = PresenceTable([("edge", "edge")])
    for n in range(5000):
        presence_table.update(Presence("vehicle", f"{n}", alive=True))
        presence_table.update(Presence("vehicle", f"{n}", alive=bool(n % 2)))
    assert len(presence_table.present | presence_table.left) == MAX_UNEXPECTED


@pytest.fixture
def recorder(tmp_path: Path) -> RecordRole:
    setup = m.Setup(
        scenario={"name": "t", "frame_period_s": 0.1, "regions": {"r0": ["t"]}},
        road_map=no_road(),
        vehicle_types=[],
        meshes=[],
        mesh_vertices=np.zeros((0, 3), np.float32),
        mesh_triangles=np.zeros((0, 3), np.int32),
    )
    bus = InProcessRouter(BusName.WORLD).bus(Inbox())
    context = Context("record", setup, tmp_path, bus, bus, Inbox(), threading.Event(), lambda: bus)
    return RecordRole(context)


def test_a_recorder_keeps_so_much_of_each_frame_and_writes_the_rest(recorder: RecordRole):
    try:
        with Growth() as growth:
            for n in range(1500):
                message = metrics(f"{n}", n % 8, spans=100, agents=0)
                try:
                    recorder._on_metrics(message, 1)
                except MessageError:
                    recorder._drops = DropCounts()
                if recorder._database.is_full:
                    recorder._database.commit()
                assert recorder._database.pending_rows <= MAX_PENDING_ROWS + 100
        notes = recorder._aggregator._notes.values()
        assert max(note.entries for note in notes) <= MAX_ENTRIES
        assert len(notes) <= 2 * MAX_RECORDED_FRAMES + 1
        assert growth.mib < 128
    finally:
        recorder.close()


def test_a_recorders_scans_are_to_be_written_once_they_take_so_much_memory(recorder: RecordRole):
    try:
        database, added = recorder._database, 0
        while not database.is_full and added <= MAX_PENDING_BYTES:
            payload = bytes(1 << 20)
            database.add(CloudRow, [CloudRow(0, "r0", f"{added}", 0, 1, *[0.0] * 6, payload)])
            added += len(payload)
        assert MAX_PENDING_BYTES < added <= MAX_PENDING_BYTES + (1 << 20)
        database.commit()
        assert not database.is_full
    finally:
        recorder.close()


def test_a_recorder_knows_so_many_processes_and_agents(recorder: RecordRole):
    try:
        for n in range(2 * MAX_RECORDED):
            reading = m.ClockReading(process=f"{n}", offset_ns=0, error_ns=0)
            for take, message in (
                (recorder._on_clock, reading),
                (recorder._on_metrics, metrics(f"{n}", n % MAX_RECORDED_FRAMES, spans=1)),
            ):
                known = recorder._clocks if take == recorder._on_clock else recorder._drops._counts
                if len(known) < MAX_RECORDED:
                    take(message, 1)
                else:
                    with pytest.raises(MessageError, match="one process more"):
                        take(message, 1)
        recorder._on_metrics(metrics("0", 1, spans=0, agents=3000), 1)
        known = recorder._drops._counts
        assert len(recorder._clocks) == len(known) == MAX_RECORDED
        assert max(len(counts.total) for counts in known.values()) == MAX_REASONS
        assert len(recorder._progress.payload_bytes) == MAX_RATED
        assert len(recorder._aggregator.note(1).wire) == MAX_WIRED
        assert len(encode(recorder._progress.report(1, 0))) < m.Progress.max_header_bytes
    finally:
        recorder.close()


def test_absurd_frames_open_nothing():
    assembler = Assembler(wait_ns=1, expected={})
    assembler.add_pose(pose("a", 0), 5)
    for frame in range(MAX_FRAMES_AHEAD + 1, 5000):
        assembler.add_pose(pose("a", frame), 5)
    assert list(assembler._open) == [0]
