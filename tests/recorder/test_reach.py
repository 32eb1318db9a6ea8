"""Gaps that come from a router that went away."""

from protocol.topics import BusName
from recorder.reach import Reach
from recorder.tables import GapRow


class Bus:
    def __init__(self) -> None:
        self.name = "a"

    def router(self) -> str:
        return self.name


def watched() -> tuple[Bus, Reach]:
    bus = Bus()
    return bus, Reach(BusName.V2X, bus)


def test_a_router_that_stays_leaves_no_gap():
    _, reach = watched()
    reach.look(7)
    assert reach.heard(BusName.V2X, 8) is None


def test_a_lost_router_leaves_a_gap_until_something_comes_through_the_next():
    bus, reach = watched()
    bus.name = ""
    reach.look(7)
    reach.look(9)
    assert reach.heard(BusName.V2X, 8) is None  # still on its way to the role when the router died
    bus.name = "b"
    reach.look(9)
    assert reach.heard(BusName.WORLD, 20) is None
    assert reach.heard(BusName.V2X, 20) == GapRow(7, "v2x", 20)
    assert reach.heard(BusName.V2X, 21) is None


def test_a_router_that_was_replaced_between_two_looks_leaves_one_as_well():
    bus, reach = watched()
    bus.name = "b"
    reach.look(7)
    assert reach.heard(BusName.V2X, 9) == GapRow(7, "v2x", 9)
