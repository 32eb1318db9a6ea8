"""Current state of junctions and regions while a run goes on."""

import pytest

from protocol import messages as m
from protocol import wire
from protocol.roadmap import RoadMap
from recording.limits import MAX_PROGRESS_AGENTS, MAX_PROGRESS_JUNCTIONS
from recording.observation import Observation
from recording.role import ProgressTracker
from tests.roads import CROSSING

MS = 1_000_000


def row_of_crossings(*junctions: str) -> RoadMap:
    """The same crossing under several names."""
    old = CROSSING.intersections[0]
    intersections = [
        old.model_copy(update={"signal": old.signal.model_copy(update={"tls": tls})})
        for tls in junctions
    ]
    return RoadMap(name="row", lanes=CROSSING.lanes, intersections=intersections)


def counts(frame: int, tls: str, *, complete: bool = True, **fields: object) -> m.LaneCounts:
    plain = {
        "frame": frame, "sim_time_ns": frame * 100 * MS, "tls": tls, "agents": ["a"],
        "complete": complete, "upstream": {"south_0": 4, "west_0": 2}, "downstream": {},
        "stationary_upstream": {"south_0": 3}, "coverage_upstream": {"south_0": 0.5, "west_0": 1},
    }  # fmt: skip
    return m.LaneCounts(**(plain | fields))


def state(time_ms: int, tls: str, shown: str, green: str) -> m.SignalState:
    return m.SignalState(
        frame=0, sim_time_ns=time_ms * MS, tls=tls, state=shown, stage="green", green=green,
        source="plan", earliest_change_ns=0,
    )  # fmt: skip


@pytest.fixture
def observed() -> Observation:
    road_map = row_of_crossings("J", "K", "L")
    return Observation(road_map, {"west": ["J", "K"], "east": ["L", "not on this part"]})


def test_messages_are_kept_with_their_junction(observed: Observation) -> None:
    observed.take(counts(1, "K"))
    for time_ms, shown, green in ((100, "Gr", "Gr"), (200, "yr", "Gr"), (400, "yr", "Gr")):
        observed.take(state(time_ms, "L", shown, green))
    junctions = observed.junctions
    assert (junctions["K"].vehicles, junctions["K"].queued, junctions["K"].coverage) == (6, 3, 0.75)
    assert (junctions["J"].vehicles, junctions["J"].coverage, junctions["J"].phase) == (
        0,
        None,
        None,
    )
    assert (junctions["L"].phase, junctions["L"].unchanged_s(500 * MS)) == (0, 0.3)
    observed.take(state(600, "L", "rr", "rr"))
    assert junctions["L"].phase is None


def test_a_frame_counts_once_for_its_region(observed: Observation) -> None:
    for tls in ("J", "K", "L"):
        observed.take(counts(1, tls, complete=tls == "L"))
    observed.take(counts(2, "J", agents=["a", "b"]))
    west, east = observed.regions["west"], observed.regions["east"]
    assert (west.frames, west.incomplete, west.agents) == (2, 1, 2)
    assert (east.frames, east.incomplete, east.agents) == (1, 0, 1)


def test_what_is_about_no_known_signal_is_ignored(observed: Observation) -> None:
    observed.take(counts(1, "elsewhere"))
    observed.take(counts(1, "not on this part"))
    assert [one.frames for one in observed.regions.values()] == [0, 0]


def test_progress_tells_of_regions_and_junctions(observed: Observation) -> None:
    tracker = ProgressTracker(100 * MS, observed)
    observed.take(counts(1, "K"))
    tracker.detected("west", 7)
    progress = tracker.report(0, 0)
    assert (progress.regions["west"].agents, progress.regions["west"].detections) == (1, 7)
    assert (progress.junctions["K"].region, progress.junctions["K"].queued) == ("west", 3)
    assert [*progress.junctions] == ["J", "K", "L"]


def test_progress_of_a_large_city_fits_into_its_message() -> None:
    names = [f"{n:04d}{'x' * 150}" for n in range(2 * MAX_PROGRESS_JUNCTIONS)]
    observed = Observation(row_of_crossings(*names), {"r0": names})
    for name in names:
        observed.take(counts(1, name))
    tracker = ProgressTracker(100 * MS, observed)
    for n in range(MAX_PROGRESS_AGENTS):
        tracker.payload_bytes[f"{n:032d}"] = 1000
    progress = tracker.report(0, 0)
    assert len(progress.junctions) == MAX_PROGRESS_JUNCTIONS
    assert wire.decode(wire.encode(progress), m.Progress) == progress
