"""Approaches: lanes to and from an intersection, and their distance to its stop bars.

The lanes of other intersections bound them: an approach ends where another intersection begins.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np

from protocol.roadmap import Intersection, RoadMap


@dataclass(frozen=True, slots=True)
class Approach:
    """How a lane relates to a signal.

    `counts_for` is the incoming lane it leads to, or the outgoing lane it belongs to. `start_m` is
    the distance of the lane's start to the stop bar, negative behind it.
    """

    counts_for: str
    start_m: float


class Approaches:
    """The lanes around an intersection: `upstream` of its stop bars, `inside` and `downstream`."""

    def __init__(self, road_map: RoadMap, intersection: Intersection) -> None:
        self._map = road_map
        self.intersection = intersection
        self._lengths_m = {lane.id: lane.measured_m for lane in road_map.lanes}
        self._paths = through_junction(road_map, intersection)
        self.inside = {name for path in self._paths for name, _ in path.inner}
        foreign = [lane for lane in road_map.lanes if lane.tls not in ("", intersection.tls)]
        self.upstream = self._reach_upstream({lane.id for lane in foreign})
        self.downstream = self._reach_downstream({lane.id for lane in foreign if lane.internal})

    def with_neighbours(self) -> list[Approaches]:
        """Returns these and the approaches of the signals that lanes downstream lead to."""
        signals = {self._map.by_id[name].tls for name in self.downstream}
        ahead = sorted(signals & self._map.by_tls.keys() - {self.intersection.tls})
        return [self, *(Approaches(self._map, self._map.by_tls[tls]) for tls in ahead)]

    def _reach_upstream(self, barred: set[str]) -> dict[str, Approach]:
        """Follows the lanes back from the stop bars; the junction's own lanes lie behind them."""
        known = [name for name in self.intersection.incoming if name in self._map.by_id]
        found = shortest(
            [(0.0, name, name) for name in known],
            lambda name: self._map.predecessors[name],
            self._lengths_m,
            barred=barred | self.inside | set(self.intersection.outgoing) - set(known),
        )
        return {
            name: Approach(owner, way_m + self._lengths_m[name])
            for name, (way_m, owner) in found.items()
        }

    def _reach_downstream(self, barred: set[str]) -> dict[str, Approach]:
        """Follows the lanes on from the stop bars, through the junction."""
        result: dict[str, Approach] = {}
        exits: dict[str, float] = dict.fromkeys(self.intersection.outgoing, np.inf)
        for path in self._paths:
            exits[path.exit] = min(exits[path.exit], path.way_m)
            for name, way_m in path.inner:
                if name not in result or way_m < -result[name].start_m:
                    result[name] = Approach(path.exit, -way_m)
        starts = [
            (way_m if np.isfinite(way_m) else 0.0, name, name)
            for name, way_m in exits.items()
            if name in self._map.by_id
        ]
        found = shortest(
            starts,
            lambda name: successors(self._map, name),
            self._lengths_m,
            barred=barred | self.inside | set(self.intersection.incoming) - set(exits),
        )
        return result | {name: Approach(owner, -way_m) for name, (way_m, owner) in found.items()}


def bar_starts_m(around: Collection[Approaches]) -> dict[str, float]:
    """Returns by lane the distance of its start to the stop bar ahead, else to the one behind it.

    Distances of vehicles are to that bar, negative behind it: see `Detections.distances_m`.
    """
    found: dict[str, float] = {}
    for side in ("upstream", "downstream"):
        for one in around:
            for name, reach in getattr(one, side).items():
                found.setdefault(name, reach.start_m)
    return found


@dataclass(frozen=True, slots=True)
class InnerPath:
    """A path through a junction: `inner` lanes, distance to each one's start and to the exit."""

    inner: tuple[tuple[str, float], ...]
    exit: str
    way_m: float


def through_junction(road_map: RoadMap, intersection: Intersection) -> list[InnerPath]:
    """Returns the paths over the junction's own lanes, link by link."""
    found: list[InnerPath] = []
    for link in intersection.signal.links:
        todo: list[tuple[str, float, tuple[tuple[str, float], ...]]] = [
            (name, 0.0, ()) for name in successors(road_map, link.from_lane)
        ]
        while todo:
            name, way_m, passed = todo.pop()
            lane = road_map.by_id[name]
            if name == link.to_lane:
                found += [InnerPath(passed, name, way_m)] if passed else []
            elif lane.internal and len(passed) < 8:
                path = (*passed, (name, way_m))
                further_m = way_m + lane.measured_m
                todo += [(after, further_m, path) for after in successors(road_map, name)]
    return found


def successors(road_map: RoadMap, name: str) -> list[str]:
    """Returns the lanes of the map that a lane leads into."""
    lane = road_map.by_id.get(name)
    return [after for after in lane.successors if after in road_map.by_id] if lane else []


def shortest(
    starts: list[tuple[float, str, str]],
    following: Callable[[str], list[str]],
    lengths_m: dict[str, float],
    *,
    barred: Collection[str],
) -> dict[str, tuple[float, str]]:
    """Returns the shortest path to each reachable lane, and the start it came from (Dijkstra).

    Of equally long paths, the one from the start that is listed first wins.
    """
    rank = {owner: index for index, (_, _, owner) in enumerate(starts)}
    heap = [(way_m, rank[owner], name) for way_m, name, owner in starts]
    owners = [owner for _, _, owner in starts]
    heapq.heapify(heap)
    found: dict[str, tuple[float, str]] = {}
    while heap:
        way_m, order, name = heapq.heappop(heap)
        if name in found:
            continue
        found[name] = (way_m, owners[order])
        for after in following(name):
            if after not in found and after not in barred:
                heapq.heappush(heap, (way_m + lengths_m[name], order, after))
    return found
