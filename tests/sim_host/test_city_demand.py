"""Demand for several signals loads them as much as was asked for, and SUMO can run it."""

import json
import re
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import pytest

from protocol.errors import ConfigError
from protocol.roadmap import Link, PlanPhase, Signal
from sim_host.city_demand import (
    SATURATION_FLOW_VPH,
    city_movements,
    degree_of_saturation,
    write_city_demand,
)
from sim_host.config import TrafficConfig
from sim_host.demand import Movement
from sim_host.junctions import Row, write_net, write_plain_net
from sim_host.netfile import Net, NetLane, read_net
from sim_host.networks import NETWORKS
from sim_host.road_map import read_signal
from tests.waiting import TIMEOUT_S


@pytest.fixture(scope="module")
def nets(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Net]:
    folder = tmp_path_factory.mktemp("nets")
    return {name: read_net(write(folder)) for name, write in NETWORKS.items()}


@pytest.fixture(params=sorted(NETWORKS))
def net(request: pytest.FixtureRequest, nets: dict[str, Net]) -> Net:
    return nets[request.param]


def signals_of(net: Net) -> list[Signal]:
    return [read_signal(net, tls) for tls in net.programs]


def approaches_of(net: Net) -> set[str]:
    return {net.lanes[x.from_lane].edge for signal in signals_of(net) for x in signal.links}


def passed(flows: list[Movement]) -> set[str]:
    """Returns the edges that a route leaves."""
    return {edge for flow in flows for edge in flow.route[:-1]}


@pytest.mark.parametrize("saturation", [0.4, 0.8])
def test_the_most_loaded_approach_has_the_degree_that_was_asked_for(net, tmp_path, saturation):
    degrees = write_city_demand(
        tmp_path / "x.rou.xml", net, signals_of(net), TrafficConfig(), saturation
    )
    assert set(degrees) == set(net.programs)
    assert max(degrees.values()) == pytest.approx(saturation)
    assert min(degrees.values()) > 0


def test_every_approach_of_the_built_in_nets_has_traffic(net):
    assert approaches_of(net) <= passed(city_movements(net, signals_of(net)))


def test_routes_lead_from_border_to_border_over_roads_that_follow_one_another(net):
    follows = {
        (net.lanes[c.from_lane].edge, net.lanes[c.to_lane].edge)
        for c in net.connections
        if not net.lanes[c.from_lane].internal
    }
    flows = city_movements(net, signals_of(net))
    reached = {b for _, b in follows}
    for flow in flows:
        assert flow.from_edge == flow.route[0] not in reached
        assert flow.to_edge == flow.route[-1]
        assert not any(a == flow.to_edge for a, _ in follows)
        assert set(pairwise(flow.route)) <= follows
        assert len(set(flow.route)) == len(flow.route)
    entries = {flow.from_edge for flow in flows}
    assert len(flows) == len(entries) * (len(entries) - 1)  # nobody goes back where he came from


def test_most_vehicles_go_straight_on(nets):
    flows = {
        (f.from_edge, f.to_edge): f for f in city_movements(nets["grid"], signals_of(nets["grid"]))
    }
    straight, turn = flows["westA1A1", "D1eastD1"], flows["westA1A1", "B3northB3"]
    assert turn.vph == pytest.approx(0.3 * straight.vph)
    assert straight.route == ["westA1A1", "A1B1", "B1C1", "C1D1", "D1eastD1"]
    assert len(turn.route) == 5
    arterial = {
        (f.from_edge, f.to_edge): f.vph
        for f in city_movements(nets["corridor"], signals_of(nets["corridor"]))
    }
    side = arterial["northC0C0", "C0southC0"]
    assert arterial["westA0", "E0east"] == pytest.approx(4 * side)  # two lanes to two, one to one


def test_equal_routes_over_the_grid_share_the_traffic(nets, tmp_path):
    net = nets["grid"]
    degrees = write_city_demand(tmp_path / "x.rou.xml", net, signals_of(net), TrafficConfig())
    assert min(degrees.values()) > 0.8 * max(degrees.values())


def test_the_same_net_gives_the_same_demand(nets, tmp_path):
    texts = []
    for name in ("a", "b"):
        path = tmp_path / name
        write_city_demand(path, nets["town"], signals_of(nets["town"]), TrafficConfig())
        texts.append(path.read_text())
    assert texts[0] == texts[1]


