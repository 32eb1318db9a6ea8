"""Both buses within one process give what Zenoh would."""

from __future__ import annotations

import pytest

from protocol.errors import BusError
from protocol.in_process import InProcessBus, InProcessRouter
from protocol.inbox import Inbox, Presence
from protocol.messages import Plan, Roster
from protocol.topics import BusName
from tests.messages import EXAMPLES

ROSTER = Roster(frame=1, process="vehicle-0", agents=["a"], scanning=[])
[PLAN] = [example for example in EXAMPLES if isinstance(example, Plan)]


def access(router: InProcessRouter) -> tuple[InProcessBus, Inbox]:
    inbox = Inbox()
    return router.bus(inbox), inbox


def test_a_message_reaches_all_who_asked_for_its_topic_and_nobody_else():
    router = InProcessRouter(BusName.V2X)
    (one, first), (two, second), (_, third) = access(router), access(router), access(router)
    one.subscribe("roster")
    two.subscribe("roster", region="r0")
    size = one.publish("roster", ROSTER, region="r0", process="vehicle-0")
    for inbox in (first, second):
        item = inbox.get()
        assert item.message == ROSTER
        assert item.parts == {"region": "r0", "process": "vehicle-0"}
        assert len(item.data) == size
    assert third.get() is None


def test_parts_that_are_given_must_be_the_same():
    router = InProcessRouter(BusName.V2X)
    bus, inbox = access(router)
    bus.subscribe("plan", region="r0", agent="a")
    bus.publish("plan", PLAN, region="r0", agent="b")
    assert inbox.get() is None
    bus.publish("plan", PLAN, region="r0", agent="a")
    assert inbox.get() is not None


def test_messages_keep_their_order():
    router = InProcessRouter(BusName.V2X)
    bus, inbox = access(router)
    bus.subscribe("roster")
    for frame in range(20):
        roster = ROSTER.model_copy(update={"frame": frame})
        bus.publish("roster", roster, region="r0", process="vehicle-0")
    assert [inbox.get().message.frame for _ in range(20)] == list(range(20))


def test_presence_comes_and_goes_and_those_already_there_are_told():
    router = InProcessRouter(BusName.WORLD)
    (early, received), (late, received_late), (comer, _) = (
        access(router),
        access(router),
        access(router),
    )
    early.watch()
    comer.announce("vehicle", "vehicle-0")
    late.watch()
    comer.close()
    here = Presence("vehicle", "vehicle-0", True, BusName.WORLD)
    gone = Presence("vehicle", "vehicle-0", False, BusName.WORLD)
    assert [received.get(), received.get()] == [here, gone]
    assert [received_late.get(), received_late.get()] == [here, gone]


def test_a_closed_bus_hears_no_more():
    router = InProcessRouter(BusName.V2X)
    (gone, inbox), (other, _) = access(router), access(router)
    gone.subscribe("roster")
    gone.close()
    other.publish("roster", ROSTER, region="r0", process="vehicle-0")
    assert inbox.get() is None


def test_a_topic_of_the_other_bus_is_refused():
    bus, _ = access(InProcessRouter(BusName.WORLD))
    with pytest.raises(BusError, match="roster belongs to the v2x bus"):
        bus.publish("roster", ROSTER, region="r0", process="vehicle-0")
    with pytest.raises(BusError, match="roster belongs to the v2x bus"):
        bus.subscribe("roster")
