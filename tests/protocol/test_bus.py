"""The buses over real Zenoh sessions on loopback."""

import socket
import struct
import time
from collections.abc import Iterator
from itertools import count

import numpy as np
import pytest
import zenoh

from protocol import bus as buses
from protocol import tcpinfo
from protocol.bus import Endpoint, ZenohBus, open_bus
from protocol.errors import BusError
from protocol.in_process import InProcessRouter
from protocol.inbox import Envelope, Inbox, Presence
from protocol.messages import End, Roster
from protocol.topics import ALIVE, BusName
from protocol.wire import encode
from tests.messages import SCAN
from tests.waiting import TIMEOUT_S, wait_until

WAIT_S = TIMEOUT_S


@pytest.fixture
def locator() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@pytest.fixture
def edge_inbox() -> Inbox:
    return Inbox()


@pytest.fixture
def router(locator: str, edge_inbox: Inbox) -> Iterator[ZenohBus]:
    bus = open_bus(BusName.V2X, Endpoint(locator, listen=True), edge_inbox)
    yield bus
    bus.close()


@pytest.fixture
def client_inbox() -> Inbox:
    return Inbox()


@pytest.fixture
def client(locator: str, router: ZenohBus, client_inbox: Inbox) -> Iterator[ZenohBus]:
    bus = open_bus(BusName.V2X, Endpoint(locator, listen=False), client_inbox)
    yield bus
    bus.close()


def repeated_bytes(bus: ZenohBus) -> int:
    """Returns what TCP has sent again: on a loaded machine it takes a late answer for a loss."""
    locator = bus._locator()
    assert locator is not None
    return tcpinfo._read(locator, 208, struct.Struct("@Q"))  # tcpi_bytes_retrans


def test_a_scan_crosses_tcp_and_its_bytes_are_counted(router, client, edge_inbox):
    router.subscribe("scan", region="r0")
    big = SCAN.model_copy(update={"payload": np.arange(300_000, dtype=np.uint8)})
    before = client.wire_bytes()
    size = client.publish("scan", big, region="r0", process="infra-r0", agent="rsu-0", chunk="0")
    item = edge_inbox.get(WAIT_S)
    assert isinstance(item, Envelope)
    assert np.array_equal(item.message.payload, big.payload)
    sent_bytes = client.wire_bytes() - before
    assert size <= sent_bytes
    assert sent_bytes - repeated_bytes(client) < 1.01 * size + 2000


def test_presence_comes_and_goes(router, locator, edge_inbox):
    router.watch()
    guest = open_bus(BusName.V2X, Endpoint(locator, listen=False), Inbox())
    guest.announce("vehicle", "vehicle-0")
    assert edge_inbox.get(WAIT_S) == Presence("vehicle", "vehicle-0", alive=True)
    guest.close()
    assert edge_inbox.get(WAIT_S) == Presence("vehicle", "vehicle-0", alive=False)


def test_who_speaks_to_all_at_once_is_heard_by_nobody(router, locator, client, edge_inbox):
    for topic in ("roster", "pose"):
        router.subscribe(topic, region="r0")
    router.watch()
    roster = Roster(frame=1, process="p", agents=[], scanning=[])
    with zenoh.open(
        buses._config(BusName.V2X, Endpoint(locator, listen=False), 10_000, buses.NOBODY)
    ) as hostile:
        tokens = [hostile.liveliness().declare_token(key) for key in ("**", f"{ALIVE}/**")]
        for key in ("**", "cpnet/v4/**", "cpnet/v4/r0/*/*/*", "cpnet/v4/r0/roster/*"):
            hostile.put(key, encode(roster))
        hostile.put("cpnet/v4/r0/roster/p", encode(roster))
        came: list[Envelope | Presence] = []
        until_s = time.monotonic() + WAIT_S
        while not (came and edge_inbox.drops["MessageError"] >= 7) and time.monotonic() < until_s:
            came += [item] if (item := edge_inbox.get(0.05)) is not None else []
        del tokens  # each expression is refused on its own thread, in no order
    assert [item.parts for item in came] == [{"region": "r0", "process": "p"}]
    assert edge_inbox.drops["MessageError"] >= 7


def test_a_port_in_use_is_named(router, locator):
    with pytest.raises(BusError, match=f"{locator} for the v2x bus: the port is in use"):
        open_bus(BusName.V2X, Endpoint(locator, listen=True), Inbox())


