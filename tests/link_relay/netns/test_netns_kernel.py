"""Real namespaces: what the kernel does agrees with the profile, and nothing stays behind."""

import os
import subprocess
import time
from collections.abc import Callable, Iterator
from functools import partial
from statistics import median

import pytest

from link_relay.netns.forwarder import FIRST, Forwarder
from link_relay.netns.leftovers import remove_leftovers
from link_relay.netns.place import UPLINK, Place
from tests.link_relay.netns.made import made_by
from tests.link_relay.sink import Rig, rigs
from tests.waiting import wait_until

pytestmark = pytest.mark.root
MS = 1_000_000


def took_ns(rig: Rig, size: int) -> tuple[int, int]:
    """Sends a message; returns how long it took and how long the path says."""
    already = len(rig.sink.data)
    begin_ns = time.monotonic_ns()
    rig.agent.sendall(bytes(size))
    took_ns = rig.sink.arrival_ns(already + size) - begin_ns
    start_ns = begin_ns - rig.since_ns
    return took_ns, rig.path.departure_ns(start_ns, size) - start_ns


def queue_of(namespace: str) -> str:
    """Returns what the kernel says of the uplink's queue."""
    command = ["tc", "-netns", namespace, "qdisc", "show", "dev", UPLINK]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


@pytest.fixture
def make() -> Iterator[Callable[[str], Rig]]:
    with rigs(partial(Forwarder, delays=False)) as made:
        yield made
    assert made_by(os.getpid()) == []


@pytest.mark.usefixtures("undisturbed")
@pytest.mark.parametrize(
    ("name", "size"),
    [("800kbit", 30_000), ("5mbit", 55_000), ("50mbit", 200_000), ("lte", 60_000)],
)
def test_a_message_takes_its_bytes_over_the_rate(make, name, size):
    rig = make(name)
    pairs = [took_ns(rig, size) for _ in range(8)]
    took_ms, expected_ms = (median(column) / 1e6 for column in zip(*pairs, strict=True))
    assert took_ms == pytest.approx(expected_ms, rel=0.1)


def test_what_is_sent_without_connection_arrives_soon_after_it_is_back(make, tmp_path):
    trace = tmp_path / "outage.csv"
    trace.write_text("time_s,rate_mbps\n0,5\n0.4,0\n1.4,5\n5,5\n")
    rig = make(str(trace))
    namespace = Place(os.getpid(), FIRST).namespace
    wait_until(lambda: "rate 1Kbit" in queue_of(namespace))  # tbf's least, at which nothing moves
    took, expected = took_ns(rig, 30_000)
    assert took == pytest.approx(expected, abs=150 * MS)
    assert took > 600 * MS


def test_a_namespace_goes_with_its_agent(make):
    rig = make("5mbit")
    assert len(made_by(os.getpid())) == 2  # the namespace and the device on the host
    rig.agent.close()
    wait_until(lambda: not made_by(os.getpid()))


def test_leftovers_of_others_that_live_stay(make):
    make("5mbit")
    before = made_by(os.getpid())
    assert [place.pid for place in remove_leftovers()].count(os.getpid()) == 0
    assert made_by(os.getpid()) == before
