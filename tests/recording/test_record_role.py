"""The record role, with messages published as the other processes would."""

import json
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from protocol import messages as m
from protocol.errors import ConfigError, CpnetError
from protocol.in_process import InProcessRouter
from protocol.inbox import Inbox
from protocol.process import Context
from protocol.topics import BusName
from recording.limits import MAX_OPEN_FRAMES
from recording.role import RecordRole
from recording.run import Run
from recording.tables import (
    CloudRow,
    CountRow,
    DetectionRow,
    DropRow,
    FrameRow,
    PhaseRow,
    RequestRow,
    StageRow,
    TripRow,
    TruthRow,
    UploadRow,
)
from tests.messages import tick_of, tracked
from tests.roads import no_road
from tests.waiting import wait_until

PERIOD_NS = 100_000_000
MS = 1_000_000


def setup_message(**record: object) -> m.Setup:
    return m.Setup(
        scenario={
            "name": "t",
            "frame_period_s": 0.1,
            "record": record,
            "regions": {"r0": ["t"]},
        },
        road_map=no_road(),
        vehicle_types=[],
        meshes=[],
        mesh_vertices=np.zeros((0, 3), np.float32),
        mesh_triangles=np.zeros((0, 3), np.int32),
    )


class Rig:
    """A record role on in-process buses, and the publishers of other processes."""

    def __init__(self, run_dir: Path, **record: object) -> None:
        world, v2x = InProcessRouter(BusName.WORLD), InProcessRouter()
        self.inbox, self.seen = Inbox(), Inbox()
        self.stop = threading.Event()
        self.world, self.v2x = world.bus(self.seen), v2x.bus(self.seen)
        self.world.watch()
        self.world.subscribe("progress")
        setup = setup_message(**record)
        context = Context(
            "record", setup, run_dir, world.bus(self.inbox), v2x.bus(self.inbox),
            self.inbox, self.stop, lambda: v2x.bus(self.inbox),
        )  # fmt: skip
        self.role = RecordRole.build(context)

    def drain(self) -> None:
        while (item := self.inbox.get()) is not None:
            self.role.on(item)
            self.role.poll()

    def frame(self, frame: int, agents: tuple[str, ...] = ("rsu-0",)) -> None:
        """Publishes all of one frame; sensing begins at 1 ms, the cabinet has acted at 81 ms."""
        sim_time_ns, start = frame * PERIOD_NS, frame * PERIOD_NS
        ids, poses = ["car-0", "car-1"], np.arange(12.0).reshape(2, 6) + frame
        common = {"frame": frame, "sim_time_ns": sim_time_ns}
        bodies = {"ids": ids, "types": ["car", "bus"], "poses": poses, "speeds_mps": np.ones(2)}
        equipment = np.array([1, 2], np.uint8)
        tick = tick_of(
            **common, bodies=2, agents=ids, equipment=equipment, hosts=np.array([-1, -1]),
            places=poses[:, :2],
        )  # fmt: skip
        self.world.publish("tick", tick)
        uploads, arrivals = [], []
        for agent in agents:
            scan = m.Scan(
                **common, agent=agent, chunk=0, chunks=1, points=7, sensor_pose=np.arange(6.0),
                sense_start_ns=0, sense_end_ns=0, encode_end_ns=0,
                payload=np.frombuffer(b"payload", np.uint8),
            )  # fmt: skip
            self.v2x.publish("scan", scan, region="r0", process="v", agent=agent, chunk="0")
            uploads.append(
                m.Upload(
                    agent=agent, region="r0", chunk=0, points=7, payload_bytes=1000,
                    sense_start_ns=start + MS, sense_end_ns=start + 9 * MS,
                    encode_end_ns=start + 10 * MS, sent_ns=start + 11 * MS,
                )
            )  # fmt: skip
            arrivals.append(
                m.Arrival(
                    agent=agent, chunk=0, received_ns=start + 12 * MS, decoded_ns=start + 13 * MS
                )
            )
        self.metrics("infra-r0", frame, uploads=uploads)
        self.metrics("edge-r0", frame, arrivals=arrivals, points=7, drops={"late": frame})
        self.metrics("signal-r0", frame)
        act = m.Span(stage="actuate", agent="t", start_ns=start + 80 * MS, end_ns=start + 81 * MS)
        detections = m.Detections(
            **common, agents=list(agents), boxes=np.ones((2, 7)), scores=np.ones(2),
            classes=np.zeros(2, np.uint8),
            lanes=["a_0", ""], distances_m=np.zeros(2), sources=["lidar", "lidar"],
            **tracked(2),
        )  # fmt: skip
        self.v2x.publish("detections", detections, region="r0")
        counts = m.LaneCounts(
            **common, tls="t", agents=list(agents), complete=True,
            upstream={"a_0": 2}, downstream={"b_0": 1},
        )  # fmt: skip
        self.v2x.publish("lanes", counts, region="r0", tls="t")
        request = m.SignalRequest(**common, tls="t", state="Gr", policy="max", pressures=[1.0, 2.0])
        self.v2x.publish("request", request, tls="t")
        self.metrics("sim", frame, spans=[act])
        state = m.SignalState(
            **common, tls="t", state="Gr", stage="green", green="Gr", source="request",
            earliest_change_ns=0,
        )  # fmt: skip
        self.v2x.publish("state", state, tls="t")
        truth = m.Truth(
            **common, **bodies, lanes=["a_0", "b_0"], lane_positions_m=np.ones(2),
            equipment=equipment,
        )  # fmt: skip
        self.world.publish("truth", truth)

    def metrics(self, process: str, frame: int, **fields: object) -> None:
        metrics = m.Metrics(process=process, frame=frame, sim_time_ns=frame * PERIOD_NS, **fields)
        self.world.publish("metrics", metrics, process=process)


