"""The frame buffer collects frames from messages, whatever their order and the sender's delay."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol import messages as m
from protocol import observer
from protocol.inbox import Envelope
from protocol.observer import MAX_FRAME_MESSAGES, MAX_OPEN_FRAMES, BufferedFrame, FrameBuffer
from protocol.wire import encode
from tests.messages import SCAN, lane_counts


def envelope(topic: str, message: m.Message) -> Envelope:
    return Envelope(topic, {}, None, 0, encode(message))


def scan(frame: int, agent: str = "a") -> m.Scan:
    return SCAN.model_copy(update={"frame": frame, "agent": agent})


class CountedFrames(FrameBuffer):
    """Frames that end when they were counted."""

    def __init__(self) -> None:
        super().__init__("lanes")

    def receive(self, *messages: m.LaneCounts | m.Scan) -> None:
        for message in messages:
            topic = "scan" if isinstance(message, m.Scan) else "lanes"
            self.take(envelope(topic, message), message.frame)

    def whole(self) -> BufferedFrame:
        """Returns the frame that must be complete now."""
        frame = self.next()
        assert frame is not None
        return frame


def test_a_frame_is_whole_when_the_next_one_was_lane_counts() -> None:
    frames = CountedFrames()
    frames.receive(scan(1), lane_counts(1))
    assert frames.next() is None
    frames.receive(lane_counts(2))
    whole = frames.whole()
    assert (whole.number, [type(one) for one in whole.messages()]) == (1, [m.Scan, m.LaneCounts])
    assert frames.next() is None


def test_the_last_frame_is_whole_at_the_end() -> None:
    frames = CountedFrames()
    frames.receive(lane_counts(5))
    frames.finish()
    assert frames.whole().number == 5


def test_a_frame_that_is_counted_twice_ends_once() -> None:
    frames = CountedFrames()
    frames.receive(lane_counts(5), lane_counts(5))
    assert frames.next() is None


def test_who_is_slow_gets_the_newest_and_leaves_out_whole_frames() -> None:
    frames = CountedFrames()
    frames.receive(*(lane_counts(frame) for frame in range(10)))
    assert (frames.whole().number, frames.left_out) == (8, 8)


def test_absurd_frames_are_in_nobodys_way() -> None:
    frames = CountedFrames()
    frames.receive(*(scan((1 << 40) - 1 - n) for n in range(1000)))
    frames.receive(*(scan(3) for _ in range(10)), lane_counts(3), lane_counts(4))
    whole = frames.whole()
    assert (whole.number, len(whole.received)) == (3, 11)


def test_no_more_messages_of_a_frame_are_kept_than_one_can_have() -> None:
    frames = CountedFrames()
    frames.receive(*(scan(3) for _ in range(MAX_FRAME_MESSAGES + 10)))
    assert len(frames._open[3].received) == MAX_FRAME_MESSAGES


def test_a_frame_of_endless_bytes_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    size = len(encode(scan(3)))
    monkeypatch.setattr(observer, "MAX_FRAME_BYTES", 4 * size)
    frames = CountedFrames()
    frames.receive(*(scan(3) for _ in range(10)))
    assert frames._open[3].size_bytes == 4 * size


def test_what_cannot_be_read_or_bears_another_number_ends_no_frame_and_is_left_out() -> None:
    frames = CountedFrames()
    spoilt = Envelope("lanes", {}, None, 0, encode(lane_counts(7))[:-8])
    frames.take(spoilt, 7)
    frames.take(envelope("lanes", lane_counts(7)), 8)
    assert not frames._open
    frames.take(Envelope("scan", {}, None, 0, b"?"), 7)
    frames.take(envelope("scan", scan(6)), 7)
    frames.receive(lane_counts(7), lane_counts(8))
    assert [type(one) for one in frames.whole().messages()] == [m.LaneCounts]


@given(st.lists(st.tuples(st.integers(0, 30), st.booleans()), max_size=200))
def test_no_order_of_messages_opens_more_than_a_few(order: list[tuple[int, bool]]) -> None:
    frames, shown = CountedFrames(), 0
    for frame, is_count in order:
        frames.receive(lane_counts(frame) if is_count else scan(frame))
        assert len(frames._open) <= MAX_OPEN_FRAMES
        shown += frames.next() is not None
    assert shown + frames.left_out <= sum(is_count for _, is_count in order)
