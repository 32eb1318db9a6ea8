"""Scans are opened by threads, and come back as if there were none."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from edge_server.frame import Piece, spoilt_scan
from edge_server.opening import PER_THREAD, Opener
from protocol.codec.payload import Form, Head
from protocol.errors import CodecError
from protocol.inbox import Inbox
from protocol.messages import Scan
from protocol.scans import MAX_POINTS
from tests.waiting import PATIENCE_S, wait_until

THREADS = 2


def scan_of(agent: str, points: int = 0) -> Scan:
    payload = Head(Form.TREE, points, 0.02).seal()
    return Scan(
        frame=0,
        sim_time_ns=0,
        agent=agent,
        chunk=0,
        chunks=1,
        points=0,
        sensor_pose=np.zeros(6),
        sense_start_ns=0,
        sense_end_ns=0,
        encode_end_ns=0,
        payload=np.frombuffer(payload, np.uint8),
    )


@pytest.fixture
def make(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Opener]]:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(THREADS)))
    made = []

    def build(*given: Callable[..., object]) -> Opener:
        made.append(Opener(*given))
        return made[-1]

    yield build
    for opener in made:
        opener.close()


def names(openings: Iterator[object] | list[object]) -> list[str]:
    return [opening.piece().agent for opening in openings]


def test_scans_are_opened_at_the_same_time(make: Callable[..., Opener]) -> None:
    both = threading.Barrier(THREADS)

    def meet(scan: Scan, received_ns: int) -> Piece:
        both.wait(PATIENCE_S)
        return spoilt_scan(scan, received_ns)

    opener = make(meet)
    for agent in "ab":
        assert opener.put(scan_of(agent), 3) == []
    assert names(opener.rest()) == ["a", "b"]


def test_they_come_back_in_the_order_in_which_they_were_put(make: Callable[..., Opener]) -> None:
    gate, opened = threading.Event(), []

    def first_last(scan: Scan, received_ns: int) -> Piece:
        if scan.agent == "a":
            assert gate.wait(PATIENCE_S)
        opened.append(scan.agent)
        return spoilt_scan(scan, received_ns)

    opener = make(first_last)
    for agent in "abc":
        opener.put(scan_of(agent), 3)
    wait_until(lambda: opened == ["b", "c"])
    assert list(opener.done()) == []
    gate.set()
    assert names(opener.rest()) == ["a", "b", "c"]
    assert len(opener) == 0


def test_a_scan_that_does_not_decode_harms_no_other(make: Callable[..., Opener]) -> None:
    def picky(scan: Scan, received_ns: int) -> Piece:
        if scan.agent == "b":
            raise CodecError("no scan")
        return spoilt_scan(scan, received_ns)

    opener = make(picky)
    for agent in "abc":
        opener.put(scan_of(agent), 3)
    a, b, c = opener.rest()
    assert names([a, c]) == ["a", "c"]
    assert (b.scan.agent, b.received_ns) == ("b", 3)
    with pytest.raises(CodecError):
        b.piece()


def test_who_puts_more_than_threads_can_do_waits(make: Callable[..., Opener]) -> None:
    gate = threading.Event()

    def slow(scan: Scan, received_ns: int) -> Piece:
        assert gate.wait(PATIENCE_S)
        return spoilt_scan(scan, received_ns)

    opener = make(slow)
    most = THREADS * PER_THREAD
    for number in range(most):
        assert opener.put(scan_of(f"{number}"), 3) == []
    threading.Timer(0.02, gate.set).start()
    came = []
    for number in range(most, 50):
        came += opener.put(scan_of(f"{number}"), 3)
        assert gate.is_set()
        assert len(opener) <= most
    assert names([*came, *opener.rest()]) == [f"{number}" for number in range(50)]


def test_together_scans_claim_no_more_points_than_one_may(make: Callable[..., Opener]) -> None:
    opener = make(spoilt_scan)
    assert opener.put(scan_of("a", MAX_POINTS), 3) == []
    assert names(opener.put(scan_of("b", MAX_POINTS // 2), 3)) == ["a"]
    assert opener.put(scan_of("c", MAX_POINTS // 2), 3) == []
    assert names(opener.put(scan_of("d", 1), 3)) == ["b"]


@pytest.mark.parametrize("payload", [b"", b"SCAN but no scan", b"\xff" * 64])
def test_what_is_no_payload_claims_nothing(make: Callable[..., Opener], payload: bytes) -> None:
    opener = make(spoilt_scan)
    scan = scan_of("a").model_copy(update={"payload": np.frombuffer(payload, np.uint8)})
    for _ in range(THREADS * PER_THREAD):
        assert opener.put(scan, 3) == []


def test_whoever_waits_for_messages_is_woken(make: Callable[..., Opener]) -> None:
    inbox = Inbox()
    opener = make(spoilt_scan, inbox.wake)
    for agent in "ab":
        opener.put(scan_of(agent), 3)
        wait_until(lambda: inbox.get(PATIENCE_S) is None and len(list(opener.done())) == 1)


def test_what_nobody_has_begun_with_is_given_up_at_the_end(make: Callable[..., Opener]) -> None:
    gate, begun = threading.Event(), []
    others = set(threading.enumerate())

    def slow(scan: Scan, received_ns: int) -> Piece:
        begun.append(scan.agent)
        assert gate.wait(PATIENCE_S)
        return spoilt_scan(scan, received_ns)

    opener = make(slow)
    for agent in "abcd":
        opener.put(scan_of(agent), 3)
    wait_until(lambda: len(begun) == THREADS)
    threads = {t for t in threading.enumerate() if t.name.startswith("opening")} - others
    threading.Timer(0.02, gate.set).start()
    opener.close()
    assert sorted(begun) == ["a", "b"]
    assert len(opener) == 0
    assert sum(thread.is_alive() for thread in threads) == 0