@pytest.fixture
def rig(tmp_path: Path) -> Rig:
    return Rig(tmp_path, snapshot_period_s=0.2)


def test_the_role_announces_itself_once_it_listens(rig: Rig) -> None:
    presence = rig.seen.get()
    assert (presence.role, presence.id, presence.alive) == ("record", "record", True)


def test_every_table_holds_what_was_said(rig: Rig, tmp_path: Path) -> None:
    for frame in range(3):
        rig.frame(frame)
    trips = [
        m.Trip(vehicle="car-0", equipment=1, depart_s=0.0, arrive_s=9.0, time_loss_s=2.5),
        m.Trip(vehicle="car-1", equipment=0, depart_s=1.0, arrive_s=None, time_loss_s=1.5),
    ]
    rig.world.publish("trips", m.Trips(frame=2, trips=trips))
    rig.drain()
    rig.role.close()
    with Run(tmp_path) as run:
        assert [r.frame for r in run.rows(FrameRow)] == [0, 1, 2]
        row = list(run.rows(FrameRow))[2]
        assert (row.vehicles, row.cavs, row.cvs, row.agents) == (2, 1, 1, 1)
        assert (row.points, row.detections, row.complete) == (7, 2, 1)
        assert row.end_to_end_ns == 80 * MS
        assert row.tick_ns <= row.request_ns
        upload = list(run.rows(UploadRow))[1]
        assert (upload.frame, upload.agent, upload.payload_bytes) == (1, "rsu-0", 1000)
        assert upload.received_ns - upload.sent_ns == MS
        assert len(list(run.rows(DetectionRow))) == 6
        assert list(run.rows(CountRow))[:2] == [
            (0, "t", "a_0", "upstream", 2, 0, 0),
            (0, "t", "b_0", "downstream", 1, 0, 0),
        ]
        assert [r.state for r in run.rows(PhaseRow)] == ["Gr"] * 3
        assert json.loads(next(run.rows(RequestRow)).pressures) == [1.0, 2.0]
        assert [(r.process, r.stage, r.duration_ns) for r in run.rows(StageRow)] == [
            ("sim", "actuate", MS)
        ] * 3
        truth = list(run.rows(TruthRow))[3]
        assert (truth.frame, truth.vehicle, truth.type, truth.equipment) == (1, "car-1", "bus", 2)
        assert (truth.x_m, truth.yaw_rad, truth.lane) == (7.0, 12.0, "b_0")
        assert [r.arrive_s for r in run.rows(TripRow)] == [9.0, None]
        assert list(run.rows(DropRow)) == [("edge-r0", "late", 2)]
        assert run.scenario["name"] == "t"


