"""Requests wait for their time, and none of them keeps another from acting."""

from __future__ import annotations

from collections.abc import Callable

from hypothesis import given
from hypothesis import strategies as st

from protocol.inbox import Envelope
from protocol.messages import SignalRequest
from sim_host.cabinet import PendingRequests
from sim_host.limits import MAX_PENDING_REQUESTS


def add(
    pending: PendingRequests, sim_time_ns: int, delay_ns: int | None = None, state: str = "G"
) -> None:
    request = SignalRequest(
        frame=0,
        sim_time_ns=sim_time_ns,
        tls="J",
        state=state,
        policy="test",
        delay_sim_ns=delay_ns,
    )
    pending.add(Envelope("request", {}, request, 0, b""), request)


def take(
    pending: PendingRequests, now_ns: int, accepts: Callable[[SignalRequest], bool] = lambda _: True
) -> int | None:
    taken = pending.take(now_ns, accepts)
    return taken and taken.request.sim_time_ns


def is_good(request: SignalRequest) -> bool:
    return request.state == "G"


def test_the_newest_that_is_due_acts_and_older_ones_are_overtaken():
    pending = PendingRequests()
    for now_ns in (10, 30, 20):
        add(pending, now_ns, 5)
    assert take(pending, 14) is None
    assert take(pending, 100) == 30
    assert take(pending, 100) is None
    assert (pending.overtaken, pending.crowded_out) == (2, 0)


def test_what_waits_is_overtaken_by_a_newer_one_that_acts():
    pending = PendingRequests()
    add(pending, 10, 500)
    add(pending, 20)
    assert take(pending, 20) == 20
    assert pending.overtaken == 1
    assert take(pending, 1000) is None


def test_a_newer_one_that_waits_is_not_overtaken():
    pending = PendingRequests()
    add(pending, 10)
    add(pending, 20, 500)
    assert take(pending, 10) == 10
    assert pending.overtaken == 0
    assert take(pending, 1000) == 20


def test_one_of_the_same_time_that_is_due_later_is_overtaken_too():
    pending = PendingRequests()
    add(pending, 20, 500)
    add(pending, 20)
    assert take(pending, 20) == 20
    assert pending.overtaken == 1
    assert take(pending, 1000) is None


def test_a_request_keeps_the_envelope_it_came_in():
    pending = PendingRequests()
    request = SignalRequest(frame=0, sim_time_ns=10, tls="J", state="G", policy="test")
    envelope = Envelope("request", {}, request, 0, b"")
    pending.add(envelope, request)
    taken = pending.take(10, lambda _: True)
    assert taken is not None
    assert taken.envelope is envelope


def test_one_that_is_refused_neither_acts_nor_overtakes():
    pending = PendingRequests()
    add(pending, 10)
    add(pending, 20, state="bad")
    assert take(pending, 20, is_good) == 10
    assert pending.overtaken == 0


def test_of_two_of_one_time_the_good_one_acts_in_any_order():
    for states in ("G", "bad"), ("bad", "G"):
        pending = PendingRequests()
        for state in states:
            add(pending, 20, state=state)
        assert take(pending, 20, is_good) == 20


def test_a_flood_of_what_is_due_late_drives_out_itself_alone():
    pending = PendingRequests()
    add(pending, 1, 10)
    for number in range(2 * MAX_PENDING_REQUESTS):
        add(pending, 1, 1000 + number)
    assert pending.crowded_out == MAX_PENDING_REQUESTS + 1
    assert take(pending, 11) == 1


requests = st.tuples(st.integers(0, 50), st.integers(0, 50), st.sampled_from(["G", "bad"]))


@given(st.lists(requests, max_size=40), st.lists(requests, max_size=10))
def test_who_is_good_and_newest_of_those_due_always_acts(
    before: list[tuple[int, int, str]], later: list[tuple[int, int, str]]
) -> None:
    pending = PendingRequests()
    acted: list[int] = []
    for now_ns, batch in ((60, before), (120, [(a + 60, b, c) for a, b, c in later])):
        for sim_time_ns, delay_ns, state in batch:
            add(pending, sim_time_ns, delay_ns, state)
        good = [a for a, b, state in batch if state == "G" and a + b <= now_ns]
        taken = take(pending, now_ns, is_good)
        if good:
            assert taken is not None
            assert taken >= max(good)
        acted += [] if taken is None else [taken]
    assert acted == sorted(set(acted))