def test_a_silent_place_is_named(locator, monkeypatch):
    monkeypatch.setattr(buses, "CONNECT_TIMEOUT_MS", 200)
    with pytest.raises(BusError, match=f"nothing answers at {locator}"):
        open_bus(BusName.V2X, Endpoint(locator, listen=False), Inbox())


def test_what_the_host_serves_can_be_asked_for(locator):
    end = End(frames=3, reason="finished")
    host = open_bus(BusName.WORLD, Endpoint(locator, listen=True), Inbox())
    host.serve("end", end)
    asking = open_bus(BusName.WORLD, Endpoint(locator, listen=False), Inbox())
    assert asking.ask("end", End, WAIT_S) == end
    asking.close()
    host.close()


def test_a_topic_of_the_other_bus_is_refused(router):
    with pytest.raises(BusError, match="topic tick belongs to the world bus"):
        router.subscribe("tick")


def test_small_messages_of_one_sender_keep_their_order(router, client, edge_inbox):
    router.subscribe("roster", region="r0")
    for frame in range(200):
        roster = Roster(frame=frame, process="p", agents=[], scanning=[])
        client.publish("roster", roster, region="r0", process="p")
    frames = []
    for _ in range(200):
        item = edge_inbox.get(WAIT_S)
        assert isinstance(item, Envelope)
        frames.append(item.message.frame)
    assert frames == list(range(200))


@pytest.mark.parametrize("text", ["tcp/127.0.0.1:1", "listen:", "join:tcp/1.2.3.4:5"])
def test_an_endpoint_that_says_neither_listen_nor_connect_is_refused(text):
    with pytest.raises(BusError, match="needs listen:LOCATOR or connect:LOCATOR"):
        Endpoint.parse(text)


def until_subscribed(sender: ZenohBus, region: str, inbox: Inbox) -> None:
    """Sends rosters until the subscription of the other side has crossed, and all are there."""
    frames, latest = count(), -1

    def received() -> Envelope | Presence | None:
        nonlocal latest
        latest = next(frames)
        roster = Roster(frame=latest, process="p", agents=[], scanning=[])
        sender.publish("roster", roster, region=region, process="p")
        return inbox.get(0.05)

    item: Envelope | Presence | None = wait_until(received)
    while not (isinstance(item, Envelope) and item.message.frame == latest):
        item = inbox.get(WAIT_S)
        assert item is not None


def test_what_is_computed_within_one_process_is_what_the_kernel_counts(
    router, client, edge_inbox, client_inbox
):
    """Per message: 20 scans and rosters go up, 20 scans come down."""
    alone = InProcessRouter()
    computed, far = alone.bus(Inbox()), alone.bus(Inbox())
    for up, down in ((router, client), (far, computed)):
        for topic in ("scan", "roster"):
            up.subscribe(topic, region="up")
            down.subscribe(topic, region="down")
    until_subscribed(client, "up", edge_inbox)
    until_subscribed(router, "down", client_inbox)
    scan = SCAN.model_copy(update={"payload": np.zeros(7_000, np.uint8)})
    roster = Roster(frame=1, process="p", agents=["a", "b"], scanning=["a"])
    before, repeated = client.traffic(), repeated_bytes(client)
    for near, other in ((client, router), (computed, far)):
        for _ in range(20):
            where = {"process": "p", "agent": "a", "chunk": "0"}
            near.publish("scan", scan, region="up", **where)
            near.publish("roster", roster, region="up", process="p")
            other.publish("scan", scan, region="down", **where)
            if near is client:  # one after the other: Zenoh would send what waits as one
                assert all(edge_inbox.get(WAIT_S) is not None for _ in range(2))
                assert client_inbox.get(WAIT_S) is not None
    found, expected = client.traffic(), computed.traffic()
    sent_bytes = found.data_sent_bytes - before.data_sent_bytes
    sent_bytes -= repeated_bytes(client) - repeated
    received_bytes = found.data_received_bytes - before.data_received_bytes
    assert expected.data_sent_bytes == pytest.approx(sent_bytes, rel=0.02)
    assert expected.data_received_bytes == pytest.approx(received_bytes, rel=0.02)
    assert expected.sent_bytes == pytest.approx(found.sent_bytes - before.sent_bytes, rel=0.05)