def test_only_snapshot_frames_keep_their_uploads(rig: Rig, tmp_path: Path) -> None:
    for frame in range(5):
        rig.frame(frame, agents=("car-0", "rsu-0"))
    rig.drain()
    rig.role.close()
    with Run(tmp_path) as run:
        kept = [(c.frame, c.agent, c.payload) for c in run.rows(CloudRow)]
        assert kept == [(f, a, b"payload") for f in (0, 2, 4) for a in ("car-0", "rsu-0")]
        assert run.of_frame(CloudRow, 2)[0].sensor_yaw_rad == 5.0


def test_truth_and_snapshots_can_be_left_out(tmp_path: Path) -> None:
    rig = Rig(tmp_path, snapshot_period_s=0, truth=False)
    rig.frame(0)
    rig.drain()
    rig.role.close()
    with Run(tmp_path) as run:
        assert not list(run.rows(TruthRow))
        assert not list(run.rows(CloudRow))
        assert len(list(run.rows(DetectionRow))) == 2


def test_contradictory_messages_are_counted_and_dropped(rig: Rig, tmp_path: Path) -> None:
    crooked = m.Detections.model_construct(
        frame=0, sim_time_ns=0, agents=[], boxes=np.ones((2, 7), np.float32),
        scores=np.ones(1, np.float32), classes=np.zeros(1, np.uint8),
        lanes=[], distances_m=np.zeros(0, np.float32), sources=[], **tracked(2),
    )  # fmt: skip
    rig.v2x.publish("detections", crooked, region="r0")
    rig.metrics("edge-r0", 1 << 35)
    rig.world.publish("trips", m.Trips(frame=0, trips=[
        m.Trip.model_construct(
            vehicle="x", equipment=m.Equipment.NONE, depart_s=0.0, arrive_s=None,
            time_loss_s=float("nan"),
        ),
        m.Trip(vehicle="y", equipment=0, depart_s=0, arrive_s=None, time_loss_s=1.0),
    ]))  # fmt: skip
    rig.world.publish("trips", m.Trips(frame=0, trips=[
        m.Trip(vehicle="y", equipment=0, depart_s=0, arrive_s=None, time_loss_s=1.0),
    ]))  # fmt: skip
    for _ in range(3):  # an undecodable message looks like the end of the queue
        rig.drain()
    rig.role.poll()
    rig.role._commit(time.monotonic_ns())
    rig.role.close()
    with Run(tmp_path) as run:
        drops = {r.reason: r.times for r in run.rows(DropRow)}
        assert drops == {"MessageError": 3}
        assert [r.vehicle for r in run.rows(TripRow)] == ["y"]


def test_the_role_stops_soon_after_the_end_once_the_last_frame_is_whole(rig: Rig) -> None:
    rig.frame(0)
    before_ns = time.monotonic_ns()
    rig.world.publish("end", m.End(frames=1, reason="finished"))
    rig.drain()
    after_ns = time.monotonic_ns()
    assert not rig.role._ending.is_over(before_ns + 100 * MS, rig.role._aggregator)
    assert rig.role._ending.is_over(after_ns + 250 * MS, rig.role._aggregator)
    wait_until(lambda: rig.role.poll() or rig.stop.is_set())
    rig.role.close()


def test_the_role_waits_no_longer_than_its_patience_for_a_silent_edge(rig: Rig) -> None:
    rig.metrics("signal-r0", 0)
    rig.world.publish("end", m.End(frames=1, reason="finished"))
    rig.drain()
    assert not rig.role._ending.is_over(time.monotonic_ns() + 9_500 * MS, rig.role._aggregator)
    assert rig.role._ending.is_over(time.monotonic_ns() + 10_000 * MS, rig.role._aggregator)
    rig.role.close()


