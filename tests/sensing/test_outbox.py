"""The outbox: which chunks an agent sends, and which it drops, when its uplink is slow."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import pytest

from protocol.errors import BusError
from sensing import uplink as module
from sensing.uplink import Outbox
from tests.waiting import TIMEOUT_S, wait_until


class Parcel:
    """A frame whose chunks pass a gate one by one."""

    def __init__(self, frame: int, gate: Callable[[int], None], chunks: int = 4) -> None:
        self.frame, self.chunks = frame, chunks
        self.gate = gate
        self.sent: list[int] = []

    def send(self, chunk: int) -> int:
        self.gate(chunk)
        self.sent.append(chunk)
        return 1000


def passes(_: int) -> None:
    return


def done(outbox: Outbox) -> list[int]:
    """Waits until the outbox is done with something; returns the frames."""
    return wait_until(lambda: [upload.frame for upload in outbox.take_done()])


@pytest.fixture
def outbox():
    made = Outbox("a")
    yield made
    made.close()


class Gate:
    """Holds the sender up at a chunk until it is opened."""

    def __init__(self, at: int) -> None:
        self.at = at
        self.reached, self.opened = threading.Event(), threading.Event()

    def __call__(self, chunk: int) -> None:
        if chunk == self.at:
            self.reached.set()
            assert self.opened.wait(TIMEOUT_S)


def test_a_fast_uplink_takes_all_chunks_in_their_order(outbox: Outbox) -> None:
    parcel = Parcel(0, passes)
    outbox.put(parcel)
    assert done(outbox) == [0]
    assert parcel.sent == [0, 1, 2, 3]
    assert outbox.unsent == 0


def test_a_newer_frame_takes_the_place_of_the_rest_of_an_older_one(outbox: Outbox) -> None:
    gate = Gate(1)
    old, newer, newest = Parcel(0, gate), Parcel(1, passes), Parcel(2, passes)
    outbox.put(old)
    assert gate.reached.wait(TIMEOUT_S)
    outbox.put(newer)
    outbox.put(newest)
    gate.opened.set()
    frames = done(outbox)
    while frames[-1] != 2:
        frames += done(outbox)
    assert frames == [0, 2]
    assert (old.sent, newer.sent, newest.sent) == ([0, 1], [], [0, 1, 2, 3])
    assert outbox.unsent == 2 + 4


def test_no_more_chunks_go_out_when_the_edge_has_enough(outbox: Outbox) -> None:
    gate = Gate(1)
    parcel = Parcel(5, gate)
    outbox.put(parcel)
    assert gate.reached.wait(TIMEOUT_S)
    outbox.receive(enough=5, mbps=0.0)
    gate.opened.set()
    assert done(outbox) == [5]
    assert parcel.sent == [0, 1]
    assert outbox.unsent == 0


def test_chunks_leave_at_the_rate_of_the_uplink(outbox: Outbox) -> None:
    outbox.receive(enough=-1, mbps=0.2)  # 40 ms a chunk
    times_ns: list[int] = []
    outbox.put(Parcel(0, lambda _: times_ns.append(time.monotonic_ns())))
    done(outbox)
    took_s = (times_ns[-1] - times_ns[0]) / 1e9
    assert took_s >= 3 * 0.040 - 2 * module.EARLY_NS / 1e9


def test_the_queue_below_never_holds_more_than_a_chunk_and_a_little(outbox: Outbox) -> None:
    """An uplink of 1 Mbit/s is given 4 kB every 20 ms: what waits in it stays bounded."""
    queue_ns, free_ns = [], 0

    def link(_: int) -> None:
        nonlocal free_ns
        now_ns = time.monotonic_ns()
        free_ns = max(free_ns, now_ns) + 8_000_000  # 1000 bytes at 1 Mbit/s
        queue_ns.append(free_ns - now_ns)

    outbox.receive(enough=-1, mbps=1.0)
    for frame in range(15):
        outbox.put(Parcel(frame, link))
        time.sleep(0.02)
    assert max(queue_ns) <= 8_000_000 + 8_000_000 + 2 * module.EARLY_NS
    assert outbox.unsent > 0


def test_a_flood_of_one_agent_is_in_nobody_elses_way(outbox: Outbox) -> None:
    other, gate = Outbox("b"), Gate(0)
    try:
        outbox.put(Parcel(0, gate))
        assert gate.reached.wait(TIMEOUT_S)
        for frame in range(50):
            outbox.put(Parcel(frame, passes))
        other.put(Parcel(0, passes))
        assert done(other) == [0]
        assert outbox.take_done() == []
    finally:
        gate.opened.set()
        other.close()


def test_what_fails_in_the_thread_is_raised_at_the_next_frame(outbox: Outbox) -> None:
    def breaks(_: int) -> None:
        raise BusError("gone")

    outbox.put(Parcel(0, breaks))
    outbox._thread.join(TIMEOUT_S)
    with pytest.raises(BusError, match="gone"):
        outbox.put(Parcel(1, passes))
