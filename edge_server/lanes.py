"""Lanes: positions of vehicles on them, counts per lane, and sensor coverage of lanes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numba import njit

from perception.arrays import Bools, Floats, Ints
from perception.roadway import LEVEL_M
from protocol.approaches import Approach, Approaches, bar_starts_m
from protocol.roadmap import Lane, RoadMap

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


SPACING_M = 4.0
CoverageShares = dict[str, float]


@dataclass(frozen=True, slots=True)
class Covered:
    """Shares by lane that sensors cover, see `protocol.messages.LaneCounts`."""

    upstream: CoverageShares
    downstream: CoverageShares
    from_bar: CoverageShares


class LaneCoverage:
    """Sensor coverage: the share of sampled places on each counted lane that sensors cover."""

    def __init__(
        self, road_map: RoadMap, around: Approaches, *, upstream_m: float, downstream_m: float
    ) -> None:
        self._before = _Side(
            around.intersection.incoming, *_places(road_map, around.upstream, 0.0, upstream_m)
        )
        self._behind = _Side(
            around.intersection.outgoing,
            *_places(road_map, around.downstream, -downstream_m, np.inf),
        )

    def shares(self, sensors_m: Floats, range_m: float) -> Covered:
        """Returns by lane the shares within range of any sensor (S, 2).

        Occlusion is not considered: a queue hides some of what is behind it.
        """
        sensors_m = np.ascontiguousarray(sensors_m, np.float64)
        upstream, from_bar = self._before.shares(sensors_m, range_m)
        downstream, _ = self._behind.shares(sensors_m, range_m)
        return Covered(upstream, downstream, from_bar)


class _Side:
    """Places (N, 2) of lanes, by lane and by distance to the stop bar."""

    def __init__(
        self, names: list[str], places_m: Floats, owners: list[str], left_m: Floats
    ) -> None:
        number = {name: index for index, name in enumerate(names)}
        owner = np.array([number[one] for one in owners], np.int64)
        order = np.lexsort((left_m, owner))
        self._names = names
        self._places_m = places_m[order]
        self._total = np.bincount(owner, minlength=len(names))

    def shares(self, sensors_m: Floats, range_m: float) -> tuple[CoverageShares, CoverageShares]:
        """Returns the shares of each lane: in all, and up to its first gap."""
        seen = _within(self._places_m, self._total, sensors_m, float(range_m**2))
        known = [*zip(self._names, seen.tolist(), self._total.tolist(), strict=True)]
        in_all = {name: round(one / total, 3) for name, (one, _), total in known if total}
        unbroken = {name: round(one / total, 3) for name, (_, one), total in known if total}
        return in_all, unbroken


@njit("int64[:,::1](float64[:,::1], int64[::1], float64[:,::1], float64)", cache=True, nogil=True)
def _within(places_m: Floats, total: Ints, sensors_m: Floats, range_m2: float) -> Ints:
    """Counts by lane the places (N, 2) within range of a sensor (S, 2): all, and up to a gap.

    The places are those of the first lane, then those of the next, as many of each as in total.
    """
    seen = np.zeros((len(total), 2), np.int64)
    place = 0
    for lane in range(len(total)):
        is_whole = True
        for _ in range(total[lane]):
            is_seen = False
            for sensor in range(len(sensors_m)):
                x = places_m[place, 0] - sensors_m[sensor, 0]
                y = places_m[place, 1] - sensors_m[sensor, 1]
                if x * x + y * y <= range_m2:
                    is_seen = True
                    break
            is_whole &= is_seen
            seen[lane, 0] += is_seen
            seen[lane, 1] += is_whole
            place += 1
    return seen


def _places(
    road_map: RoadMap, reaches: Mapping[str, Approach], low_m: float, high_m: float
) -> tuple[Floats, list[str], Floats]:
    """Returns places whose distance to the stop bar is between two, the lane and that of each."""
    places, owners, left = [np.zeros((0, 2))], [], [np.zeros(0)]
    for lane in road_map.lanes:
        reach = reaches.get(lane.id)
        if reach is None:
            continue
        along_m = np.arange(SPACING_M / 2, lane.measured_m, SPACING_M)
        left_m = reach.start_m - along_m
        is_inside = (left_m >= low_m) & (left_m <= high_m)
        places.append(_at(lane, along_m[is_inside]))
        left.append(left_m[is_inside])
        owners += [reach.counts_for] * int(is_inside.sum())
    return np.concatenate(places), owners, np.concatenate(left)


def _at(lane: Lane, along_m: Floats) -> Floats:
    """Returns places (N, 2) so far along a lane's centreline (N,)."""
    points = lane.points[:, :2]
    ends_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    return np.column_stack([np.interp(along_m, ends_m, points[:, axis]) for axis in range(2)])