def test_after_a_world_that_stopped_early_the_last_frame_is_not_waited_for(rig: Rig) -> None:
    rig.metrics("signal-r0", 0)
    rig.world.publish("end", m.End(frames=1, reason="stopped"))
    rig.drain()
    assert rig.role._ending.is_over(time.monotonic_ns() + 200 * MS, rig.role._aggregator)
    rig.role.close()


def test_progress_is_told_about_once_a_second(rig: Rig) -> None:
    rig.seen.get()
    rig.role._told_ns = time.monotonic_ns() + 600_000 * MS  # not before all is received
    for frame in range(11):
        rig.frame(frame)
    rig.drain()
    assert rig.seen.get() is None
    rig.role._told_ns = time.monotonic_ns() - 1_000 * MS
    rig.role.poll()
    progress = rig.seen.get().message
    rig.role._told_ns = time.monotonic_ns()
    rig.role.poll()
    assert rig.seen.get() is None
    assert (progress.frame, progress.vehicles, progress.cavs, progress.cvs) == (10, 2, 1, 1)
    assert (progress.detections, progress.state, progress.drops) == (2, "Gr", 10)
    assert progress.end_to_end_ms == pytest.approx(80.0)
    assert progress.mbps == {"rsu-0": pytest.approx(1000 * 8e-6 / 0.1)}
    assert progress.real_time_factor > 0
    rig.role.close()


def test_a_flood_of_strangers_costs_who_is_present_nothing(rig: Rig) -> None:
    rig.world.announce("edge", "edge-r0")
    for _ in range(6_000):
        rig.metrics("stranger", 0)
    assert rig.inbox.drops["rate_limited"] > 0
    before = rig.inbox.drops.total()
    rig.metrics("edge-r0", 0)
    assert rig.inbox.drops.total() == before
    rig.role.close()


def test_an_absurd_tick_is_counted_and_changes_nothing(rig: Rig, tmp_path: Path) -> None:
    rig.frame(0)
    for frame, sim_time_ns in ((1 << 39, PERIOD_NS), (1, 1 << 61)):
        tick = tick_of(frame, sim_time_ns)
        rig.world.publish("tick", tick)
    rig.frame(1)
    rig.drain()
    rig.role.close()
    assert rig.inbox.drops == {"MessageError": 2}
    with Run(tmp_path) as run:
        assert [(row.frame, row.sim_time_ns) for row in run.rows(FrameRow)] == [
            (0, 0),
            (1, PERIOD_NS),
        ]


def test_memory_holds_a_bounded_number_of_frames(rig: Rig, tmp_path: Path) -> None:
    frames = MAX_OPEN_FRAMES * 2
    for frame in range(frames):
        rig.metrics("infra-r0", max(frame - 1, 0))
        tick = tick_of(frame, frame * PERIOD_NS)
        rig.world.publish("tick", tick)
        rig.drain()
    rig.role._commit(time.monotonic_ns())
    assert len(rig.role._aggregator) <= MAX_OPEN_FRAMES + 1
    rig.role.close()
    with Run(tmp_path) as run:
        assert len(list(run.rows(FrameRow))) == frames


def test_a_folder_takes_one_recording_only(rig: Rig, tmp_path: Path) -> None:
    rig.role.close()
    with pytest.raises(ConfigError, match="exists"):
        Rig(tmp_path)


def test_nothing_is_told_before_the_first_tick(rig: Rig) -> None:
    rig.seen.get()
    rig.role._told_ns -= 1_000 * MS
    rig.role.poll()
    assert rig.seen.get() is None
    rig.role.close()


def test_a_full_disk_ends_the_role_with_its_cause(rig: Rig) -> None:
    rig.role._database._connection.execute("PRAGMA max_page_count = 1")
    rig.frame(0)
    rig.drain()
    rig.role._database.add(CloudRow, [CloudRow(0, "r0", "a", 0, 0, *(0.0,) * 6, bytes(1 << 22))])
    with pytest.raises(CpnetError, match=r"run\.sqlite cannot be written: .*full"):
        rig.role._commit(time.monotonic_ns())
    rig.role.close()
    rig.role._database._connection.close()
