"""A recording frame by frame, whatever order its messages came in."""

import pytest
from frame_messages import roster, scan, state, tick
from hypothesis import given
from hypothesis import strategies as st

from protocol.limits import MAX_FRAMES_AHEAD
from recording.playback.frames import RecordedFrames

pytest.importorskip("mcap", reason="needs the extra `mcap`")


@given(st.integers(0, 5000), st.integers(1, 300), st.randoms(use_true_random=False))
def test_all_of_a_frame_comes_together_however_it_was_mixed(first, count, random):
    frames = range(first, first + count)
    late = {frame: random.randrange(MAX_FRAMES_AHEAD // 2) for frame in frames}
    messages = [(frame, state(frame)) for frame in frames]
    messages += [(frame + late[frame], scan(frame, "a")) for frame in frames]
    messages.sort(key=lambda pair: pair[0])
    recording = RecordedFrames(message for _, message in messages)
    assert recording.first("state") == first
    for frame in frames:
        assert sorted(item.topic for item in recording.take(frame)) == ["scan", "state"]
    assert recording.take(first + count) == []
    assert (recording.late, recording.absurd) == (0, 0)


def test_what_comes_too_late_is_counted_and_what_was_passed_by_is_forgotten():
    messages = [state(frame) for frame in range(200)] + [scan(3, "a")]
    recording = RecordedFrames(messages)
    assert all(recording.take(frame) for frame in range(200))
    assert recording.take(50) == []
    assert recording.late == 1


def test_a_frame_that_cannot_be_does_not_pass_for_the_present():
    messages = [state(0), roster(1 << 39, ["liar"]), *(state(frame) for frame in range(1, 200))]
    recording = RecordedFrames(messages)
    assert [len(recording.take(frame)) for frame in range(200)] == [1] * 200
    assert recording.absurd == 1


def test_of_a_long_recording_only_what_is_near_is_read():
    read = []

    def messages():
        for frame in range(10_000):
            read.append(frame)
            yield state(frame)

    RecordedFrames(messages()).take(100)
    assert len(read) <= 100 + MAX_FRAMES_AHEAD + 2


def test_a_recording_that_begins_in_mid_frame_begins_with_the_first_whole_one():
    messages = [scan(499, "a"), tick(500), state(500), roster(500, ["a"]), state(501), tick(501)]
    assert RecordedFrames(messages).first("tick", "state") == 500
    assert RecordedFrames([]).first("tick") is None
