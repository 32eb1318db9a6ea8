"""Lanes: positions of vehicles on them, and counts per lane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from perception.arrays import Bools, Floats, Ints
from perception.roadway import LEVEL_M
from protocol.approaches import Approaches, bar_starts_m
from protocol.roadmap import RoadMap

ACROSS_M = 1.75  # a lane at right angles to the vehicle counts as this much farther away


@dataclass(frozen=True, slots=True, eq=False)
class LanePositions:
    """Lanes of vehicles: index into the map's lanes (N,), -1 off the road; metres along (N,)."""

    lane: Ints
    along_m: Floats

    def take(self, chosen: Bools) -> LanePositions:
        """Returns some of them, by mask."""
        return LanePositions(self.lane[chosen], self.along_m[chosen])


class LaneIndex:
    """Spatial index of the lanes, for queries of many points at once."""

    def __init__(self, road_map: RoadMap) -> None:
        self._map = road_map
        rows, owners = [], []
        for index, lane in enumerate(road_map.lanes):
            points = lane.points
            steps_m = np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1)
            starts_m = np.concatenate([[0.0], np.cumsum(steps_m)[:-1]])
            half_m = np.full(len(steps_m), lane.width_m / 2)
            rows.append(np.column_stack([points[:-1], points[1:], half_m, starts_m]))
            owners.append(np.full(len(steps_m), index))
        self._segments = np.concatenate(rows)
        self._owners = np.concatenate(owners)
        self.approaches = {one.tls: Approaches(road_map, one) for one in road_map.intersections}
        self._start_m = bar_starts_m(self.approaches.values())

    def locate(self, boxes: Floats, *, margin_m: Floats) -> LanePositions:
        """Finds the lane under each box (N, 7): the nearest that runs along the box.

        A box is on the road if its centre is at most its margin (N,) beyond the edge of a lane.
        """
        lane = np.full(len(boxes), -1, np.int64)
        along_m = np.zeros(len(boxes))
        reach_m = np.broadcast_to(np.asarray(margin_m, np.float64), len(boxes)).copy()
        _locate(np.ascontiguousarray(boxes, np.float64), reach_m, self._segments, lane, along_m)
        return LanePositions(np.where(lane >= 0, self._owners[lane], -1), along_m)

    def names(self, place: LanePositions) -> list[str]:
        """Returns the lanes' ids, an empty string off the road."""
        return [self._map.lanes[i].id if i >= 0 else "" for i in place.lane]

    def distances_m(self, place: LanePositions) -> Floats:
        """Returns distances to the stop bar (N,), negative behind it; 0 without a path to it."""
        result = np.zeros(len(place.lane))
        for index, name in enumerate(self.names(place)):
            if name in self._start_m:
                result[index] = self._start_m[name] - place.along_m[index]
        return result

    def owners(self, place: LanePositions) -> list[str]:
        """Returns the signals of the intersections that the lanes belong to; empty for none."""
        return [self._map.lanes[i].tls if i >= 0 else "" for i in place.lane]

    def count(
        self, place: LanePositions, tls: str, *, upstream_m: float, downstream_m: float
    ) -> tuple[dict[str, int], dict[str, int]]:
        """Counts vehicles per incoming lane before a signal's stop bars, and per outgoing lane.

        A vehicle farther up counts for the incoming lane that its own lane leads to; where there
        are several, for the one with the shortest path, so that no vehicle counts twice. One inside
        the junction counts for the lane it is about to leave by.
        """
        reach = {"upstream_m": upstream_m, "downstream_m": downstream_m}
        before, behind = self.weigh(place, np.ones(len(place.lane)), tls, **reach)
        return {k: round(v) for k, v in before.items()}, {k: round(v) for k, v in behind.items()}

    def weigh(
        self,
        place: LanePositions,
        weights: Floats,
        tls: str,
        *,
        upstream_m: float,
        downstream_m: float,
    ) -> tuple[dict[str, float], dict[str, float]]:
        """Adds up weights (N,) of vehicles by lane, as `count` counts vehicles."""
        around = self.approaches[tls]
        before = dict.fromkeys(around.intersection.incoming, 0.0)
        behind = dict.fromkeys(around.intersection.outgoing, 0.0)
        vehicles = zip(self.names(place), place.along_m, weights.tolist(), strict=True)
        for name, along_m, weight in vehicles:
            reach = around.upstream.get(name)
            if reach and reach.start_m - along_m <= upstream_m:
                before[reach.counts_for] += weight
            reach = around.downstream.get(name)
            if reach and along_m - reach.start_m <= downstream_m:
                behind[reach.counts_for] += weight
        return before, behind


@njit("void(float64[:,::1], float64[::1], float64[:,::1], int64[::1], float64[::1])", cache=True)
def _locate(boxes: Floats, margin_m: Floats, segments: Floats, best: Ints, along_m: Floats) -> None:
    """Finds each box's cheapest segment (S, 8): two ends x, y, z, half width, metres before it."""
    for index in range(boxes.shape[0]):
        x, y, yaw = boxes[index, 0], boxes[index, 1], boxes[index, 6]
        z = boxes[index, 2] - boxes[index, 5] / 2  # of the ground that it stands on
        least_m = np.inf
        for segment in range(segments.shape[0]):
            x0, y0, z0, x1, y1, z1, half_m, before_m = segments[segment]
            dx, dy = x1 - x0, y1 - y0
            square = max(dx * dx + dy * dy, 1e-12)
            share = min(max(((x - x0) * dx + (y - y0) * dy) / square, 0.0), 1.0)
            gap_m = np.hypot(x - x0 - share * dx, y - y0 - share * dy)
            if gap_m > half_m + margin_m[index]:
                continue
            turned = abs(np.sin(yaw - np.arctan2(dy, dx)))
            off_m = max(abs(z - z0 - share * (z1 - z0)) - LEVEL_M, 0.0)
            cost_m = gap_m + ACROSS_M * turned + off_m
            if cost_m < least_m:
                least_m = cost_m
                best[index] = segment
                along_m[index] = before_m + share * np.sqrt(square)
