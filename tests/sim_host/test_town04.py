"""CARLA's Town04, where its net is at hand: a net made from OpenDRIVE, `<param>` and all."""

from pathlib import Path

import numpy as np
import pytest

from protocol.errors import ConfigError
from protocol.roadmap import RoadMap
from sensing.config import SceneConfig
from sensing.terrain import Terrain
from sim_host.config import TrafficConfig
from sim_host.demand import movements
from sim_host.netfile import Net, read_net
from sim_host.road_map import road_map

NET = Path(__file__).parents[3] / "shared" / "data" / "town04" / "Town04.net.xml"
pytestmark = pytest.mark.skipif(not NET.is_file(), reason=f"no Town04 net at {NET}")


@pytest.fixture(scope="module")
def net() -> Net:
    return read_net(NET)


@pytest.fixture(scope="module")
def roads(net: Net) -> RoadMap:
    return road_map(net, ["1368"])


def test_signal_1368_is_read_as_the_paper_describes_it(roads: RoadMap) -> None:
    assert roads.centre[:2] == (117.92, 412.14)
    assert roads.intersections[0].signal.greens == ["rrrrrGGGGGGGG", "GGGGGrrrrrrrr"]
    assert len(roads.intersections[0].signal.links) == 13
    assert roads.by_id["-40_0"].length_m == 237.10
    assert set(roads.intersections[0].signal.conflicts) == {(0, m) for m in range(5, 9)} | {
        (s, m) for s in range(1, 5) for m in range(5, 13)
    }


def test_short_approaches_are_extended_upstream(net: Net, roads: RoadMap) -> None:
    flows = {f.from_edge: f for f in movements(net, roads.intersections[0].signal, TrafficConfig())}
    assert flows["-40"].route == ["-40", "-41"]
    assert flows["41"].route[-2:] == ["41", "40"]
    assert len(flows["41"].route) == 3  # 193 m alone are less than 200


def test_every_signal_of_the_town_can_be_read(net: Net) -> None:
    for tls in sorted(net.programs):
        roads = road_map(net, [tls])
        assert roads.intersections[0].signal.greens
        assert roads.intersections[0].signal.conflicts


def test_an_unknown_signal_is_refused_with_some_of_the_known(net: Net) -> None:
    with pytest.raises(ConfigError, match="1008, 1103"):
        road_map(net, ["1"])


def test_every_lane_of_the_town_keeps_its_height_under_and_over_bridges(net: Net) -> None:
    roads = road_map(net, "all")
    terrain = Terrain(roads, SceneConfig(terrain_amplitude_m=0), 1)
    places = np.concatenate([lane.points for lane in roads.lanes])
    assert len(terrain.deck_mesh.triangles) > 0
    assert np.abs(terrain.height_m(places[:, :2], places[:, 2]) - places[:, 2]).max() < 0.2
