"""The relay shapes real TCP connections; what it does agrees with the link in simulated time."""

import random
import socket
import threading
import time
from collections.abc import Callable, Iterator
from statistics import fmean, median

import pytest

from link_relay.shaper import SLACK_NS, Shaper
from protocol.traffic import on_air_bytes
from sensing.link_channel import Channel, VirtualLink
from sensing.link_profile import LinkProfile
from tests.kernel_links import receive_whole, shaped_connection
from tests.link_relay.sink import Rig, rigs
from tests.waiting import TIMEOUT_S

MS = 1_000_000
Make = Callable[[str], Rig]


@pytest.fixture
def make() -> Iterator[Make]:
    with rigs() as made:
        yield made


def compare(make: Make, name: str, size: int, messages: int = 20) -> tuple[float, float]:
    """Returns the mean latency in ms, virtual and emulated, of a message every 100 ms."""
    rig = make(name)
    link = VirtualLink(rig.path)
    virtual, sent = [], []
    begin_ns = time.monotonic_ns()
    for number in range(messages):
        time.sleep(max(0, begin_ns + number * 100 * MS - time.monotonic_ns()) / 1e9)
        now_ns = time.monotonic_ns()
        sent.append(now_ns)
        virtual.append(link.send(now_ns - rig.since_ns, size).latency_ns)
        rig.agent.sendall(bytes(size))
    emulated = [
        rig.sink.arrival_ns((number + 1) * size) - now_ns for number, now_ns in enumerate(sent)
    ]
    return fmean(virtual) / 1e6, fmean(emulated) / 1e6


def test_bytes_come_out_as_they_went_in_both_ways(make):
    rig = make("50mbit,4ms")
    data = random.Random(1).randbytes(300_000)
    rig.agent.sendall(data)
    rig.sink.arrival_ns(len(data))
    assert bytes(rig.sink.data) == data
    assert rig.sink.peer is not None
    rig.sink.peer.sendall(data[:1000])
    back = b""
    while len(back) < 1000:
        back += rig.agent.recv(1000)
    assert back == data[:1000]


def test_what_the_link_does_not_take_stays_with_the_sender(make):
    rig = make("200kbit")
    rig.agent.sendall(bytes(150_000))
    rig.sink.arrival_ns(5_000)  # 0.2 s at this rate: buffers before the link are full by then
    assert rig.unsent_bytes() > 100_000


def test_a_connection_that_the_agent_ends_ends_at_the_edge(make):
    rig = make("5mbit,20ms")
    rig.agent.sendall(b"last words")
    rig.agent.shutdown(socket.SHUT_WR)
    assert rig.sink.ended.wait(TIMEOUT_S)
    assert bytes(rig.sink.data) == b"last words"


@pytest.mark.usefixtures("undisturbed")
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "size"),
    [
        ("5mbit,20ms", 10_000),
        ("5mbit,20ms", 55_000),
        ("50mbit,40ms", 60_000),
        ("lte", 20_000),
        ("5g-weak", 20_000),
    ],
)
def test_virtual_and_emulated_links_agree_on_mean_latency_within_10_percent(make, name, size):
    for _ in range(5):
        virtual_ms, emulated_ms = compare(make, name, size)
        if abs(emulated_ms - virtual_ms) <= 0.1 * virtual_ms:
            return
    pytest.fail(f"virtual {virtual_ms:.1f} ms, emulated {emulated_ms:.1f} ms")


def test_nothing_comes_faster_than_the_link_carries(make):
    rig = make("4mbit,30ms")
    begin_ns = time.monotonic_ns()
    rig.agent.sendall(bytes(100_000))
    latency_ns = rig.sink.arrival_ns(100_000) - begin_ns
    assert latency_ns >= on_air_bytes(100_000) * 8 * 250 + 15 * MS - SLACK_NS
    for when_ns, count in rig.sink.marks:
        assert count * 8 * 250 <= when_ns - begin_ns + SLACK_NS


def test_the_answer_takes_half_a_round_trip(make):
    rig = make("100mbit,60ms")
    assert rig.sink.peer is not None
    begin_ns = time.monotonic_ns()
    rig.sink.peer.sendall(b"enough")
    assert rig.agent.recv(10) == b"enough"
    assert time.monotonic_ns() - begin_ns >= 30 * MS


def test_an_edge_that_is_not_there_ends_the_agents_connection():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        nowhere = taken.getsockname()
    path = Channel.draw(LinkProfile(), 1, "a")
    shaper = Shaper(("127.0.0.1", 0), nowhere, lambda _: path)
    thread = threading.Thread(target=shaper.run)
    thread.start()
    with socket.create_connection(shaper.address) as agent:
        assert agent.recv(1) == b""
    shaper.stop()
    thread.join(TIMEOUT_S)
    assert not thread.is_alive()


@pytest.mark.root
@pytest.mark.usefixtures("undisturbed")
def test_the_relay_takes_as_long_as_a_link_that_the_kernel_shapes(make):
    size, rig = 60_000, make("5mbit")
    relayed_ms, kernel_ms = [], []
    with shaped_connection(5_000_000) as (sender, receiver):
        for number in range(1, 9):
            begin_ns = time.monotonic_ns()
            rig.agent.sendall(bytes(size))
            relayed_ms.append((rig.sink.arrival_ns(number * size) - begin_ns) / 1e6)
            begin_ns = time.monotonic_ns()
            sender.sendall(bytes(size))
            receive_whole(receiver, size)
            kernel_ms.append((time.monotonic_ns() - begin_ns) / 1e6)
    assert median(relayed_ms) == pytest.approx(median(kernel_ms), rel=0.1)
