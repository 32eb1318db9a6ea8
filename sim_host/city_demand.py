"""Demand for a net with several signals: fixed routes from border to border, scaled to the plans.

The model has three steps:

1. Trips spread over pairs of an entry and an exit as in a gravity model without counts: in
   proportion to the lanes of the entry and of the exit, and by a factor of 0.3 for each turn on the
   route. The factor is chosen: with it three of four vehicles or more go straight on at the signals
   of the built-in nets, near the 80 % (10 % turn each way) that is a usual assumption for a signal
   without counts.
2. Drivers take the fastest free-flow route (Dijkstra over edges, 5 s for each turn). Travel times
   are perceived with an error of up to 20 %, drawn once for each entry and edge (Burrell's
   multiple-route assignment, 1968): otherwise one of many equal routes in a grid would get all.
3. All flows are scaled together until the most loaded approach has the degree of saturation that
   was asked for.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from heapq import heappop, heappush
from itertools import combinations, pairwise
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from protocol.errors import ConfigError
from protocol.roadmap import Signal
from sim_host.config import TrafficConfig
from sim_host.demand import MIX, Movement, movement_name, vehicle_type_lines
from sim_host.netfile import TURNAROUND_DEG, Net, NetConnection, Point

SATURATION_FLOW_VPH = 1800.0
SATURATION = 0.8
_TURN_WEIGHT, _TURN_S = 0.3, 5.0
_TIME_ERROR, _SEED = 0.2, 0  # of the travel times that drivers perceive
_TURN_DEG = 45.0
_SAME_PLACE_M = 50.0  # a trip that ends this near to where it began has turned round
_MAX_FAR_EDGES = 40  # entries and exits of a net without a border
_MAX_FLOWS = 10_000
_LISTED = 20

Pair = tuple[str, str]


def write_city_demand(
    path: Path,
    net: Net,
    signals: Sequence[Signal],
    config: TrafficConfig,
    saturation: float = SATURATION,
) -> dict[str, float]:
    """Writes vehicle types, routes and flows with exponential headways as a SUMO route file.

    Returns the degree of saturation of each signal by its id; see `degree_of_saturation`.

    Raises:
        ConfigError: see `city_movements`.
    """
    flows = city_movements(net, signals, saturation)
    lines = ["<routes>", *vehicle_type_lines(config.vehicles)]
    for flow in flows:
        name, edges = quoteattr(movement_name(flow, net)), quoteattr(" ".join(flow.route))
        lines.append(f"  <route id={name} edges={edges}/>")
        lines.append(
            f'  <flow id={name} route={name} type="{MIX}" begin="0" end="1e7" '
            f'period="exp({flow.vph / 3600:.9f})" departLane="best" departSpeed="max"/>'
        )
    path.write_text("\n".join([*lines, "</routes>", ""]), encoding="utf-8")
    return {signal.tls: degree_of_saturation(net, signal, flows) for signal in signals}


def city_movements(
    net: Net, signals: Sequence[Signal], saturation: float = SATURATION
) -> list[Movement]:
    """Returns a flow for each pair of an entry and an exit, with its route.

    Entries and exits are the edges for cars at the border of the net. A net without a border gets
    trips between edges that are far from each other.

    Raises:
        ConfigError: `saturation` is not above 0, the net has no route for cars or too many pairs
            of entries and exits, there is no signal or one without demand, or traffic passes a
            link that is never green.
    """
    if not 0 < saturation < math.inf:
        raise ConfigError(f"saturation is {saturation:g}, allowed: more than 0")
    trips = _trips(net, _Roads(net))
    degrees = {signal.tls: degree_of_saturation(net, signal, trips) for signal in signals}
    idle = [tls for tls, degree in degrees.items() if not degree]
    if not signals:
        raise ConfigError(f"net {net.path}: the demand is scaled to signals; needs one or more")
    if idle:
        raise ConfigError(
            f"net {net.path}: junction without demand: none of {len(trips)} routes passes signal "
            f"{', '.join(idle[:_LISTED])}; leave it out, or bring a sumocfg with your own demand"
        )
    scale = saturation / max(degrees.values())
    return [replace(trip, vph=trip.vph * scale) for trip in trips]


def degree_of_saturation(net: Net, signal: Signal, flows: Sequence[Movement]) -> float:
    """Returns the degree of saturation v/c of the signal's most loaded lane group.

    For a set of movements from an approach it is (Highway Capacity Manual, signalized
    intersections) x = sum(v / (g/C)) / (s N), where v is the flow of a movement in veh/h, g/C the
    share of the plan's cycle in which its link is green, s = 1800 veh/h for each lane, and N the
    number of lanes from which one of the movements is allowed. The most loaded set counts: with
    drivers who spread over their lanes as evenly as they can, it is the load of the fullest lane.

    A green that has to yield counts in full, so the true degree is higher there.

    Raises:
        ConfigError: traffic passes a link that is never green.
    """
    passed = _passed(flows)
    lanes, greens = _movements_at(net, signal)
    loads: dict[str, dict[str, float]] = {}
    for (from_edge, to_edge), share in greens.items():
        vph = passed[from_edge, to_edge]
        if vph and not share:
            raise ConfigError(
                f"net {net.path}: signal {signal.tls} is never green from edge {from_edge} to "
                f"{to_edge}, which has traffic; each movement needs a green in the plan"
            )
        if vph:
            loads.setdefault(from_edge, {})[to_edge] = vph / share / SATURATION_FLOW_VPH
    return max((_fullest(load, lanes[edge]) for edge, load in loads.items()), default=0.0)


def _passed(flows: Sequence[Movement]) -> Counter[Pair]:
    """Returns the vehicles per hour by two edges that follow one another."""
    result: Counter[Pair] = Counter()
    for flow in flows:
        for pair in pairwise(flow.route):
            result[pair] += flow.vph  # type: ignore[assignment]  # a Counter counts floats as well
    return result


def _movements_at(
    net: Net, signal: Signal
) -> tuple[dict[str, dict[str, set[str]]], dict[Pair, float]]:
    """Returns the lanes and the green share g/C of each movement from edge to edge."""
    cycle_s = sum(phase.duration_s for phase in signal.plan)
    lanes: dict[str, dict[str, set[str]]] = {}
    greens: dict[Pair, float] = {}
    for link in signal.links:
        start, end = net.lanes[link.from_lane], net.lanes[link.to_lane]
        if start.passenger and end.passenger:
            green_s = sum(p.duration_s for p in signal.plan if p.state[link.index] in "Gg")
            pair = (start.edge, end.edge)
            greens[pair] = max(greens.get(pair, 0.0), green_s / cycle_s)
            lanes.setdefault(start.edge, {}).setdefault(end.edge, set()).add(start.id)
    return lanes, greens


def _fullest(load: Mapping[str, float], lanes: Mapping[str, set[str]]) -> float:
    """Returns the load per lane of the set of movements that is hardest to spread over its lanes.

    This is Hall's condition: no set of movements can be spread more evenly than over all lanes
    that serve one of them, and the hardest set reaches it.
    """
    return max(
        sum(load[edge] for edge in group) / len(set[str]().union(*(lanes[edge] for edge in group)))
        for size in range(1, len(load) + 1)
        for group in combinations(load, size)
    )


def _trips(net: Net, roads: _Roads) -> list[Movement]:
    """Returns routes with their weights in place of flows."""
    entries, exits, apart_m = roads.ends()
    if len(entries) * len(exits) > _MAX_FLOWS:
        raise ConfigError(
            f"net {net.path} has {len(entries)} entries and {len(exits)} exits, allowed are "
            f"{_MAX_FLOWS} pairs; cut the net, or bring a sumocfg with your own demand"
        )
    rng = np.random.default_rng(_SEED)
    trips = []
    for entry in entries:
        came_from = roads.fastest(entry, rng)
        for last in exits:
            if last == entry or last not in came_from or roads.gap_m(entry, last) <= apart_m:
                continue
            route = [last]
            while route[0] != entry:
                route.insert(0, came_from[route[0]])
            weight = roads.lanes[entry] * roads.lanes[last] * _TURN_WEIGHT ** roads.turns(route)
            trips.append(Movement(entry, last, route, weight))
    if not trips:
        raise ConfigError(
            f"net {net.path} has no route for passenger cars from an entry to an exit "
            f"({len(entries)} entries, {len(exits)} exits); expected roads that cross the net"
        )
    return trips


class _Roads:
    """Graph of the edges for cars, with the angle of the turn at each connection."""

    def __init__(self, net: Net) -> None:
        self._net = net
        self.lanes = Counter(
            lane.edge for lane in net.lanes.values() if lane.passenger and not lane.internal
        )
        self._turn_deg: dict[Pair, float] = {}
        self._next: dict[str, list[str]] = {edge: [] for edge in self.lanes}
        for connection in net.connections:
            pair = self._pair(connection)
            if pair and pair not in self._turn_deg:
                turn_deg = net.turn_deg(connection)
                if turn_deg < TURNAROUND_DEG:
                    self._turn_deg[pair] = turn_deg
                    self._next[pair[0]].append(pair[1])

    def ends(self) -> tuple[list[str], list[str], float]:
        """Returns entries, exits, and how far in m a trip's ends must be from each other."""
        reached = {edge for after in self._next.values() for edge in after}
        entries = [edge for edge in self.lanes if edge not in reached]
        exits = [edge for edge, after in self._next.items() if not after]
        if entries and exits:
            return entries, exits, _SAME_PLACE_M
        edges = self._far_edges()
        gaps_m = [self.gap_m(a, b) for a in edges for b in edges]
        return edges, edges, max(gaps_m, default=0.0) / 2

    def fastest(self, entry: str, rng: np.random.Generator) -> dict[str, str]:
        """Returns for each edge that can be reached the one before it (Dijkstra's algorithm)."""
        errors = rng.uniform(1 - _TIME_ERROR, 1 + _TIME_ERROR, len(self.lanes)).tolist()
        time_s = {
            edge: error * self._time_s(edge) for edge, error in zip(self.lanes, errors, strict=True)
        }
        came_from: dict[str, str] = {}
        heap = [(0.0, entry, entry)]
        while heap:
            passed_s, edge, before = heappop(heap)
            if edge in came_from:
                continue
            came_from[edge] = before
            for after in self._next[edge]:
                turn_s = _TURN_S if self._turn_deg[edge, after] > _TURN_DEG else 0.0
                heappush(heap, (passed_s + turn_s + time_s[after], after, edge))
        return came_from

    def turns(self, route: Sequence[str]) -> int:
        """Counts the junctions where a route does not go straight on."""
        return sum(self._turn_deg[pair] > _TURN_DEG for pair in pairwise(route))

    def gap_m(self, entry: str, last: str) -> float:
        """Returns the straight distance from the begin of an edge to the end of another."""
        return math.dist(self._shape(entry)[0][:2], self._shape(last)[-1][:2])

    def _pair(self, connection: NetConnection) -> Pair | None:
        lanes = [self._net.lanes.get(lane) for lane in (connection.from_lane, connection.to_lane)]
        edges = [lane.edge for lane in lanes if lane and lane.passenger and not lane.internal]
        return (edges[0], edges[1]) if len(edges) == 2 else None

    def _far_edges(self) -> list[str]:
        """Returns edges one after another, each the farthest from those before it."""
        edges = sorted(self.lanes)
        if not edges:
            return []
        starts = np.array([self._shape(edge)[0][:2] for edge in edges])
        chosen = [0]
        gaps_m = np.linalg.norm(starts - starts[0], axis=1)
        while len(chosen) < min(len(edges), _MAX_FAR_EDGES):
            gaps_m[chosen[-1]] = -1.0
            chosen.append(int(np.argmax(gaps_m)))
            gaps_m = np.minimum(gaps_m, np.linalg.norm(starts - starts[chosen[-1]], axis=1))
        return [edges[index] for index in chosen]

    def _time_s(self, edge: str) -> float:
        lane = self._net.lanes[self._net.edges[edge][0]]
        return lane.length_m / max(lane.speed_mps, 0.1)

    def _shape(self, edge: str) -> list[Point]:
        return self._net.lanes[self._net.edges[edge][0]].shape
