import logging
import time

import numpy as np
import pytest

from protocol.errors import MessageError
from protocol.in_process import InProcessRouter
from protocol.inbox import Envelope, Inbox, Presence, RawMessage
from protocol.messages import End, Roster
from protocol.topics import TOPICS
from protocol.wire import encode

ROSTER = Roster(frame=1, process="p", agents=[], scanning=[])


def sealed(data: bytes) -> RawMessage:
    return RawMessage(TOPICS["roster"], "cpnet/v4/r0/roster/p", data, 0)


def test_a_bad_message_is_counted_logged_once_and_dropped(caplog: pytest.LogCaptureFixture):
    inbox = Inbox()
    other_version = bytearray(encode(ROSTER))
    other_version[4] = 9
    for data in (b"", b"junk" * 9, bytes(other_version), encode(End(frames=1, reason="x"))):
        inbox.put(sealed(data))
    with caplog.at_level(logging.WARNING):
        assert [inbox.get() for _ in range(4)] == [None] * 4
    assert inbox.drops == {"MessageError": 3, "VersionError": 1}
    assert len(caplog.records) == 2
    assert "cpnet/v4/r0/roster/p" in caplog.text


def test_who_keeps_messages_gets_them_closed_and_reads_what_it_needs():
    inbox = Inbox()
    inbox.keep_encoded()
    good, bad = encode(ROSTER), encode(ROSTER)[:-8]
    for data in (good, bad):
        inbox.put(sealed(data))
    items = [inbox.get(), inbox.get()]
    assert [item.data for item in items if isinstance(item, Envelope)] == [good, bad]
    first, second = [item for item in items if isinstance(item, Envelope)]
    assert first.message == ROSTER
    with pytest.raises(MessageError):
        _ = second.message
    assert not inbox.drops


def test_a_full_inbox_counts_what_it_cannot_take():
    inbox = Inbox(capacity=2)
    for _ in range(5):
        inbox.put(Presence("edge", "edge", alive=True))
    assert inbox.drops == {"inbox_full": 3}


def test_messages_come_out_in_the_order_they_came_with_the_parts_of_their_key():
    inbox = Inbox()
    bus = InProcessRouter().bus(inbox)
    bus.subscribe("roster", region="r0")
    for process in ("a", "b"):
        bus.publish("roster", ROSTER, region="r0", process=process)
    bus.publish("roster", ROSTER, region="elsewhere", process="c")
    got = [inbox.get(), inbox.get()]
    assert [item.parts["process"] for item in got if isinstance(item, Envelope)] == ["a", "b"]
    assert inbox.get() is None


def test_presence_is_told_to_those_who_watch_even_late():
    network = InProcessRouter()
    early = network.bus(Inbox())
    early.announce("edge", "edge")
    inbox = Inbox()
    network.bus(inbox).watch()
    early.close()
    assert inbox.get() == Presence("edge", "edge", alive=True)
    assert inbox.get() == Presence("edge", "edge", alive=False)


def test_waiting_ends_when_the_time_is_over():
    assert Inbox().get(0.01) is None


def test_a_message_holds_what_was_published():
    inbox = Inbox()
    bus = InProcessRouter().bus(inbox)
    bus.subscribe("roster")
    size = bus.publish("roster", ROSTER, region="r0", process="p")
    item = inbox.get()
    assert isinstance(item, Envelope)
    assert item.message == ROSTER
    assert len(item.data) == size
    assert np.isfinite(item.received_ns)


def test_of_a_limited_topic_the_newest_of_each_key_wait_and_nobody_elses_are_lost():
    inbox = Inbox(capacity=8)
    inbox.limit("roster", 2)
    for number in range(100):
        flood = ROSTER.model_copy(update={"frame": number})
        inbox.put(RawMessage(TOPICS["roster"], "cpnet/v4/r0/roster/flood", encode(flood), 0))
    inbox.put(sealed(encode(ROSTER)))
    inbox.put(Presence("edge", "edge", alive=True))
    came = [inbox.get() for _ in range(5)]
    frames = [(i.parts["process"], i.message.frame) for i in came if isinstance(i, Envelope)]
    assert frames == [("flood", 98), ("flood", 99), ("p", 1)]
    assert came[3] == Presence("edge", "edge", alive=True)
    assert came[4] is None
    assert inbox.drops == {"overtaken": 98}


def test_a_full_inbox_drops_a_limited_message_whole():
    inbox = Inbox(capacity=1)
    inbox.limit("roster", 2)
    inbox.put(Presence("edge", "edge", alive=True))
    inbox.put(sealed(encode(ROSTER)))
    assert inbox.get() == Presence("edge", "edge", alive=True)
    inbox.put(sealed(encode(ROSTER.model_copy(update={"frame": 7}))))
    item = inbox.get()
    assert isinstance(item, Envelope)
    assert item.message.frame == 7
    assert inbox.drops == {"inbox_full": 1}


