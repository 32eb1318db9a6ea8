"""The road map of a SUMO net: intersections with links, conflicts, fixed plans; lanes, owners."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Literal

import numpy as np
import numpy.typing as npt

from protocol.approaches import shortest, successors, through_junction
from protocol.errors import ConfigError, did_you_mean
from protocol.roadmap import (
    MAP_RADIUS_M,
    Intersection,
    Lane,
    Link,
    PlanPhase,
    RoadMap,
    Signal,
    distance_m,
)
from sim_host.netfile import Net, NetConnection, NetJunction, Point

_LISTED = 20
# With lights off (o, O) drivers yield; a stop sign's arrow (s) and red-yellow
# (u) count as red; Y is no state of today's SUMO but of its older nets.
_PLAIN_STATES = str.maketrans({"o": "g", "O": "g", "s": "r", "u": "r", "Y": "y"})


def read_signal(net: Net, tls: str) -> Signal:
    """Returns a signal of the net.

    Raises:
        ConfigError: there is no such signal, or no phase is green.
    """
    chosen(net, [tls])
    controlled = sorted((c for c in net.connections if c.tls == tls), key=lambda c: c.link)
    offset_s, phases = net.programs[tls]
    foes, yields, unplaced = _relations(net, controlled)
    plan = [
        PlanPhase(duration_s=phase.duration_s, state=_yielding(phase.state, yields))
        for phase in phases
    ]
    _check_plan(net, tls, plan, controlled)
    foes |= _possible_foes(unplaced, {c.link for c in controlled}, plan)
    links = [
        Link(index=c.link, from_lane=c.from_lane, to_lane=c.to_lane)
        for c in controlled
        if c.from_lane in net.lanes and net.lanes[c.from_lane].drivable
    ]
    if not links:
        raise ConfigError(f"signal {tls} in {net.path} controls no lane for road vehicles")
    return Signal(
        tls=tls,
        links=links,
        conflicts=sorted({(min(pair), max(pair)) for pair in foes}),
        plan=plan,
        offset_s=offset_s,
    )


def junctions_of(net: Net, tls: str) -> list[NetJunction]:
    """Returns the junctions that the signal stands at, sorted by id."""
    at = _positions(net)
    controlled = [c for c in net.connections if c.tls == tls]
    found = {place[0] for c in controlled if (place := _place(net, c, at))}
    return [net.junctions[name] for name in sorted(found)]


def chosen(net: Net, junctions: Literal["all"] | Sequence[str] | None) -> list[str]:
    """Returns the ids of the selected signals, sorted; None means the net's only one.

    Raises:
        ConfigError: the net has no signal, not these, or several where none was named.
    """
    known = sorted({c.tls for c in net.connections if c.tls} & set(net.programs))
    if not known:
        raise ConfigError(f"net {net.path} has no signal; it needs a <tlLogic> with connections")
    if junctions == "all" or (junctions is None and len(known) == 1):
        return known
    if junctions is None:
        raise ConfigError(
            f"say which signals with --tls all or --tls ID,...; {_listed(net, known)}"
        )
    for tls in junctions:
        if tls not in known:
            hint = did_you_mean(tls, known)
            raise ConfigError(f"there is no signal {tls!r}{hint}; {_listed(net, known)}")
    return sorted(set(junctions))


def _listed(net: Net, known: list[str]) -> str:
    more = f" and {len(known) - _LISTED} more" if len(known) > _LISTED else ""
    return f"{net.path.name} has: {', '.join(known[:_LISTED])}{more}"


def _check_plan(net: Net, tls: str, plan: list[PlanPhase], controlled: list[NetConnection]) -> None:
    needed = 1 + max(c.link for c in controlled)
    lengths = {len(phase.state) for phase in plan}
    if len(lengths) > 1 or any(length < needed for length in lengths):
        raise ConfigError(
            f"signal {tls} in {net.path}: phases have {sorted(lengths)} characters, "
            f"its links need {needed}"
        )
    if not any(phase.is_green for phase in plan) or sum(p.duration_s for p in plan) <= 0:
        raise ConfigError(f"signal {tls} in {net.path}: no phase of its plan is green")


def _yielding(state: str, yields: set[tuple[int, int]]) -> str:
    """Returns the state in plain letters; who must yield to another green gets `g` for `G`."""
    plain = state.translate(_PLAIN_STATES)
    minor = {
        link
        for link, other in yields
        if max(link, other) < len(plain) and plain[link] == plain[other] == "G"
    }
    return "".join("g" if link in minor else c for link, c in enumerate(plain))


Pairs = set[tuple[int, int]]


def _possible_foes(unplaced: set[int], links: set[int], plan: list[PlanPhase]) -> Pairs:
    """Returns the pairs of links that may cross, for all that is known of them.

    One of which the net does not say what it crosses may cross each other one, but those that have
    right of way with it in some phase of the plan.
    """
    return {
        (link, other)
        for link in unplaced
        for other in links - {link}
        if not any(phase.state[link] == phase.state[other] == "G" for phase in plan)
    }


def _relations(net: Net, controlled: list[NetConnection]) -> tuple[Pairs, Pairs, set[int]]:
    """Returns (link, link) pairs that cross or merge, and (link, other) where link yields.

    Then the links of which neither is known.
    """
    at, in_order = _positions(net), _without_internal_lanes(net)
    links_at: dict[tuple[str, int], list[int]] = {}
    unplaced = set[int]()
    for connection in controlled:
        ways = connection.from_lane, connection.to_lane
        place = _place(net, connection, at) or in_order.get(ways)
        if place is None:
            unplaced.add(connection.link)
        else:
            links_at.setdefault(place, []).append(connection.link)
    foes: set[tuple[int, int]] = set()
    yields: set[tuple[int, int]] = set()
    for (junction, request), links in links_at.items():
        for bits, into in (
            (net.junctions[junction].foes.get(request, ""), foes),
            (net.junctions[junction].responses.get(request, ""), yields),
        ):
            others = (o for index in _ones(bits) for o in links_at.get((junction, index), []))
            into.update((link, other) for other in others for link in links if link != other)
    # A pair of which neither yields would be two G at once: then both yield.
    silent = {(a, b) for a, b in foes if (a, b) not in yields and (b, a) not in yields}
    return foes, yields | silent, unplaced


def _ones(bits: str) -> Iterator[int]:
    return (index for index, bit in enumerate(reversed(bits)) if bit == "1")


def _positions(net: Net) -> dict[str, tuple[str, int]]:
    """Maps an internal lane to its junction and request index: `intLanes` is in that order."""
    return {
        lane: (junction.id, index)
        for junction in net.junctions.values()
        for index, lane in enumerate(junction.internal_lanes)
    }


def _without_internal_lanes(net: Net) -> dict[tuple[str, str], tuple[str, int]]:
    """Maps a connection, by its lanes, to the same where a junction has no internal lanes.

    Requests are then in the order of the incoming lanes, and of the connections of each.
    """
    leaving: dict[str, list[str]] = {}
    for connection in net.connections:
        leaving.setdefault(connection.from_lane, []).append(connection.to_lane)
    found: dict[tuple[str, str], tuple[str, int]] = {}
    for junction in net.junctions.values():
        if not junction.internal_lanes:
            ways = [(a, b) for a in junction.incoming_lanes for b in leaving.get(a, [])]
            found |= {way: (junction.id, index) for index, way in enumerate(ways)}
    return found


def _place(
    net: Net, connection: NetConnection, at: dict[str, tuple[str, int]]
) -> tuple[str, int] | None:
    """Finds a connection's request: by its internal lane, or a later one if that is split."""
    lane = connection.via or connection.to_lane  # a pedestrian crossing is its own internal lane
    seen: set[str] = set()
    while lane and lane not in at and lane not in seen:
        seen.add(lane)
        lane = next((c.via for c in net.connections if c.from_lane == lane and c.via), "")
    return at.get(lane)


