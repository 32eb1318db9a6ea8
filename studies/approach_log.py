"""Time loss and queues of vehicles on approaches, from samples of their positions.

The same samples, once a second, come from SUMO alone and from the truth of a recorded run.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable
from statistics import fmean
from typing import Any, NamedTuple

from protocol.approaches import Approaches
from protocol.roadmap import Intersection, Lane, RoadMap

REACH_M = 300.0  # before a stop bar, within which vehicles are considered
INTERVAL_S = 10.0  # of which the queue is a mean
_STANDING_MPS = 1.4  # 5 km/h
_WAITING_MPS = 0.1  # as SUMO has it
_WINDS = ("east", "north-east", "north", "north-west", "west", "south-west", "south", "south-east")


class VehicleSample(NamedTuple):
    """A vehicle's lane, metres along it as SUMO counts them, and speed in m/s."""

    vehicle: str
    lane: str
    along_m: float
    speed_mps: float


class ApproachLog:
    """Adds up the time that vehicles lose on each approach, and how many stand there.

    An approach is an edge that ends at a stop bar, with the lanes that lead to it, up to `REACH_M`.
    Time lost is what driving slower than the lane's limit costs.

    Attributes:
        waited_s: the longest that any vehicle stood still in one go, wherever it was.
    """

    def __init__(self, road_map: RoadMap, period_s: float) -> None:
        self._period_s = period_s
        self._lanes: dict[str, tuple[Lane, str, float]] = {}
        names = approach_names(road_map)
        for one in road_map.intersections:
            for lane, approach in Approaches(road_map, one).upstream.items():
                edge = road_map.by_id[approach.counts_for].edge
                found = road_map.by_id[lane], names[one.tls, edge], approach.start_m
                self._lanes.setdefault(lane, found)
        self._names = list(names.values())
        self._lost_s: dict[str, float] = defaultdict(float)
        self._vehicles: dict[str, set[str]] = defaultdict(set)
        self._queues: dict[int, list[int]] = defaultdict(list)
        self._stood_s: dict[str, float] = {}
        self.waited_s = 0.0

    def note(self, time_s: float, samples: Iterable[VehicleSample]) -> None:
        """Adds a sample of all vehicles, `time_s` after the first measured moment."""
        standing, stood_s = 0, {}
        for one in samples:
            if one.speed_mps < _WAITING_MPS:
                stood_s[one.vehicle] = self._stood_s.get(one.vehicle, 0.0) + self._period_s
            found = self._lanes.get(one.lane)
            if found is None:
                continue
            lane, name, start_m = found
            if start_m - one.along_m * lane.measured_share > REACH_M:
                continue
            self._lost_s[name] += self._period_s * max(0.0, 1 - one.speed_mps / lane.speed_mps)
            self._vehicles[name].add(one.vehicle)
            standing += one.speed_mps < _STANDING_MPS
        self._queues[int(time_s // INTERVAL_S)].append(standing)
        self._stood_s = stood_s
        self.waited_s = max(self.waited_s, *stood_s.values(), 0.0)

    def as_json(self) -> dict[str, Any]:
        """Returns mean seconds lost by approach, and the vehicles that stood, by interval."""
        approaches = {
            name: self._lost_s[name] / len(self._vehicles[name]) if self._vehicles[name] else None
            for name in self._names
        }
        last = max(self._queues, default=-1)
        queues = [fmean(self._queues[n]) if n in self._queues else None for n in range(last + 1)]
        return {"approaches": approaches, "queues": queues}


def approach_names(road_map: RoadMap) -> dict[tuple[str, str], str]:
    """Returns the names of the approaches: the compass direction that it comes from, else its edge.

    By signal and edge; with several signals, the signal's id comes first.
    """
    names: dict[tuple[str, str], str] = {}
    several = len(road_map.intersections) > 1
    for one in road_map.intersections:
        edges = {road_map.by_id[lane].edge: lane for lane in one.incoming if lane in road_map.by_id}
        winds = {edge: _wind(one, road_map.by_id[lane]) for edge, lane in edges.items()}
        for edge, wind in winds.items():
            is_only = list(winds.values()).count(wind) == 1
            text = f"from {wind}" if is_only else f"from {wind} ({edge})"
            names[one.tls, edge] = f"{one.tls} {text}" if several else text
    return names


def _wind(intersection: Intersection, lane: Lane) -> str:
    x_m, y_m = lane.points[0, :2] - intersection.centre[:2]
    turn = math.atan2(y_m, x_m) / (2 * math.pi) * len(_WINDS)
    return _WINDS[round(turn) % len(_WINDS)]
