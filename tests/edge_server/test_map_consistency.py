"""Map consistency: scores where the map has all lanes; elsewhere None."""

import numpy as np
import pytest

from edge_server.map_consistency import MapConsistency
from perception.arrays import Floats
from perception.roadway import Roadway
from protocol.regions import RegionMap
from protocol.roadmap import MAP_RADIUS_M
from tests.roads import junction_road, lane, one_junction, signal


@pytest.fixture(scope="module")
def judge() -> MapConsistency:
    """A map as it is read from a net: its longest lane leads far beyond the radius."""
    road = junction_road()
    far = lane("long_0", [(200, -1.75, 0), (1900, -1.75, 0)])
    whole = one_junction("test", [*road.lanes, far], signal("j", ("in_0", "out_0")))
    return MapConsistency(RegionMap.whole(whole), Roadway.of(whole, margin_m=0.5))


def at(x: float, y: float) -> Floats:
    return np.array([x, y, 0, 0, 0, 0], float)


def test_a_place_on_a_lane_fits_and_one_in_a_house_does_not(judge: MapConsistency):
    assert judge.on_road(at(-100, 0), 0.05) == 1.0
    assert judge.on_road(at(-100, 40), 0.05) == 0.0
    assert judge.on_road(at(-100, 200), 0.05) == 0.0


@pytest.mark.parametrize("place", [(MAP_RADIUS_M + 5, 8), (900, 60), (350, -350), (-2000, 0)])
def test_beyond_the_map_a_place_is_neither_right_nor_wrong(
    judge: MapConsistency, place: tuple[float, float]
):
    assert judge.on_road(at(*place), 0.05) is None


def test_beyond_the_map_a_vehicle_may_be_as_fast_as_on_a_motorway(judge: MapConsistency):
    assert judge.fastest_mps(at(0, 0)) == pytest.approx(1.5 * 13.9)
    assert judge.fastest_mps(at(-900, 0)) == pytest.approx(1.5 * 130 / 3.6, rel=0.01)


def test_beyond_the_lanes_that_a_region_was_given_it_knows_none():
    road = junction_road()
    around = RegionMap("r0", road, road, np.zeros((1, 3)), np.array([[-320, -130], [200, 20]]))
    assert around.knows(0, 0)
    assert not around.knows(0, 100)
