"""What holds of every relay, whether it shapes itself or has the kernel do it."""

import random
import socket
from collections.abc import Callable, Iterator
from functools import partial

import pytest

from link_relay.netns.forwarder import Forwarder
from link_relay.shaper import Shaper
from tests.link_relay.sink import Rig, rigs

RELAYS = (
    pytest.param(Shaper, id="shaper"),
    pytest.param(partial(Forwarder, delays=False), id="netns", marks=pytest.mark.root),
)


@pytest.fixture(params=RELAYS)
def make(request: pytest.FixtureRequest) -> Iterator[Callable[[str], Rig]]:
    with rigs(request.param) as made:
        yield made


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
    assert rig.sink.ended.wait(10)
    assert bytes(rig.sink.data) == b"last words"
