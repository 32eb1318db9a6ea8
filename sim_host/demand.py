"""Traffic demand: vehicle types, and flows over the signal for a net without demand of its own."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

from protocol.config import is_file
from protocol.errors import ConfigError
from protocol.messages import ObjectClass, VehicleType
from protocol.roadmap import Signal
from sim_host.config import TrafficConfig, VehicleSpec
from sim_host.limits import MAX_NAME_CHARS
from sim_host.netfile import TURNAROUND_DEG, UNREADABLE, Net, open_file
from sim_host.vehicle_meshes import BOX

# SUMO's default length, width and height in m by vClass (page "Vehicle Type Parameter Defaults").
_SIZES: dict[str, tuple[float, float, float]] = {
    "passenger": (5.0, 1.8, 1.5),
    "delivery": (6.5, 2.16, 2.86),
    "emergency": (6.5, 2.16, 2.86),
    "truck": (7.1, 2.4, 2.4),
    "trailer": (16.5, 2.55, 4.0),
    "bus": (12.0, 2.5, 3.4),
    "coach": (14.0, 2.6, 4.0),
    "tram": (22.0, 2.4, 3.2),
    "motorcycle": (2.2, 0.9, 1.5),
    "moped": (2.1, 0.8, 1.7),
    "bicycle": (1.6, 0.65, 1.7),
    "pedestrian": (0.215, 0.478, 1.719),
    "rail_urban": (109.5, 3.0, 3.6),
    "rail": (135.0, 2.84, 3.75),
}
_MESHES = {
    "delivery": "minibus",
    "emergency": "minibus",
    "truck": "lorry",
    "trailer": "articulated",
    "bus": "bus",
    "coach": "bus",
    "motorcycle": "motorcycle",
    "moped": "motorcycle",
    "bicycle": "bicycle",
    "pedestrian": "pedestrian",
}
_OBJECT_CLASSES = {
    **dict.fromkeys(("truck", "trailer", "bus", "coach", "tram"), ObjectClass.TRUCK),
    **dict.fromkeys(("motorcycle", "moped", "bicycle"), ObjectClass.TWO_WHEELER),
    "pedestrian": ObjectClass.PEDESTRIAN,
}
_MOVING = ("vehicle", "trip", "flow", "person")  # of a route file
_ON_RAILS = ("tram", "rail", "ship", "subway", "cable")
_DEFAULTS = {
    "DEFAULT_VEHTYPE": "passenger",
    "DEFAULT_TAXITYPE": "passenger",
    "DEFAULT_CONTAINERTYPE": "pedestrian",
    "DEFAULT_PEDTYPE": "pedestrian",
    "DEFAULT_BIKETYPE": "bicycle",
    "DEFAULT_RAILTYPE": "rail",
}


def types_of_demand(specs: list[VehicleSpec]) -> list[VehicleType]:
    """Returns the types of the generated demand."""
    return [
        VehicleType(
            name=spec.name,
            mesh=spec.mesh,
            length_m=spec.length_m,
            width_m=spec.width_m,
            height_m=spec.height_m,
            object_class=object_class_of(spec.v_class),
        )
        for spec in specs
    ]


def types_of_files(paths: list[Path]) -> list[VehicleType]:
    """Returns SUMO's own types and every `<vType>` in the files, sorted by name.

    Raises:
        ConfigError: a file is missing or is not XML, or a size is no number.
    """
    types = {name: sized(name, v_class) for name, v_class in _DEFAULTS.items()}
    for path in paths:
        for attributes in _v_types(path):
            name = attributes["id"]
            try:
                types[name] = sized(name, attributes.get("vClass", "passenger"), attributes)
            except ValueError as error:
                raise ConfigError(f"vType {name!r} in {path}: {error}") from None
    return [types[name] for name in sorted(types)]


def sized(name: str, v_class: str, given: dict[str, str] | None = None) -> VehicleType:
    """Returns a type with the sizes that are given, SUMO's defaults of its class otherwise."""
    given = given or {}
    length, width, height = _SIZES.get(v_class, _SIZES["passenger"])
    height = float(given.get("height", height))
    return VehicleType(
        name=name,
        mesh=mesh_for(v_class, height),
        length_m=float(given.get("length", length)),
        width_m=float(given.get("width", width)),
        height_m=height,
        object_class=object_class_of(v_class),
    )


