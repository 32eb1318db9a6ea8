"""A process's recorded messages of a frame, by agent."""

import numpy as np
import pytest
from frame_messages import REGION, item, pose, roster, scan
from hypothesis import given
from hypothesis import strategies as st

from protocol.messages import Objects, Sighting
from recording.playback.frames import agent_frames

pytest.importorskip("mcap", reason="needs the extra `mcap`")


def test_a_whole_frame_is_told_as_it_was():
    chunks = [scan(4, "b", n, 4) for n in range(4)]
    messages = [roster(4, ["b", "a"]), pose(4, "b"), *chunks, pose(4, "a", cav=False)]
    frames = agent_frames("vehicle-0", "vehicle", messages)
    assert [*frames] == ["b", "a"]
    assert [part is one.message for (_, part), one in zip(frames["b"].parts, chunks, strict=True)]
    assert (frames["b"].has_sensor, frames["a"].has_sensor) == (True, False)
    assert frames["a"].parts == []


@given(st.sets(st.integers(0, 7)))
def test_chunks_count_up_to_the_first_that_is_missing_and_none_is_waited_for(came):
    messages = [roster(0, ["a"]), pose(0, "a"), *(scan(0, "a", n, 8) for n in sorted(came))]
    parts = agent_frames("vehicle-0", "vehicle", messages)["a"].parts
    whole = next(n for n in range(9) if n not in came)
    assert [(part.chunk, part.chunks) for _, part in parts] == [(n, whole) for n in range(whole)]


def test_others_words_are_left_and_who_drives_without_a_pose_too():
    other = [
        roster(0, ["x"], "vehicle-1"),
        pose(0, "x", "vehicle-1"),
        scan(0, "x", process="vehicle-1"),
    ]
    messages = [roster(0, ["a", "b"]), pose(0, "a"), scan(0, "b"), *other]
    assert [*agent_frames("vehicle-0", "vehicle", messages)] == ["a"]
    assert [*agent_frames("vehicle-1", "vehicle", messages)] == ["x"]
    assert agent_frames("vehicle-2", "vehicle", messages) == {}


def test_a_post_that_left_a_frame_out_is_still_there():
    frames = agent_frames("infra-r0", "roadside", [roster(0, ["rsu-0"], "infra-r0")])
    assert frames["rsu-0"].parts == []
    assert frames["rsu-0"].has_sensor


def test_boxes_and_what_a_sensor_saw_belong_to_their_agent():
    boxes = Objects(
        frame=0,
        sim_time_ns=0,
        agent="a",
        boxes=np.zeros((2, 7), np.float32),
        scores=np.zeros(2, np.float32),
        classes=np.zeros(2, np.uint8),
        sense_start_ns=1,
        sense_end_ns=2,
        detect_end_ns=3,
    )
    where = {"region": REGION, "process": "vehicle-0", "agent": "a"}
    saw = Sighting(frame=0, agent="a", vehicles=["v"], points=np.array([5], np.int32))
    messages = [pose(0, "a"), item("objects", boxes, **where), item("sighting", saw, agent="a")]
    frames = agent_frames("vehicle-0", "vehicle", messages)["a"]
    assert frames.parts[0][1] is boxes
    assert frames.sighting is saw
    assert frames.sense_start_ns == 1
