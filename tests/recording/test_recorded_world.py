"""The world of a recording: times, bodies and journeys as they were recorded."""

import numpy as np
import pytest
from frame_messages import bodies, item, scan, state, tick

from protocol.errors import ConfigError
from protocol.messages import Trip, Trips, Truth
from recording.playback.frames import RecordedFrames
from recording.playback.world import RecordedWorld

pytest.importorskip("mcap", reason="needs the extra `mcap`")


STEP_NS = 50_000_000


def world_of(messages, warmup_ns: int = 0) -> RecordedWorld:
    return RecordedWorld(RecordedFrames(messages), step_ns=STEP_NS, steps=2, warmup_ns=warmup_ns)


def trips(frame: int, *names: str):
    ended = [
        Trip(vehicle=name, equipment=0, depart_s=0.0, arrive_s=1.0, time_loss_s=0.0)
        for name in names
    ]
    return item("trips", Trips(frame=frame, trips=ended))


def truth(frame: int, *names: str):
    count = len(names)
    message = Truth(
        frame=frame,
        sim_time_ns=frame * 2 * STEP_NS,
        ids=[*names],
        types=["car"] * count,
        lanes=["lane"] * count,
        poses=np.ones((count, 6)),
        speeds_mps=np.ones(count, np.float32),
        lane_positions_m=np.ones(count, np.float32),
        equipment=np.zeros(count, np.uint8),
    )
    return item("truth", message)


@pytest.mark.parametrize("warmup_ns", [0, 20 * STEP_NS, 20 * STEP_NS - 1])
def test_the_warm_up_ends_at_the_first_frames_time(warmup_ns):
    first_ns = 30_000_000_000
    world = world_of([state(7, first_ns), state(8, first_ns + 2 * STEP_NS)], warmup_ns)
    assert world.first_frame == 7
    until_ns = world.time_ns + warmup_ns
    while world.time_ns < until_ns:
        world.step()
    assert world.time_ns == first_ns
    world.step()
    assert world.time_ns == first_ns + STEP_NS
    world.step()
    assert world.time_ns == first_ns + 2 * STEP_NS


def test_frames_have_the_times_that_they_had_and_those_that_are_missing_the_period():
    world = world_of([tick(0, 5), tick(1, 5 + 2 * STEP_NS + 3), tick(3, 900_000_000)])
    times = []
    for _ in range(4):
        times.append(world.time_ns)
        world.step()
        world.step()
    assert times == [5, 5 + 2 * STEP_NS + 3, 5 + 4 * STEP_NS + 3, 900_000_000]


def test_bodies_are_those_of_the_truth_else_of_the_tiles_else_those_before():
    there, beside = (0, 0), (1, 0)
    first = [bodies(0, there, "d", "b"), bodies(0, beside, "c"), truth(0, "a", "b")]
    second = [bodies(1, beside, "a"), tick(1, tiles=(there, beside)), tick(2, tiles=(there,))]
    world = world_of([*first, tick(0, tiles=(there, beside)), *second, state(3)])
    seen = []
    for _ in range(4):
        now = world.bodies()
        seen.append((now.ids, now.lanes))
        world.step()
        world.step()
    last = (["b", "d"], [""] * 2)
    assert seen == [(["a", "b"], ["lane", "lane"]), (["a", "b", "d"], [""] * 3), last, last]


def test_journeys_end_in_their_frame():
    world = world_of([tick(0), trips(0, "a"), tick(1), trips(1, "b"), trips(1, "c")])
    assert world.take_trips() == []
    taken = []
    for _ in range(4):
        world.step()
        taken.append([trip.vehicle for trip in world.take_trips()])
    assert taken == [[], ["a"], [], ["b", "c"]]
    assert world.unfinished_trips() == []


def test_a_recording_without_a_frame_is_refused():
    with pytest.raises(ConfigError, match="holds no frame"):
        world_of([scan(0, "a")])