def mesh_for(v_class: str, height_m: float) -> str:
    """Returns the shape that comes nearest to a class of vehicles."""
    if v_class.startswith(_ON_RAILS):
        return BOX
    return _MESHES.get(v_class, "microcargo" if height_m > 1.8 else "car")


def object_class_of(v_class: str) -> ObjectClass:
    """Returns the `ObjectClass` of a SUMO vehicle class; trains and ships are trucks."""
    other = ObjectClass.TRUCK if v_class.startswith(_ON_RAILS) else ObjectClass.CAR
    return _OBJECT_CLASSES.get(v_class, other)


def _v_types(path: Path) -> Iterator[dict[str, str]]:
    if not is_file(path):
        raise ConfigError(f"file {path}, which the scenario or its sumocfg names, does not exist")
    try:
        yield from (dict(one.attrib) for one in _elements(path, "vType") if "id" in one.attrib)
    except UNREADABLE as error:
        raise ConfigError(f"file {path} cannot be read as XML: {error}") from None


def first_departure_s(routes: Path) -> float:
    """Returns when the first of a file's vehicles and flows departs, in whole s; 0 without any.

    Raises:
        ConfigError: the file cannot be read, or a time is no number of seconds.
    """
    try:
        times = (
            float(one.get("depart", one.get("begin", "0"))) for one in _elements(routes, *_MOVING)
        )
        first_s = min(times, default=0.0)  # not only the first: flows may stand after vehicles
    except UNREADABLE as error:
        raise ConfigError(f"traffic.routes: {routes} cannot be read as XML: {error}") from None
    except ValueError as error:
        raise ConfigError(f"traffic.routes: {routes}: times must be in seconds: {error}") from None
    return float(math.floor(first_s)) if math.isfinite(first_s) else 0.0


def _elements(path: Path, *tags: str) -> Iterator[ElementTree.Element]:
    """Yields elements of a route file that is not held in memory: those of a city are large."""
    with open_file(path) as stream:
        root: ElementTree.Element | None = None
        for event, element in ElementTree.iterparse(stream, ("start", "end")):
            root = element if root is None else root
            if event == "end" and element.tag in tags:
                yield element
            if event == "end" and element.tag in _MOVING:
                root.clear()


UPSTREAM_M = 200.0
DOWNSTREAM_M = 100.0
MIX = "mix"


@dataclass(frozen=True, slots=True)
class Movement:
    """A flow from one edge over the signal into another; `route` holds all its edges."""

    from_edge: str
    to_edge: str
    route: list[str]
    vph: float


def write_demand(path: Path, net: Net, signal: Signal, config: TrafficConfig) -> None:
    """Writes vehicle types, routes and flows with exponential headways as a SUMO route file."""
    lines = ["<routes>", *vehicle_type_lines(config.vehicles)]
    for movement in movements(net, signal, config):
        name = quoteattr(movement_name(movement, net))
        edges = quoteattr(" ".join(movement.route))
        lines.append(f"  <route id={name} edges={edges}/>")
        if movement.vph > 0:
            lines.append(
                f'  <flow id={name} route={name} type="{MIX}" begin="0" end="1e7" '
                f'period="exp({movement.vph / 3600:.9f})" departLane="best" departSpeed="max"/>'
            )
    path.write_text("\n".join([*lines, "</routes>", ""]), encoding="utf-8")


def movement_name(movement: Movement, net: Net) -> str:
    """Returns the name of a movement's route and flow, from edge to edge.

    Raises:
        ConfigError: that is too long for the ids of its vehicles.
    """
    name = f"{movement.from_edge}-to-{movement.to_edge}"
    if len(name) > MAX_NAME_CHARS:
        raise ConfigError(
            f"net {net.path}: vehicles are called by their edges: {name:.80}… has {len(name)} "
            f"characters, limit {MAX_NAME_CHARS}; rename the edges, or bring a sumocfg"
        )
    return name


