"""Gaps that come from a router that went away."""

import pytest

from protocol.topics import BusName
from recording.losses import BusGaps, RestartGaps
from recording.tables import GapRow


class Bus:
    def __init__(self) -> None:
        self.name = "a"

    def router(self) -> str:
        return self.name


def watched() -> tuple[Bus, BusGaps]:
    bus = Bus()
    return bus, BusGaps(BusName.V2X, bus)


def test_a_router_that_stays_leaves_no_gap():
    _, reach = watched()
    reach.look(7, 100)
    assert reach.received(BusName.V2X, 8, 101) is None


@pytest.mark.parametrize("name", ["a", "b"])
def test_a_lost_router_leaves_a_gap_until_something_comes_through_the_next(name):
    bus, reach = watched()
    bus.name = ""
    reach.look(7, 100)
    reach.look(9, 110)
    assert reach.received(BusName.V2X, 8, 105) is None  # still on its way when the router died
    bus.name = name
    reach.look(9, 120)
    assert reach.received(BusName.WORLD, 20, 130) is None
    assert reach.received(BusName.V2X, 20, 130) == GapRow(7, "v2x", 20)
    assert reach.received(BusName.V2X, 21, 140) is None


def test_a_router_that_was_replaced_between_two_looks_leaves_one_as_well():
    bus, reach = watched()
    bus.name = "b"
    reach.look(7, 100)
    assert reach.received(BusName.V2X, 9, 101) == GapRow(7, "v2x", 9)


def test_what_waited_to_be_taken_while_the_router_was_replaced_ends_no_gap():
    bus, reach = watched()
    bus.name = "b"
    reach.look(40, 100)
    assert reach.received(BusName.V2X, 41, 90) is None  # came through "a"; 42 was lost with it
    assert reach.received(BusName.V2X, 44, 130) == GapRow(40, "v2x", 44)


def test_who_was_away_is_back_once_both_buses_are_heard():
    back = RestartGaps(7)
    assert back.received(BusName.WORLD, 20) == GapRow(7, "recorder", 20)
    assert back.received(BusName.WORLD, 21) is None
    assert back.received(BusName.V2X, 22) == GapRow(7, "recorder", 22)
    assert back.received(BusName.V2X, 23) is None