def test_flows_have_exponential_headways_and_the_mix_of_vehicles(nets, tmp_path):
    net = nets["corridor"]
    write_city_demand(tmp_path / "x.rou.xml", net, signals_of(net), TrafficConfig())
    root = ElementTree.parse(tmp_path / "x.rou.xml").getroot()
    flows = {flow.get("id"): flow for flow in root.iter("flow")}
    routes = {route.get("id"): route.get("edges") for route in root.iter("route")}
    expected = city_movements(net, signals_of(net))
    assert len(flows) == len(routes) == len(expected)
    for movement in expected:
        flow = flows[f"{movement.from_edge}-to-{movement.to_edge}"]
        assert routes[flow.get("route")] == " ".join(movement.route)
        assert flow.get("period") == f"exp({movement.vph / 3600:.9f})"
        assert flow.get("type") == "mix"
        assert (flow.get("departLane"), flow.get("departSpeed")) == ("best", "max")
    shares = [float(kind.get("probability", 0)) for kind in root.iter("vType")]
    assert shares == [spec.share for spec in TrafficConfig().vehicles]


def lane(edge: str, index: int) -> NetLane:
    return NetLane(f"{edge}_{index}", edge, 3.5, 13.89, 100.0, [], False, True, True)


def two_lanes(green_s: float) -> tuple[Net, Signal]:
    """Returns an approach with a lane to the right and straight on, and one straight and left."""
    net = Net(Path("x.net.xml"))
    lanes = [lane("in", 0), lane("in", 1), lane("right", 0), lane("on", 0), lane("left", 0)]
    net.lanes = {entry.id: entry for entry in lanes}
    pairs = [("in_0", "right_0"), ("in_0", "on_0"), ("in_1", "on_0"), ("in_1", "left_0")]
    links = [Link(index=i, from_lane=a, to_lane=b) for i, (a, b) in enumerate(pairs)]
    plan = [PlanPhase(duration_s=green_s, state="GGGG")]
    plan.append(PlanPhase(duration_s=100 - green_s, state="rrrr"))
    return net, Signal(tls="J", links=links, conflicts=[], plan=plan)


def flow(to_edge: str, vph: float) -> Movement:
    return Movement("in", to_edge, ["in", to_edge], vph)


@pytest.mark.parametrize(
    ("right", "on", "left", "lane_vph"),
    [
        (100, 400, 100, 300),  # both lanes alike
        (0, 400, 200, 300),  # who goes straight on leaves the left lane to others
        (10, 40, 450, 450),  # the left turn alone fills its lane
        (450, 10, 40, 450),
        (200, 0, 300, 300),
    ],
)
def test_the_degree_is_flow_over_capacity_of_the_fullest_lane(right, on, left, lane_vph):
    net, signal = two_lanes(green_s=25)
    flows = [flow("right", right), flow("on", on), flow("left", left)]
    expected = lane_vph / (SATURATION_FLOW_VPH * 0.25)
    assert degree_of_saturation(net, signal, flows) == pytest.approx(expected)


def test_more_green_means_a_lower_degree():
    flows = [flow("on", 500)]
    low, high = (degree_of_saturation(*two_lanes(green_s), flows) for green_s in (50, 25))
    assert high == pytest.approx(2 * low)


def test_traffic_over_a_link_that_is_never_green_is_an_error():
    net, signal = two_lanes(green_s=0)
    with pytest.raises(ConfigError, match="signal J is never green from edge in to on"):
        degree_of_saturation(net, signal, [flow("on", 1)])


def rows(places: dict[str, tuple[float, float]], streets: list[tuple[str, str]]):
    nodes: list[Row] = [{"id": name, "x": x, "y": y} for name, (x, y) in places.items()]
    ends = [end for street in streets for end in street]
    for node in nodes:
        if ends.count(str(node["id"])) > 2:
            node |= {"type": "traffic_light", "tl": str(node["id"])}
    both = [pair for a, b in streets for pair in ((a, b), (b, a))]
    edges: list[Row] = [{"id": f"{a}{b}", "from": a, "to": b} for a, b in both]
    return {"node": nodes, "edge": edges}


def test_a_net_without_border_gets_trips_between_edges_far_from_each_other(tmp_path):
    size = range(3)
    places = {f"{x}{y}": (200.0 * x, 200.0 * y) for x in size for y in size}
    streets = [(f"{x}{y}", f"{x + 1}{y}") for x in range(2) for y in size]
    streets += [(f"{x}{y}", f"{x}{y + 1}") for x in size for y in range(2)]
    net = read_net(write_plain_net(tmp_path, "ring", rows(places, streets)))
    signals = signals_of(net)
    flows = city_movements(net, signals)
    assert len(signals) == 5
    assert approaches_of(net) <= passed(flows)
    for trip in flows:
        (ax, ay, _), (bx, by, _) = (
            net.lanes[f"{trip.from_edge}_0"].shape[0],
            net.lanes[f"{trip.to_edge}_0"].shape[-1],
        )
        assert abs(ax - bx) + abs(ay - by) > 250


