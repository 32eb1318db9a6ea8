import threading

import pytest

from protocol.errors import BusError
from protocol.in_process import InProcessBus, InProcessRouter
from protocol.inbox import Inbox
from tests.waiting import wait_until
from vehicle_agent.role import Connections


class Network:
    """Opens a bus when it is let."""

    def __init__(self) -> None:
        self.local = InProcessRouter()
        self.may_open = threading.Event()

    def open(self) -> InProcessBus:
        assert self.may_open.wait(10)
        return self.local.bus(Inbox())


def test_in_the_background_nobody_waits_for_a_newcomer():
    network = Network()
    connections = Connections(network.open, wait=False)
    assert connections.get("a") is None
    assert connections.get("a") is None
    network.may_open.set()
    wait_until(lambda: connections.get("a"))
    assert connections.get("a") is connections.get("a")
    connections.close()
    assert network.local.buses == []


def test_an_agent_that_leaves_while_its_connection_opens_leaves_none_behind():
    network = Network()
    connections = Connections(network.open, wait=False)
    assert connections.get("a") is None
    connections.close_all_but(["b"])
    network.may_open.set()
    connections.close()
    assert network.local.buses == []


def test_in_lockstep_a_connection_is_waited_for_and_each_agent_has_its_own():
    network = Network()
    network.may_open.set()
    connections = Connections(network.open, wait=True)
    assert connections.get("a") is not connections.get("b")
    connections.close_all_but(["b"])
    assert network.local.buses == [connections.get("b")]
    connections.close()


def test_a_connection_that_cannot_be_opened_is_an_error():
    def refuse() -> InProcessBus:
        raise BusError("nothing answers")

    connections = Connections(refuse, wait=True)
    with pytest.raises(BusError, match="nothing answers"):
        connections.get("a")
    connections.close()
