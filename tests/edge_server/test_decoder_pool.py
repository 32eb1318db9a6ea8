"""Decoder pool: threads decode scans, results come in the order of arrival."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from edge_server.decoding import PER_THREAD, DecoderPool
from edge_server.frame import Chunk
from protocol.codec.payload import Form, Head
from protocol.errors import CodecError
from protocol.inbox import Inbox
from protocol.limits import MAX_POINTS
from protocol.messages import Scan
from tests.waiting import TIMEOUT_S, wait_until

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
def make(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., DecoderPool]]:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(THREADS)))
    made = []

    def build(*given: Callable[..., object]) -> DecoderPool:
        made.append(DecoderPool(*given))
        return made[-1]

    yield build
    for pool in made:
        pool.close()


def names(pending: Iterator[object] | list[object]) -> list[str]:
    return [one.chunk().agent for one in pending]


def test_scans_are_opened_at_the_same_time(make: Callable[..., DecoderPool]) -> None:
    both = threading.Barrier(THREADS)

    def meet(scan: Scan, received_ns: int) -> Chunk:
        both.wait(TIMEOUT_S)
        return Chunk.undecodable(scan, received_ns)

    pool = make(meet)
    for agent in "ab":
        assert pool.put(scan_of(agent), 3) == []
    assert names(pool.rest()) == ["a", "b"]


def test_they_come_back_in_the_order_in_which_they_were_put(
    make: Callable[..., DecoderPool],
) -> None:
    gate, opened = threading.Event(), []

    def first_last(scan: Scan, received_ns: int) -> Chunk:
        if scan.agent == "a":
            assert gate.wait(TIMEOUT_S)
        opened.append(scan.agent)
        return Chunk.undecodable(scan, received_ns)

    pool = make(first_last)
    for agent in "abc":
        pool.put(scan_of(agent), 3)
    wait_until(lambda: opened == ["b", "c"])
    assert list(pool.done()) == []
    gate.set()
    assert names(pool.rest()) == ["a", "b", "c"]
    assert len(pool) == 0


def test_a_scan_that_does_not_decode_harms_no_other(make: Callable[..., DecoderPool]) -> None:
    def picky(scan: Scan, received_ns: int) -> Chunk:
        if scan.agent == "b":
            raise CodecError("no scan")
        return Chunk.undecodable(scan, received_ns)

    pool = make(picky)
    for agent in "abc":
        pool.put(scan_of(agent), 3)
    a, b, c = pool.rest()
    assert names([a, c]) == ["a", "c"]
    assert (b.scan.agent, b.received_ns) == ("b", 3)
    with pytest.raises(CodecError):
        b.chunk()


def test_who_puts_more_than_threads_can_do_waits(make: Callable[..., DecoderPool]) -> None:
    gate = threading.Event()

    def slow(scan: Scan, received_ns: int) -> Chunk:
        assert gate.wait(TIMEOUT_S)
        return Chunk.undecodable(scan, received_ns)

    pool = make(slow)
    most = THREADS * PER_THREAD
    for number in range(most):
        assert pool.put(scan_of(f"{number}"), 3) == []
    threading.Timer(0.02, gate.set).start()
    came = []
    for number in range(most, 50):
        came += pool.put(scan_of(f"{number}"), 3)
        assert gate.is_set()
        assert len(pool) <= most
    assert names([*came, *pool.rest()]) == [f"{number}" for number in range(50)]


def test_together_scans_claim_no_more_points_than_one_may(make: Callable[..., DecoderPool]) -> None:
    pool = make(Chunk.undecodable)
    assert pool.put(scan_of("a", MAX_POINTS), 3) == []
    assert names(pool.put(scan_of("b", MAX_POINTS // 2), 3)) == ["a"]
    assert pool.put(scan_of("c", MAX_POINTS // 2), 3) == []
    assert names(pool.put(scan_of("d", 1), 3)) == ["b"]


@pytest.mark.parametrize("payload", [b"", b"SCAN but no scan", b"\xff" * 64])
def test_what_is_no_payload_claims_nothing(
    make: Callable[..., DecoderPool], payload: bytes
) -> None:
    pool = make(Chunk.undecodable)
    scan = scan_of("a").model_copy(update={"payload": np.frombuffer(payload, np.uint8)})
    for _ in range(THREADS * PER_THREAD):
        assert pool.put(scan, 3) == []


def test_whoever_waits_for_messages_is_woken(make: Callable[..., DecoderPool]) -> None:
    inbox = Inbox()
    pool = make(Chunk.undecodable, inbox.wake)
    for agent in "ab":
        pool.put(scan_of(agent), 3)
        wait_until(lambda: inbox.get(TIMEOUT_S) is None and len(list(pool.done())) == 1)


def test_what_nobody_has_begun_with_is_given_up_at_the_end(
    make: Callable[..., DecoderPool],
) -> None:
    gate, begun = threading.Event(), []
    others = set(threading.enumerate())

    def slow(scan: Scan, received_ns: int) -> Chunk:
        begun.append(scan.agent)
        assert gate.wait(TIMEOUT_S)
        return Chunk.undecodable(scan, received_ns)

    pool = make(slow)
    for agent in "abcd":
        pool.put(scan_of(agent), 3)
    wait_until(lambda: len(begun) == THREADS)
    threads = {t for t in threading.enumerate() if t.name.startswith("decode")} - others
    threading.Timer(0.02, gate.set).start()
    pool.close()
    assert sorted(begun) == ["a", "b"]
    assert len(pool) == 0
    assert sum(thread.is_alive() for thread in threads) == 0
