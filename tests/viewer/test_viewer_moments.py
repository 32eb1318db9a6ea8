"""Frames are put together from messages, whatever their order and whoever is slow."""

from hypothesis import given
from hypothesis import strategies as st

from protocol import messages as m
from tests.protocol.test_wire import SCAN
from viewer.moments import MAX_SCANS, OPEN_MOMENTS, Moments


def counted(frame: int) -> m.LaneCounts:
    return m.LaneCounts(
        frame=frame,
        sim_time_ns=frame,
        tls="J",
        agents=[],
        complete=True,
        upstream={},
        downstream={},
    )


def scan(frame: int, agent: str = "a") -> m.Scan:
    return SCAN.model_copy(update={"frame": frame, "agent": agent})


def test_a_frame_is_whole_when_the_next_one_was_counted() -> None:
    moments = Moments()
    for message in (scan(1), counted(1)):
        moments.take(message)
    assert moments.newest() is None
    moments.take(counted(2))
    whole = moments.newest()
    assert whole is not None
    assert (whole.frame, len(whole.scans), whole.sim_time_ns) == (1, 1, 1)
    assert moments.newest() is None


def test_the_last_frame_is_whole_at_the_end() -> None:
    moments = Moments()
    moments.take(counted(5))
    moments.finish()
    whole = moments.newest()
    assert whole is not None
    assert whole.frame == 5


def test_who_is_slow_gets_the_newest_and_leaves_out_whole_frames() -> None:
    moments = Moments()
    for frame in range(10):
        moments.take(counted(frame))
    whole = moments.newest()
    assert whole is not None
    assert (whole.frame, moments.left_out) == (8, 8)


def test_absurd_frames_are_in_nobodys_way() -> None:
    moments = Moments()
    for n in range(1000):
        moments.take(scan((1 << 40) - 1 - n))
    for _ in range(MAX_SCANS + 10):
        moments.take(scan(3))
    for frame in (3, 4):
        moments.take(counted(frame))
    whole = moments.newest()
    assert whole is not None
    assert (whole.frame, len(whole.scans)) == (3, MAX_SCANS)


@given(st.lists(st.tuples(st.integers(0, 30), st.booleans()), max_size=200))
def test_no_order_of_messages_opens_more_than_a_few(order: list[tuple[int, bool]]) -> None:
    moments, shown = Moments(), 0
    for frame, is_count in order:
        moments.take(counted(frame) if is_count else scan(frame))
        assert len(moments._open) <= OPEN_MOMENTS
        shown += moments.newest() is not None
    assert shown + moments.left_out <= sum(is_count for _, is_count in order)
