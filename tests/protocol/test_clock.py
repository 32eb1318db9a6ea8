"""Clocks of two machines, aligned by round trips."""

from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol import clock
from protocol.bus import Endpoint, open_bus
from protocol.clock import DRIFT, ClockWatch, Exchange, OffsetFilter, this_machine, time_reply
from protocol.inbox import Envelope, Inbox
from protocol.messages import ClockReading, Message, TimeReply
from protocol.topics import BusName
from tests.waiting import wait_until

DELAYS = st.integers(0, 10**8)
OFFSETS = st.integers(-(10**15), 10**15)


def exchange(offset: int, there: int, back: int, sent: int = 0, thought: int = 50) -> Exchange:
    received = sent + there + offset
    return Exchange(sent, received, received + thought, sent + there + thought + back)


@settings(deadline=None)
@given(OFFSETS, DELAYS, DELAYS)
def test_the_true_offset_lies_within_the_error(offset, there, back):
    one = exchange(offset, there, back)
    assert abs(one.offset_ns - offset) <= one.error_ns
    assert one.error_ns <= (there + back + 1) / 2


@settings(deadline=None)
@given(OFFSETS, st.lists(st.tuples(DELAYS, DELAYS), min_size=1, max_size=60))
def test_the_fastest_round_trip_decides_and_its_error_holds_while_clocks_drift(offset, ways):
    estimate = OffsetFilter()
    now, true = 0, float(offset)
    for there, back in ways:
        estimate.add(exchange(round(true), there, back, sent=now))
        now += 10**9
        true += 0.9 * DRIFT * 10**9
    found = estimate.best(now)
    assert found is not None
    assert abs(found[0] - true) <= found[1] + 2
    freshest = exchange(0, *ways[-1], sent=now - 10**9)
    assert found[1] <= freshest.error_at_ns(now)


def test_before_the_first_answer_nothing_is_known():
    assert OffsetFilter().best(0) is None


def test_an_answer_of_no_clock_is_left():
    offsets = OffsetFilter()
    for received_ns in (-(1 << 62) + 1, (1 << 62) - 1):
        offsets.add(Exchange(1_000, received_ns, received_ns, 2_000))
    assert offsets.best(2_000) is None


def test_an_answer_that_contradicts_itself_is_left():
    estimate = OffsetFilter()
    estimate.add(Exchange(asked_ns=0, received_ns=5, replied_ns=50, answered_ns=20))
    estimate.add(Exchange(asked_ns=0, received_ns=50, replied_ns=5, answered_ns=20))
    assert estimate.best(0) is None


class FarBus:
    """A bus whose host has a clock of its own."""

    def __init__(self, reply: Callable[[], TimeReply | None]) -> None:
        self.reply = reply
        self.published: list[Message] = []

    def ask(self, topic_name: str, message: type, timeout_s: float) -> TimeReply | None:
        return self.reply()

    def publish(self, topic_name: str, message: Message, **parts: str) -> int:
        self.published.append(message)
        return 0


def test_on_one_machine_the_offset_is_nothing_and_known_for_good():
    bus = FarBus(time_reply())
    assert ClockWatch("edge", bus).ask_once()
    assert bus.published == [ClockReading(process="edge", offset_ns=0, error_ns=0)]


def test_it_is_published_again_for_a_recorder_that_comes_later(monkeypatch):
    monkeypatch.setattr(clock, "PERIOD_S", 0.001)
    bus = FarBus(time_reply())
    watch = ClockWatch("edge", bus)
    watch.start()
    wait_until(lambda: len(bus.published) >= 3)
    watch.stop()
    assert {(one.offset_ns, one.error_ns) for one in bus.published} == {(0, 0)}


def test_another_machines_clock_is_found(monkeypatch):
    monkeypatch.setattr(clock, "BURST_PERIOD_S", 0.0)

    def reply() -> TimeReply:
        here = time_reply("far")()
        far = {"received_ns": here.received_ns + 10**12, "replied_ns": here.replied_ns + 10**12}
        return here.model_copy(update=far)

    bus = FarBus(reply)
    assert not ClockWatch("edge", bus).ask_once()
    [reading] = bus.published
    assert isinstance(reading, ClockReading)
    assert abs(reading.offset_ns - 10**12) <= reading.error_ns < 10**7


def test_no_answer_tells_nothing(monkeypatch):
    monkeypatch.setattr(clock, "BURST_PERIOD_S", 0.0)
    bus = FarBus(lambda: None)
    assert not ClockWatch("edge", bus).ask_once()
    assert bus.published == []


def test_this_machine_has_a_name_that_stays():
    assert this_machine() == this_machine()


@pytest.mark.parametrize(("machine", "most_ns"), [(None, 0), ("elsewhere", 10**8)])
def test_the_clock_is_asked_over_the_bus(machine, most_ns):
    inbox = Inbox()
    host = open_bus(BusName.WORLD, Endpoint("tcp/127.0.0.1:0", listen=True), inbox)
    try:
        host.subscribe("clock")
        host.answer("time", time_reply(machine))
        watch = ClockWatch("edge", host)
        watch.start()
        item = inbox.get(20)
        watch.stop()
    finally:
        host.close()
    assert isinstance(item, Envelope)
    assert isinstance(item.message, ClockReading)
    assert item.message.error_ns <= most_ns
    assert abs(item.message.offset_ns) <= item.message.error_ns