def test_an_inbox_full_of_bytes_drops_until_some_are_read():
    size = len(encode(ROSTER))
    inbox = Inbox(max_bytes=2 * size)
    for _ in range(5):
        inbox.put(sealed(encode(ROSTER)))
    inbox.put(Presence("edge", "edge", alive=True))
    assert inbox.drops == {"inbox_full": 3}
    assert isinstance(inbox.get(), Envelope)
    inbox.put(sealed(encode(ROSTER)))
    assert [type(inbox.get()) for _ in range(4)] == [Envelope, Presence, Envelope, type(None)]
    assert inbox.drops == {"inbox_full": 3}


def test_a_newer_message_takes_the_bytes_of_the_one_it_drives_out():
    large = encode(ROSTER.model_copy(update={"frame": 7, "agents": ["a" * 100]}))
    size = len(encode(ROSTER))
    inbox = Inbox(max_bytes=size + 8)
    inbox.limit("roster", 1)
    for data in (encode(ROSTER), encode(ROSTER.model_copy(update={"frame": 2})), large):
        inbox.put(sealed(data))
    item = inbox.get()
    assert isinstance(item, Envelope)
    assert item.message.frame == 2
    assert inbox.get() is None
    assert inbox.drops == {"overtaken": 1, "inbox_full": 1}


def test_a_wake_ends_the_wait_once_and_neither_hides_nor_parts_messages():
    inbox = Inbox()
    inbox.wake()
    inbox.put(sealed(encode(ROSTER)))
    inbox.wake()
    inbox.put(sealed(encode(ROSTER)))
    assert isinstance(inbox.get(1.0), Envelope)
    assert isinstance(inbox.get(), Envelope)
    assert inbox.get() is None
    for _ in range(3):
        inbox.wake()
        begin_ns = time.monotonic_ns()
        assert inbox.get(15.0) is None
        assert time.monotonic_ns() - begin_ns < 10e9
    assert not inbox.drops


def test_a_full_inbox_needs_no_wake():
    inbox = Inbox(capacity=1)
    inbox.put(Presence("edge", "edge", alive=True))
    inbox.wake()
    assert inbox.get() == Presence("edge", "edge", alive=True)
    inbox.wake()
    assert inbox.get(15.0) is None
    assert not inbox.drops


EXPRESSIONS = ["cpnet/v4/**", "**", "cpnet/v4/r0/*/p", "cpnet/v4/r0/roster/*", "cpnet/v4/r0/ro$*/p"]


@pytest.mark.parametrize("key", EXPRESSIONS)
def test_a_good_message_at_an_expression_is_counted_and_dropped(key: str):
    inbox = Inbox()
    inbox.put(RawMessage(TOPICS["roster"], key, encode(ROSTER), 0))
    assert inbox.get() is None
    assert inbox.drops == {"MessageError": 1}


def test_a_key_that_reaches_two_topics_is_one_place_in_each():
    inbox = Inbox()
    inbox.limit("roster", 1)
    for topic in ("roster", "pose", "roster", "pose"):
        inbox.put(RawMessage(TOPICS[topic], "cpnet/v4/**", encode(ROSTER), 0))
    assert [inbox.get() for _ in range(4)] == [None] * 4
    assert inbox.drops == {"overtaken": 1, "MessageError": 3}


def test_a_key_that_nobody_could_have_made_is_not_kept(caplog: pytest.LogCaptureFixture):
    inbox = Inbox()
    for _ in range(2):
        inbox.put(RawMessage(TOPICS["roster"], "x" * 60_000, encode(ROSTER), 0))
    assert inbox.get() is None
    assert inbox.drops == {"MessageError": 2}
    assert len(caplog.text) < 1000


def test_what_others_write_breaks_no_line_of_the_log(caplog):
    Inbox().refuse("a", MessageError("bad\rthing\udcc9"), "cpnet/v4/a\nERROR all is lost")
    (record,) = caplog.records
    assert record.getMessage().isprintable()
    assert "a\\x0aERROR all is lost: bad\\x0dthing\\xdcc9" in record.getMessage()


def test_one_sender_of_garbage_gets_one_line_whatever_it_writes(caplog: pytest.LogCaptureFixture):
    inbox = Inbox()
    for n in range(5000):
        inbox.put(RawMessage(TOPICS["roster"], f"cpnet/v4/r0/roster/p{n}", b"%016d" % n, 0))
        inbox.get()
    assert inbox.drops == {"MessageError": 5000}
    (record,) = caplog.records
    assert record.getMessage().endswith("(later ones are only counted)")


def test_the_log_says_which_line_about_bad_messages_is_the_last(caplog: pytest.LogCaptureFixture):
    inbox = Inbox()
    for n in range(200):
        inbox.refuse(f"topic {n}", MessageError("bad"))
        inbox.fail(f"topic {n}", ValueError("bad"))
    assert inbox.drops == {"MessageError": 200, "role_error": 200}
    assert len(caplog.records) == 64
    lasts = ["all later ones are only counted" in r.getMessage() for r in caplog.records]
    assert lasts == [False] * 63 + [True]
