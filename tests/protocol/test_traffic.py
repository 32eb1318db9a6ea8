"""Bytes on the wire, as they are computed where no transport counts them."""

from protocol.in_process import InProcessRouter
from protocol.inbox import Inbox
from protocol.traffic import Traffic, framed_bytes, on_air_bytes
from protocol.wire import encode
from tests.messages import SCAN

WHERE = {"region": "r0", "process": "infra-r0", "agent": "rsu-0", "chunk": "0"}
KEY = "cpnet/v4/r0/scan/infra-r0/rsu-0/0"


def test_a_message_takes_its_packets_and_an_acknowledgement_for_every_two():
    assert on_air_bytes(1448) == 1500
    assert on_air_bytes(1449) == 1449 + 2 * 52
    assert Traffic().sent(3000) == Traffic(data_sent_bytes=3156, acks_received_bytes=104)
    both = Traffic().sent(3000).received(100)
    assert (both.sent_bytes, both.received_bytes) == (3156 + 52, 152 + 104)


def test_within_a_process_each_bus_counts_what_it_publishes_and_what_it_subscribes_to():
    router = InProcessRouter()
    agent, edge, other = (router.bus(Inbox()) for _ in range(3))
    edge.subscribe("scan", region="r0")
    other.subscribe("scan", region="r1")
    agent.publish("scan", SCAN, **WHERE)
    size_bytes = framed_bytes(KEY, len(encode(SCAN)))
    assert agent.traffic() == Traffic().sent(size_bytes)
    assert edge.traffic() == Traffic().received(size_bytes)
    assert other.traffic() == Traffic()