def movements(net: Net, signal: Signal, config: TrafficConfig) -> list[Movement]:
    """Returns the flows: each lane's rate is split evenly over the edges it serves.

    Routes begin at least 200 m before the stop bar and end at least 100 m behind the junction,
    where the net allows.

    Raises:
        ConfigError: a demand is given for an edge that does not end at the signal.
    """
    targets = _targets(net, signal)
    incoming = list(dict.fromkeys(net.lanes[lane].edge for lane in targets))
    for edge in config.demand_vph_per_lane:
        if edge not in incoming:
            raise ConfigError(
                f"traffic.demand_vph_per_lane names edge {edge!r}, which does not end at signal "
                f"{signal.tls}; allowed: {', '.join(incoming)}"
            )
    roads = _Roads(net)
    result = []
    for edge in incoming:
        rate = config.demand_vph_per_lane.get(edge, config.default_demand_vph_per_lane)
        shares: dict[str, float] = {}
        for lane, exits in targets.items():
            if net.lanes[lane].edge == edge:
                for to_edge in exits:
                    shares[to_edge] = shares.get(to_edge, 0.0) + 1 / len(exits)
        before = roads.upstream(edge, set(incoming))
        for to_edge, share in shares.items():
            after = roads.downstream(to_edge, set(before))
            result.append(Movement(edge, to_edge, before + after, rate * share))
    return result


def _targets(net: Net, signal: Signal) -> dict[str, list[str]]:
    """Maps each lane before the signal that cars may use to the edges it leads to.

    There are no U-turns but from a lane that leads nowhere else.
    """
    back = {
        (one.from_lane, one.to_lane)
        for one in net.connections
        if one.tls == signal.tls
        and {one.from_lane, one.to_lane} <= net.lanes.keys()
        and net.turn_deg(one) >= TURNAROUND_DEG
    }
    ways: dict[str, list[tuple[str, bool]]] = {}
    for link in signal.links:
        lanes = net.lanes[link.from_lane], net.lanes[link.to_lane]
        if all(lane.passenger for lane in lanes):
            way = lanes[1].edge, (link.from_lane, link.to_lane) in back
            ways.setdefault(link.from_lane, []).append(way)
    if not ways:
        raise ConfigError(f"signal {signal.tls} in {net.path} controls no lane for passenger cars")
    return {lane: _onward(exits) for lane, exits in ways.items()}


def _onward(exits: list[tuple[str, bool]]) -> list[str]:
    """Returns each edge once, without those that lead back if there are others."""
    onward = [edge for edge, is_back in exits if not is_back]
    return list(dict.fromkeys(onward or [edge for edge, _ in exits]))


def vehicle_type_lines(specs: list[VehicleSpec]) -> list[str]:
    """Returns the lines of a route file that hold the vehicle types and their mix."""
    rows = [
        f'    <vType id="{spec.name}" vClass="{spec.v_class}" length="{spec.length_m}" '
        f'width="{spec.width_m}" height="{spec.height_m}" probability="{spec.share}"/>'
        for spec in specs
    ]
    return [f'  <vTypeDistribution id="{MIX}">', *rows, "  </vTypeDistribution>"]


class _Roads:
    """Edges for cars, and how many lanes lead from one into another."""

    def __init__(self, net: Net) -> None:
        self._net = net
        self._next: dict[str, Counter[str]] = {}
        self._previous: dict[str, Counter[str]] = {}
        for connection in net.connections:
            lanes = net.lanes.get(connection.from_lane), net.lanes.get(connection.to_lane)
            if all(lane and lane.passenger and not lane.internal for lane in lanes):
                a, b = (lane.edge for lane in lanes if lane)
                self._next.setdefault(a, Counter())[b] += 1
                self._previous.setdefault(b, Counter())[a] += 1

    def upstream(self, edge: str, barred: set[str]) -> list[str]:
        """Returns the edges of a route that ends with this edge."""
        return self._extend(edge, self._previous, UPSTREAM_M, barred)[::-1]

    def downstream(self, edge: str, barred: set[str]) -> list[str]:
        """Returns the edges of a route that begins with this edge."""
        return self._extend(edge, self._next, DOWNSTREAM_M, barred)

    def _extend(
        self, edge: str, beyond: dict[str, Counter[str]], enough_m: float, barred: set[str]
    ) -> list[str]:
        route = [edge]
        while sum(self._length_m(e) for e in route) < enough_m:
            taken = barred | set(route)
            choices = [e for e in beyond.get(route[-1], Counter()) if e not in taken]
            if not choices:
                break
            lanes = beyond[route[-1]]
            route.append(min(choices, key=lambda e: (-lanes[e], -self._length_m(e), e)))
        return route

    def _length_m(self, edge: str) -> float:
        return self._net.lanes[self._net.edges[edge][0]].length_m
