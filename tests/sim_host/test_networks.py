"""The built-in nets with several signals have roads and plans that every part of cpnet accepts."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from protocol.roadmap import Signal
from sensing.config import SceneConfig
from sensing.terrain import Terrain
from sim_host.cabinet import SignalCabinet
from sim_host.config import CabinetConfig
from sim_host.netfile import Net, read_net
from sim_host.networks import NETWORKS
from sim_host.road_map import read_signal, road_map

NAMES = sorted(NETWORKS)
SIGNALS = {"corridor": 5, "grid": 16, "town": 29}


@pytest.fixture(scope="module")
def nets(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Net]:
    folder = tmp_path_factory.mktemp("nets")
    return {name: read_net(write(folder)) for name, write in NETWORKS.items()}


@pytest.fixture(params=NAMES)
def net(request: pytest.FixtureRequest, nets: dict[str, Net]) -> Net:
    return nets[request.param]


def signals_of(net: Net) -> list[Signal]:
    return [read_signal(net, tls) for tls in net.programs]


def edges(net: Net) -> list[str]:
    return [edge for edge in net.edges if not edge.startswith(":")]


@pytest.mark.parametrize("name", NAMES)
def test_a_net_has_its_number_of_signals_and_its_name(nets, name):
    assert nets[name].path.name == f"{name}.net.xml"
    assert len(nets[name].programs) == SIGNALS[name]


def test_a_junction_has_a_signal_if_three_streets_or_more_meet_there(net):
    for junction in net.junctions.values():
        begun = [edge for edge in edges(net) if edge.startswith(junction.id)]  # START END
        assert (junction.id in net.programs) == (len(begun) >= 3)


def test_every_approach_of_every_signal_has_one_green_of_its_own(net):
    for signal in signals_of(net):
        approaches = {net.lanes[link.from_lane].edge for link in signal.links}
        assert len(signal.greens) == len(approaches) >= 3
        for green in signal.greens:
            going = {net.lanes[x.from_lane].edge for x in signal.links if green[x.index] == "G"}
            assert len(going) == 1
        assert all(any(g[link.index] == "G" for g in signal.greens) for link in signal.links)


def test_greens_are_protected_and_followed_by_yellow_and_all_red(net):
    for signal in signals_of(net):
        states = [phase.state for phase in signal.plan]
        assert not any(
            state[a] in "Gg" and state[b] in "Gg" for state in states for a, b in signal.conflicts
        )
        assert not any("g" in state for state in states)
        for green, yellow, red in zip(states[::3], states[1::3], states[2::3], strict=True):
            assert yellow == green.replace("G", "y")
            assert red == "r" * len(green)
        assert signal.offset_s == 0
        times = CabinetConfig()
        assert {p.duration_s for p in signal.plan[1::3]} == {times.yellow_s}
        assert {p.duration_s for p in signal.plan[2::3]} == {times.all_red_s}


def test_the_cabinet_takes_every_plan(net):
    for signal in signals_of(net):
        assert SignalCabinet(signal, CabinetConfig()).advance(0) == "r" * len(signal.plan[0].state)


def test_the_more_lanes_an_approach_has_the_longer_is_its_green(nets):
    signal = read_signal(nets["corridor"], "C0")
    green_s = {}
    for phase in signal.plan[::3]:
        lane = next(x.from_lane for x in signal.links if phase.state[x.index] == "G")
        green_s[nets["corridor"].lanes[lane].edge] = phase.duration_s
    assert green_s == {"northC0C0": 15, "southC0C0": 15, "B0C0": 20, "D0C0": 20}


def test_lanes_have_the_width_and_speed_of_a_city_street(net):
    for edge in edges(net):
        for lane in net.edges[edge]:
            assert net.lanes[lane].width_m == 3.5
            assert net.lanes[lane].speed_mps == 13.89
            assert 100 < net.lanes[lane].length_m < 300


def test_nobody_turns_round(net):
    for connection in net.connections:
        a, b = (lane.rsplit("_", 1)[0] for lane in (connection.from_lane, connection.to_lane))
        assert b not in {a[n:] + a[:n] for n in range(1, len(a))}  # ids are START END


def test_arterial_and_side_streets_have_their_lanes(nets):
    lanes = {edge: len(nets["corridor"].edges[edge]) for edge in edges(nets["corridor"])}
    assert {edge for edge, count in lanes.items() if count == 1} == {
        edge for edge in lanes if "north" in edge or "south" in edge
    }
    assert set(lanes.values()) == {1, 2}
    assert {len(nets["grid"].edges[edge]) for edge in edges(nets["grid"])} == {2}


def test_crossings_of_the_grid_are_200_m_apart(nets):
    centres = [nets["grid"].junctions[tls].centre for tls in nets["grid"].programs]
    gaps = [abs(a[0] - b[0]) + abs(a[1] - b[1]) for a, b in combinations(centres, 2)]
    assert min(gaps) == 200
    assert max(gaps) == 6 * 200


def test_the_town_has_three_way_and_four_way_signals_and_bent_streets(nets):
    town = nets["town"]
    greens = [len(signal.greens) for signal in signals_of(town)]
    assert greens.count(3) >= 5
    assert greens.count(4) >= 5
    shapes = [town.lanes[town.edges[edge][0]].shape for edge in edges(town)]
    assert sum(len(shape) > 2 for shape in shapes) > len(shapes) / 2


def test_the_road_map_holds_all_intersections_and_all_lanes(net):
    roads = road_map(net, "all")
    assert set(roads.by_tls) == set(net.programs)
    assert all(len(one.outline) >= 3 for one in roads.intersections)
    assert {lane.edge for lane in roads.lanes if not lane.internal} == set(edges(net))


def test_the_same_call_gives_the_same_bytes(nets, tmp_path: Path):
    for name in ("corridor", "town"):
        text = NETWORKS[name](tmp_path).read_text()
        assert text == nets[name].path.read_text()
        assert "generated on" not in text


def grades(net: Net) -> dict[str, float]:
    """Returns the steepest piece of each lane outside junctions, climb over length."""
    found = {}
    for lane in net.lanes.values():
        if not lane.internal:
            points = np.array(lane.shape)
            flat_m = np.hypot(*np.diff(points[:, :2], axis=0).T)
            climb_m = np.abs(np.diff(points[:, 2]))
            found[lane.id] = float((climb_m / flat_m)[flat_m > 1.0].max(initial=0.0))
    return found


def test_nets_are_level_unless_a_grade_is_asked_for(net):
    assert all(z == 0 for lane in net.lanes.values() for _, _, z in lane.shape)


@pytest.mark.parametrize("name", NAMES)
def test_lanes_follow_the_hills_and_none_is_steeper_than_asked_for(name, tmp_path):
    net = read_net(NETWORKS[name](tmp_path, grade=0.05))
    steepest = max(grades(net).values())
    assert 0.04 < steepest < 0.055
    heights_m = [z for lane in net.lanes.values() for _, _, z in lane.shape]
    assert max(heights_m) - min(heights_m) > 5
    for connection in net.connections:  # no steps where lanes join
        before = net.lanes[connection.from_lane].shape[-1]
        after = net.lanes[connection.via or connection.to_lane].shape[0]
        assert abs(before[2] - after[2]) < 0.05


def test_the_ground_follows_the_lanes_of_hills(tmp_path):
    roads = road_map(read_net(NETWORKS["town"](tmp_path, grade=0.05)), "all")
    terrain = Terrain(roads, SceneConfig(terrain_amplitude_m=0), 1)
    points = np.concatenate([lane.points for lane in roads.lanes])
    off_m = np.abs(terrain.height_m(points[:, :2]) - points[:, 2])
    assert off_m.max() < 0.4
    assert np.median(off_m) < 0.05


def test_town_bends(nets):
    turns = []
    for lane in nets["town"].lanes.values():
        if not lane.internal:
            step = np.diff(np.array(lane.shape)[:, :2], axis=0)
            bearing = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
            turns.append(np.degrees(np.ptp(bearing)))
    assert np.median(turns) > 10
