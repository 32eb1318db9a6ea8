"""The relay shapes real TCP connections; what it does agrees with the link in simulated time."""

import socket
import threading
import time
from collections.abc import Callable, Iterator
from statistics import fmean

import pytest

from link_relay.shaper import SLACK_NS, Shaper
from sensing.link.path import Path, on_air_bytes
from sensing.link.profile import LinkProfile
from sensing.link.virtual import VirtualLink
from tests.link_relay.sink import Rig, rigs

MS = 1_000_000
Make = Callable[[str], Rig]


@pytest.fixture
def make() -> Iterator[Make]:
    with rigs(Shaper) as made:
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
        virtual.append(link.send(now_ns - rig.since_ns, size).took_ns)
        rig.agent.sendall(bytes(size))
    emulated = [
        rig.sink.arrival_ns((number + 1) * size) - now_ns for number, now_ns in enumerate(sent)
    ]
    return fmean(virtual) / 1e6, fmean(emulated) / 1e6


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
    took_ns = rig.sink.arrival_ns(100_000) - begin_ns
    assert took_ns >= on_air_bytes(100_000) * 8 * 250 + 15 * MS - SLACK_NS
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
    path = Path.draw(LinkProfile(), 1, "a")
    shaper = Shaper(("127.0.0.1", 0), nowhere, lambda _: path)
    thread = threading.Thread(target=shaper.run)
    thread.start()
    with socket.create_connection(shaper.address) as agent:
        assert agent.recv(1) == b""
    shaper.stop()
    thread.join(10)
    assert not thread.is_alive()
