from hypothesis import given
from hypothesis import strategies as st

from protocol.limits import MAX_FRAMES_AHEAD
from protocol.sequence_window import SequenceWindow


def test_before_any_frame_is_known_the_lowest_counts():
    horizon = SequenceWindow()
    assert horizon.admits(1 << 39)
    assert horizon.admits(0)
    assert not horizon.admits(1 << 39)
    assert horizon.admits(MAX_FRAMES_AHEAD)


def test_a_frame_that_was_finished_moves_the_horizon_and_nothing_moves_it_back():
    horizon = SequenceWindow()
    horizon.reach(100)
    horizon.reach(50)
    assert horizon.admits(100 + MAX_FRAMES_AHEAD)
    assert not horizon.admits(101 + MAX_FRAMES_AHEAD)
    assert horizon.farthest([90, 101, 164]) == 164


@given(st.integers(0, 1 << 40))
def test_states_of_consecutive_frames_are_believed_and_a_single_one_is_not(start: int):
    horizon = SequenceWindow()
    horizon.reach(0)
    horizon.follow(start + 1000)
    assert horizon.newest == 0
    for frame in (start + 5, start + 6, 1 << 50, start + 7):
        horizon.follow(frame)
    assert horizon.newest == start + 7
