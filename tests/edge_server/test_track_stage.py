"""The stage that tracks: when it begins, ids of the city, what it counts, what sensors saw."""

import numpy as np
import pytest

from edge_server.frame import Chunk, Frame, FrameState
from edge_server.tracking import FRAME_BIT, ShownSignals, Track
from perception.detector import Vehicles
from perception.roadway import Placed
from perception.tracking.config import TrackingConfig
from perception.tracking.life_cycle import UNKNOWN_MPS
from protocol.messages import AgentPose, Equipment, SignalState
from protocol.roadmap import RoadMap
from recording.foreign_scans.ground import Ground
from recording.foreign_scans.importer import open_ground

S = 1_000_000_000


@pytest.fixture
def stage(road_map: RoadMap) -> Track:
    return Track(road_map, TrackingConfig())


def run(
    stage: Track,
    number: int,
    *x_m: float,
    agents: tuple[str, ...] = ("a",),
    poses=(),
    distrusted=(),
):
    time_ns = number * S // 10
    frame = Frame(number, time_ns, [*agents], [*poses], [], complete=True, first_ns=0, ready_ns=0)
    state = FrameState(frame, distrusted=set(distrusted))
    boxes = np.array([(x, -1.75, 0.75, 4.5, 1.8, 1.5, 0.0) for x in x_m]).reshape(-1, 7)
    state.fused = Vehicles.from_lidar(boxes, np.full(len(boxes), 0.9))
    stage.run(state)
    return state


def test_ids_bear_the_frame_in_which_the_edge_began_so_that_a_restart_gives_others(road_map):
    ids = []
    for start in (3, 90):
        edge = Track(road_map, TrackingConfig())
        run(edge, 0, agents=())  # the warm-up
        ids += run(edge, start, -50.0, -30.0).tracks.track_ids.tolist()
    assert ids == [(3 << FRAME_BIT) + 1, (3 << FRAME_BIT) + 2, (90 << FRAME_BIT) + 1,
                   (90 << FRAME_BIT) + 2]  # fmt: skip


def test_time_that_runs_backwards_is_counted_and_begins_anew(stage):
    for number in range(5, 10):
        run(stage, number, -50.0)
    state = run(stage, 1, -50.0)
    assert state.drops["time_backwards"] == 1
    assert state.tracks.track_ids.tolist() == [(5 << FRAME_BIT) + 2]
    assert run(stage, 2, -50.0).drops["time_backwards"] == 0


def test_more_detections_than_are_tracked_are_counted(stage):
    most = TrackingConfig().max_tracks
    places = np.linspace(-5000, 5000, most + 10)
    assert run(stage, 0, *places).drops["untracked"] == 10


def test_on_an_open_ground_nothing_is_known_of_the_speed_of_who_was_seen_once():
    level = Ground(np.zeros((1, 2)), np.zeros((1, 3)), fit=1.0, slope_deg=0.0)
    ground = open_ground({"way": np.zeros((1, 6))}, level, width_m=40)
    stage = Track(ground, TrackingConfig())
    tracks = run(stage, 0, -50.0).tracks
    assert tracks.speeds_mps.tolist() == [0.0]
    assert tracks.speed_std_mps.tolist() == [UNKNOWN_MPS]


def test_without_tracking_each_frame_stands_for_itself(road_map):
    off = TrackingConfig(enabled=False)
    stage = Track(road_map, off)
    run(stage, 0, -50.0)
    tracks = run(stage, 1, -50.0, -30.0).tracks
    assert (tracks.track_ids.tolist(), tracks.coasted_s.tolist()) == ([0, 0], [0, 0])


@pytest.mark.parametrize("is_plain", [True, False])
def test_a_scan_that_shows_the_ground_before_a_place_says_that_it_is_empty(stage, is_plain):
    for number in range(5):
        run(stage, number, -50.0)
    ground = [(-54.0, y, 0.0) for y in np.arange(-4, 2, 0.25)] if is_plain else []
    empty = np.zeros((0, 3), np.float32)
    lowest = np.array([(-69.0, 0.0, 0.0), *ground], np.float32)
    placed = Placed(empty, empty[:, 0], lowest)
    scan = Chunk(5, 0, "a", 0, 1, np.array([-70.0, -1.75, 2.5, 0, 0, 0]), empty, 0, placed=placed)
    state = FrameState(Frame(5, S // 2, ["a"], [], [scan], complete=True, first_ns=0, ready_ns=0))
    state.fused = Vehicles.from_lidar(np.zeros((0, 7)), np.zeros(0))
    stage.run(state)
    assert len(state.tracks) == (0 if is_plain else 1)


def test_what_an_agent_showed_ends_in_the_frame_that_excludes_it(stage):
    pose = AgentPose(
        frame=0, sim_time_ns=0, agent="a", pose=np.array([-60.0, 0, 0, 0, 0, 0]),
        position_std_m=0.1, equipment=Equipment.NONE, length_m=4.5, width_m=1.8, height_m=1.5,
    )  # fmt: skip
    for number in range(10):
        run(stage, number, -50.0, poses=[pose])
    assert len(run(stage, 10, poses=[pose]).tracks) == 1
    assert len(run(stage, 11, distrusted={"a"}).tracks) == 0


def test_a_signal_shows_what_its_newest_state_before_the_frame_says():
    signals = ShownSignals()
    for frame, state in [(5, "G"), (7, "r"), (6, "y"), (1, "G")]:
        signals.note(
            SignalState(
                frame=frame, sim_time_ns=frame * S, tls="J", state=state, stage="", green="",
                source="", earliest_change_ns=0,
            )
        )  # fmt: skip
    assert [signals.before(frame).get("J") for frame in (5, 6, 7, 8, 10, 11)] == [
        None, "G", "y", "r", "r", None,
    ]  # fmt: skip
    for frame in range(1000):
        signals.note(
            SignalState(
                frame=frame, sim_time_ns=frame * S, tls="J", state="r", stage="", green="",
                source="", earliest_change_ns=0,
            )
        )  # fmt: skip
    assert len(signals._states["J"]) <= 16
