"""Real namespaces: what the kernel does agrees with the profile, and nothing stays behind."""

import os
import random
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path as File
from statistics import fmean

import pytest

from link_relay.netns.enter import NAMESPACES
from link_relay.netns.forwarder import Forwarder
from link_relay.netns.leftovers import remove_leftovers
from link_relay.netns.place import Place
from protocol.tcpinfo import unsent_bytes
from sensing.link.named import profile_named
from sensing.link.path import Path
from sensing.link.profile import LinkProfile
from tests.link_relay.sink import Sink

pytestmark = pytest.mark.root
MS = 1_000_000


def made_by(pid: int) -> list[str]:
    """Returns the namespaces and devices that a process has made and that are there."""
    names = [
        entry.name
        for folder in (NAMESPACES, File("/sys/class/net"))
        for entry in folder.glob("cp*")
    ]
    return [name for name in names if (place := Place.of(name)) and place.pid == pid]


class Rig:
    """A relay with namespaces before a sink, and one connection to it."""

    def __init__(self, name: str) -> None:
        self.path = Path.draw(profile_named(name) or LinkProfile(), 1, "vehicle 0")
        self.sink = Sink()
        self.since_ns = time.monotonic_ns()
        listen = ("127.0.0.1", 0)
        self.relay = Forwarder(listen, self.sink.address, lambda _: self.path, delays=False)
        self.thread = threading.Thread(target=self.relay.run)
        self.thread.start()
        self.agent = socket.create_connection(self.relay.address)
        self.agent.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.agent.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 20)
        assert self.sink.accepted.wait(10)

    def took_ns(self, size: int) -> tuple[int, int]:
        """Sends a message; returns how long it took and how long the path says."""
        already = len(self.sink.data)
        begin_ns = time.monotonic_ns()
        self.agent.sendall(bytes(size))
        took_ns = self.sink.arrival_ns(already + size) - begin_ns
        start_ns = begin_ns - self.since_ns
        return took_ns, self.path.departure_ns(start_ns, size) - start_ns

    def close(self) -> None:
        self.agent.close()
        self.relay.stop()
        self.thread.join(20)
        assert not self.thread.is_alive()
        assert self.sink.ended.wait(10)
        self.sink.server.close()


@pytest.fixture
def make() -> Iterator[type[Rig]]:
    made: list[Rig] = []

    class Kept(Rig):
        def __init__(self, name: str) -> None:
            super().__init__(name)
            made.append(self)

    yield Kept
    for rig in made:
        rig.close()
    assert made_by(os.getpid()) == []


@pytest.mark.parametrize(
    ("name", "size"),
    [("800kbit", 30_000), ("5mbit", 55_000), ("50mbit", 200_000), ("lte", 60_000)],
)
def test_a_message_takes_its_bytes_over_the_rate(make, name, size):
    rig = make(name)
    pairs = [rig.took_ns(size) for _ in range(8)]
    took_ms, expected_ms = (fmean(column) / 1e6 for column in zip(*pairs, strict=True))
    assert took_ms == pytest.approx(expected_ms, rel=0.1)


def test_what_is_sent_without_connection_arrives_soon_after_it_is_back(make, tmp_path):
    trace = tmp_path / "outage.csv"
    trace.write_text("time_s,rate_mbps\n0,5\n0.4,0\n1.4,5\n5,5\n")
    rig = make(str(trace))
    while rig.path.rate_bps.at(time.monotonic_ns() - rig.since_ns) > 0:
        time.sleep(0.01)
    time.sleep(0.1)  # the kernel is told at the next step
    took_ns, expected_ns = rig.took_ns(30_000)
    assert took_ns == pytest.approx(expected_ns, abs=150 * MS)
    assert took_ns > 600 * MS


def test_bytes_come_out_as_they_went_in_both_ways(make):
    rig = make("50mbit")
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
    time.sleep(0.3)
    host, port = rig.agent.getsockname()
    assert unsent_bytes(f"tcp/{host}:{port}") > 100_000


def test_a_namespace_goes_with_its_agent(make):
    rig = make("5mbit")
    assert len(made_by(os.getpid())) == 2  # the namespace and the device on the host
    rig.agent.sendall(b"last words")
    rig.agent.shutdown(socket.SHUT_WR)
    assert rig.sink.ended.wait(10)
    assert bytes(rig.sink.data) == b"last words"
    give_up_ns = time.monotonic_ns() + 10_000 * MS
    while made_by(os.getpid()):
        assert time.monotonic_ns() < give_up_ns
        time.sleep(0.01)


def test_leftovers_of_others_that_live_stay(make):
    make("5mbit")
    before = made_by(os.getpid())
    assert [place.pid for place in remove_leftovers()].count(os.getpid()) == 0
    assert made_by(os.getpid()) == before