def test_a_turnaround_at_the_end_of_a_road_leaves_it_an_entry(nets, tmp_path):
    path = nets["corridor"].path
    extra = (
        '<connection from="E0east" to="eastE0" fromLane="1" toLane="1" dir="t" state="M"/></net>'
    )
    turned = tmp_path / "turned.net.xml"
    turned.write_text(path.read_text().replace("</net>", extra))
    net = read_net(turned)
    before = city_movements(nets["corridor"], signals_of(nets["corridor"]))
    assert city_movements(net, signals_of(net)) == before


def test_a_signal_that_no_route_passes_is_named(tmp_path):
    # The only way is west to east; the loop in the north leads nowhere.
    places = {"w": (-200, 0), "a": (0, 0), "e": (200, 0), "n": (0, 200)}
    places |= {"l": (-100, 300), "r": (100, 300)}
    streets = [("w", "a"), ("a", "e"), ("a", "n"), ("n", "l"), ("n", "r"), ("l", "r")]
    net = read_net(write_plain_net(tmp_path, "loop", rows(places, streets)))
    with pytest.raises(
        ConfigError, match=r"junction without demand: none of 2 routes .* signal n;"
    ):
        city_movements(net, signals_of(net))
    assert city_movements(net, [read_signal(net, "a")])


def test_a_net_without_any_route_is_refused(tmp_path):
    parts = rows({"a": (0, 0), "b": (200, 0)}, [("a", "b")])
    net = read_net(write_plain_net(tmp_path, "road", parts))
    with pytest.raises(ConfigError, match=r"no route for passenger cars .*2 entries, 2 exits"):
        city_movements(net, [])


def test_a_net_without_a_road_for_cars_is_refused(tmp_path):
    parts = rows({"a": (0, 0), "b": (200, 0)}, [("a", "b")])
    for row in parts["edge"]:
        row["allow"] = "rail"
    net = read_net(write_plain_net(tmp_path, "rails", parts))
    with pytest.raises(ConfigError, match=r"no route for passenger cars .*0 entries, 0 exits"):
        city_movements(net, [])


@pytest.mark.parametrize("saturation", [0, -1, float("nan"), float("inf")])
def test_a_saturation_out_of_range_is_refused(nets, saturation):
    with pytest.raises(ConfigError, match="saturation is .*, allowed: more than 0"):
        city_movements(nets["corridor"], signals_of(nets["corridor"]), saturation)


def test_a_net_without_signals_is_refused(nets):
    with pytest.raises(ConfigError, match="needs one or more"):
        city_movements(nets["corridor"], [])


def test_a_net_with_too_many_pairs_is_refused(nets, monkeypatch):
    monkeypatch.setattr("sim_host.city_demand._MAX_FLOWS", 100)
    with pytest.raises(ConfigError, match="12 entries and 12 exits, allowed are 100 pairs"):
        city_movements(nets["corridor"], signals_of(nets["corridor"]))


def test_one_signal_alone_gets_a_demand_as_well(tmp_path):
    net = read_net(write_net(tmp_path))
    (signal,) = signals_of(net)
    flows = city_movements(net, [signal], 0.5)
    assert {f.from_edge for f in flows} == {"west_in", "east_in", "north_in"}
    assert degree_of_saturation(net, signal, flows) == pytest.approx(0.5)


RUN = """
import json, sys
import libsumo
net, routes = sys.argv[1:]
libsumo.start(["sumo", "-n", net, "-r", routes, "--step-length", "1", "--seed", "1",
               "--no-step-log", "true", "--xml-validation", "never"])
seen, teleports = {}, 0
for _ in range(300):
    libsumo.simulationStep()
    teleports += libsumo.simulation.getStartingTeleportNumber()
    for name in libsumo.vehicle.getIDList():
        seen.setdefault(libsumo.vehicle.getRoadID(name), set()).add(name)
waiting = len(libsumo.simulation.getPendingVehicles())
libsumo.close()
print(json.dumps({"edges": sorted(seen), "teleports": teleports, "waiting": waiting,
                  "vehicles": len(set().union(*seen.values()))}))
"""


def test_sumo_runs_the_grid_without_teleports_and_with_vehicles_on_all_approaches(nets, tmp_path):
    net, routes = nets["grid"], tmp_path / "grid.rou.xml"
    write_city_demand(routes, net, signals_of(net), TrafficConfig())
    done = subprocess.run(
        [sys.executable, "-c", RUN, str(net.path), str(routes)],
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=True,
    )
    result = json.loads(done.stdout.splitlines()[-1])
    assert result["teleports"] == 0
    assert result["waiting"] < 10
    assert approaches_of(net) <= set(result["edges"])
    rates = re.findall(r"exp\(([\d.]+)\)", routes.read_text())
    expected = 300 * sum(float(rate) for rate in rates)
    assert result["vehicles"] == pytest.approx(expected, rel=0.15)