def road_map(net: Net, junctions: Literal["all"] | Sequence[str] | None) -> RoadMap:
    """Returns the intersections of a net with these signals, and all lanes around them.

    Args:
        net: as read from its file.
        junctions: ids of signals, "all", or None for the net's only one.

    Raises:
        ConfigError: there is no such signal, or one that cannot be controlled; see `read_signal`.
    """
    found = [_intersection(net, tls) for tls in chosen(net, junctions)]
    near = _near(net, np.array([one.centre[:2] for one in found])) | {
        lane for one in found for lane in (*one.incoming, *one.outgoing)
    }
    following = _successors(net, near)
    lanes = [
        Lane(
            id=lane.id,
            edge=lane.edge,
            width_m=lane.width_m,
            speed_mps=lane.speed_mps,
            length_m=lane.length_m,
            centreline=lane.shape,
            successors=following[lane.id],
            internal=lane.internal,
        )
        for lane in (net.lanes[name] for name in sorted(near))
    ]
    name = net.path.name.removesuffix(".gz").removesuffix(".net.xml")
    return _with_owners(RoadMap(name=name, lanes=lanes, intersections=found))


def _intersection(net: Net, tls: str) -> Intersection:
    signal, junctions = read_signal(net, tls), junctions_of(net, tls)
    centre = _centre(junctions) if junctions else _stop_bar(net, signal.links[0].from_lane)
    return Intersection(signal=signal, centre=centre, outline=_outline(junctions))


