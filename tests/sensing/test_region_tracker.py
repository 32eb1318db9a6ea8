"""Regions that an agent publishes to."""

from protocol.regions import RegionMap
from sensing.regions import HYSTERESIS_M, RegionTracker
from tests.roads import lane, one_junction, signal

RANGE_M = 50.0


def region(name: str, x: float) -> RegionMap:
    """A road from x to 100 m farther, with a signal in its middle."""
    lanes = [
        lane("in", [(x, 0, 0), (x + 50, 0, 0)], "out"),
        lane("out", [(x + 50, 0, 0), (x + 100, 0, 0)]),
    ]
    return RegionMap.whole(one_junction(name, lanes, signal(name, ("in", "out"))), name)


def tracker() -> RegionTracker:
    regions = {"west": region("west", 0.0), "east": region("east", 100.0)}
    return RegionTracker(regions, RANGE_M)


def test_an_agent_belongs_to_all_regions_whose_roads_are_near():
    found = tracker()
    assert found.update("a", (20.0, 0.0)) == ("west",)
    assert found.update("a", (60.0, 0.0)) == ("west", "east")
    assert found.update("a", (180.0, 0.0)) == ("east",)


def test_it_leaves_later_than_it_entered():
    found = tracker()
    edge_m = 100.0 - RANGE_M
    places = (edge_m - 1, edge_m + 1, edge_m - HYSTERESIS_M + 1, edge_m - HYSTERESIS_M - 1)
    names = [found.update("a", (x, 0.0)) for x in places]
    assert names == [("west",), ("west", "east"), ("west", "east"), ("west",)]
    assert found.update("b", (edge_m - HYSTERESIS_M + 1, 0.0)) == ("west",)  # a newcomer


def test_far_from_all_roads_it_belongs_to_the_nearest():
    assert tracker().update("a", (500.0, 0.0)) == ("east",)


def test_who_was_forgotten_is_a_newcomer():
    found = tracker()
    found.update("a", (51.0, 0.0))
    found.forget_all_but([])
    assert found.update("a", (40.0, 0.0)) == ("west",)
