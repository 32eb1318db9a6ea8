"""Who is in no hurry gets the same messages, in the order in which they arrived."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from cpnet.endpoints import free_locator
from protocol.bus import Endpoint, open_bus
from protocol.gathering import Gathering
from protocol.inbox import Envelope, Inbox, Presence, RawMessage
from protocol.messages import Message
from protocol.topics import TOPICS, BusName
from protocol.wire import encode
from tests.messages import SCAN, lane_counts

WAIT_S = 5.0


@dataclass(frozen=True)
class Taken:
    """A time by a router's clock."""

    at: datetime

    def get_time(self) -> datetime:
        return self.at


@dataclass
class Said:
    """A sample whose router took it so many seconds after now, or does not say."""

    name: str
    after_s: float | None = None
    timestamp: Taken | None = None

    def __post_init__(self) -> None:
        if self.after_s is not None:
            self.timestamp = Taken(datetime.now(UTC) + timedelta(seconds=self.after_s))


class Pipe(deque[Said]):
    """A subscription."""

    def try_recv(self) -> Said | None:
        return self.popleft() if self else None


def sealed(said: Said, arrived_ns: int) -> RawMessage | None:
    key = f"cpnet/v2/{said.name}/J/lanes"
    return RawMessage(TOPICS["lanes"], key, b"", arrived_ns) if said.name else None


def names(gathering: Gathering) -> list[str]:
    return [item.key.split("/")[2] for _, item in gathering.fetch(time.monotonic_ns())]


@given(st.lists(st.none() | st.floats(-1e8, 1e8), max_size=20))
def test_whatever_a_routers_clock_says_a_message_came_since_the_last_time(stamps_s):
    before_ns = time.monotonic_ns()
    gathering = Gathering()
    gathering.add(Pipe(Said("a", after_s) for after_s in stamps_s), sealed)
    found = gathering.fetch(time.monotonic_ns())
    assert len(found) == len(stamps_s)
    assert all(before_ns <= at_ns <= time.monotonic_ns() for at_ns, _ in found)
    assert all(item.received_ns == at_ns for at_ns, item in found)


@given(
    st.floats(-1e6, 1e6),
    st.lists(st.tuples(st.floats(0, 1), st.sampled_from("xyz")), unique_by=lambda one: one[0]),
)
def test_subscriptions_are_read_in_the_order_of_the_stamps_however_wrong_the_clock(off_s, said):
    pipes = {name: Pipe() for name in "xyz"}
    gathering = Gathering()
    for pipe in pipes.values():
        gathering.add(pipe, sealed)
    for after_s, name in sorted(said):
        pipes[name].append(Said(f"{name}{after_s}", off_s + round(after_s, 4)))
    expected = sorted((one for pipe in pipes.values() for one in pipe), key=stamp_of)
    found = gathering.fetch(time.monotonic_ns())
    assert [item.key.split("/")[2] for _, item in found] == [one.name for one in expected]
    assert [at_ns for at_ns, _ in found] == sorted(at_ns for at_ns, _ in found)


def stamp_of(said: Said) -> float:
    assert said.timestamp is not None
    return said.timestamp.at.timestamp()


def test_an_inbox_reads_two_buses_in_one_order_and_what_came_meanwhile_next_time():
    inbox = Inbox()
    inbox.keep_encoded()
    inbox.gather()
    now_ns = time.monotonic_ns()
    scripts = [[(now_ns - 4, "a"), (now_ns + 10**15, "d")], [(now_ns - 3, "b"), (now_ns - 2, "c")]]

    def fetch_from(script):
        def fetch(_now_ns: int):
            said, script[:] = script[:], []
            return [(at_ns, sealed(Said(name), at_ns)) for at_ns, name in said]

        inbox.fetch_from(fetch)

    for script in scripts:
        fetch_from(script)
    found = [inbox.get() for _ in range(4)]
    assert [one and one.parts["region"] for one in found] == ["a", "b", "c", None]
    assert not inbox.is_empty


def test_what_cannot_be_read_is_in_nobodys_way():
    gathering = Gathering()
    gathering.add(Pipe([Said(""), Said("a")]), sealed)
    assert names(gathering) == ["a"]


def test_a_flood_of_one_topic_leaves_time_for_the_others():
    gathering = Gathering()
    gathering.add(Pipe(Said("many") for _ in range(2000)), sealed)
    gathering.add(Pipe([Said("one")]), sealed)
    first = names(gathering)
    assert "one" in first
    rest = [name for _ in range(10) for name in names(gathering)]
    assert (first + rest).count("many") == 2000


def test_messages_and_presence_cross_tcp_to_who_gathers_them():
    locator = free_locator()
    inbox = Inbox()
    inbox.gather()
    router = open_bus(BusName.V2X, Endpoint(locator, listen=True), Inbox())
    looker = open_bus(BusName.V2X, Endpoint(locator, listen=False), inbox)
    speaker = open_bus(BusName.V2X, Endpoint(locator, listen=False), Inbox())
    try:
        looker.subscribe("scan")
        looker.subscribe("lanes")
        looker.watch()
        speaker.announce("vehicle", "v")
        assert inbox.get(WAIT_S) == Presence("vehicle", "v", alive=True)
        sent: list[tuple[str, Message]] = []
        began_ns = time.monotonic_ns()
        for frame in range(20):
            scan = SCAN.model_copy(update={"frame": frame, "payload": np.zeros(999, np.uint8)})
            speaker.publish("scan", scan, region="r0", process="v", agent="a", chunk="0")
            speaker.publish("lanes", lane_counts(frame), region="r0", tls="J")
            sent += [("scan", scan), ("lanes", lane_counts(frame))]
        found: list[Envelope] = []
        while len(found) < len(sent):
            item = inbox.get(WAIT_S)
            assert isinstance(item, Envelope)
            found.append(item)
        for topic in ("scan", "lanes"):  # the one overtakes the other on the way
            came = [one.data for one in found if one.topic == topic]
            assert came == [encode(message) for name, message in sent if name == topic]
        arrived_ns = [one.received_ns for one in found]
        assert arrived_ns == sorted(arrived_ns)
        assert len({*arrived_ns}) > len(sent) / 2
        assert began_ns - 10**9 < arrived_ns[0]
        assert arrived_ns[-1] < time.monotonic_ns()
        speaker.close()
        assert inbox.get(WAIT_S) == Presence("vehicle", "v", alive=False)
    finally:
        for bus in (looker, speaker, router):
            bus.close()


def test_a_wake_ends_the_wait_of_who_gathers():
    inbox = Inbox()
    inbox.gather()
    inbox.wake()
    began_s = time.monotonic()
    assert inbox.get(WAIT_S) is None
    assert time.monotonic() - began_s < WAIT_S / 2


def test_who_gathers_waits_no_longer_than_told():
    inbox = Inbox()
    inbox.gather()
    assert inbox.get(0.01) is None
    assert inbox.get() is None