def _with_owners(road_map: RoadMap) -> RoadMap:
    """Returns the map with the intersection that each lane belongs to; see `Lane`."""
    owner = {
        name: one.tls
        for one in road_map.intersections
        for path in through_junction(road_map, one)
        for name, _ in path.inner
    }
    lengths_m = {lane.id: lane.measured_m for lane in road_map.lanes}
    behind = {lane: one.tls for one in road_map.intersections for lane in one.outgoing}
    before = {lane: one.tls for one in road_map.intersections for lane in one.incoming}
    inside = set(owner)
    ways = (
        (before, lambda name: road_map.predecessors[name]),
        (behind, lambda name: successors(road_map, name)),
    )
    for starts, following in ways:
        begin = [(0.0, name, name) for name in starts if name in lengths_m and name not in owner]
        found = shortest(begin, following, lengths_m, barred=inside | owner.keys())
        owner = {name: starts[start] for name, (_, start) in found.items()} | owner
    lanes = [
        lane.model_copy(update={"tls": owner.get(lane.id) or _nearest(road_map, lane)})
        for lane in road_map.lanes
    ]
    return RoadMap(name=road_map.name, lanes=lanes, intersections=road_map.intersections)


def _nearest(road_map: RoadMap, lane: Lane) -> str:
    middle = lane.points.mean(axis=0)
    return min(
        road_map.intersections,
        key=lambda one: (float(np.hypot(*(middle - one.centre)[:2])), one.tls),
    ).tls


def _centre(junctions: list[NetJunction]) -> Point:
    x, y, z = np.mean([junction.centre for junction in junctions], axis=0)
    return float(x), float(y), float(z)


def _stop_bar(net: Net, lane: str) -> Point:
    return net.lanes[lane].shape[-1]


def _near(net: Net, centres: npt.NDArray[np.float64]) -> set[str]:
    """Returns the drivable lanes within the map's radius of a centre (N, 2)."""
    return {
        lane.id
        for lane in net.lanes.values()
        if lane.drivable and len(lane.shape) > 1 and _is_near(lane.shape, centres)
    }


def _is_near(shape: list[Point], centres: npt.NDArray[np.float64]) -> bool:
    points = np.array(shape)[:, :2]
    beyond = np.maximum(points.min(axis=0) - centres, centres - points.max(axis=0))
    possible = centres[(beyond <= MAP_RADIUS_M).all(axis=1)]
    return any(distance_m(points, at) <= MAP_RADIUS_M for at in possible)


def _successors(net: Net, kept: set[str]) -> dict[str, list[str]]:
    """Maps lanes to the lanes they lead into, through the lanes inside junctions."""
    result: dict[str, list[str]] = {lane: [] for lane in kept}
    for connection in net.connections:
        into = connection.via or connection.to_lane
        if connection.from_lane in kept and into in kept:
            result[connection.from_lane].append(into)
    return {lane: list(dict.fromkeys(after)) for lane, after in result.items()}


def _outline(junctions: list[NetJunction]) -> list[tuple[float, float]]:
    if len(junctions) == 1:
        return [(x, y) for x, y, _ in junctions[0].shape]
    return _hull((x, y) for junction in junctions for x, y, _ in junction.shape)


def _hull(points: Iterable[tuple[float, float]]) -> list[tuple[float, float]]:
    """Returns the convex hull, counter-clockwise (Andrew's monotone chain)."""
    ordered = sorted(set(points))
    return _chain(ordered) + _chain(ordered[::-1])


def _chain(ordered: list[tuple[float, float]]) -> list[tuple[float, float]]:
    chain: list[tuple[float, float]] = []
    for x, y in ordered:
        while len(chain) > 1:
            (ax, ay), (bx, by) = chain[-2:]
            if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0:
                break
            chain.pop()
        chain.append((x, y))
    return chain[:-1]
