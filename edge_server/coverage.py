"""Sensor coverage: how much of each lane the sensors see whose data were used.

A sensor sees as far as it is trusted. Where its agent sends the part of the scene alone that a plan
gave it, the rest of what it sees is not known: an area whose agent sent nothing is not empty.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from edge_server.power_diagram import LEAST_EDGE_M
from perception.arrays import Bools, Floats, Ints
from protocol.approaches import Approach, Approaches
from protocol.roadmap import Lane, RoadMap

SPACING_M = 4.0
CoverageShares = dict[str, float]


@dataclass(frozen=True, slots=True)
class Covered:
    """Shares by lane that sensors cover, see `protocol.messages.LaneCounts`."""

    upstream: CoverageShares
    downstream: CoverageShares
    from_bar: CoverageShares


@dataclass(frozen=True, slots=True, eq=False)
class SensorViews:
    """Places (S, 2) of sensors, and the convex part of the scene that each one's data are of.

    `corners` (S, V, 2) are in CCW order, `numbers` (S,) of them count: -1 for all that it sees, 0
    for nothing.
    """

    places_m: Floats
    corners_m: Floats
    numbers: Ints

    @classmethod
    def of(cls, places_m: Floats, cells: Sequence[Floats | None] = ()) -> SensorViews:
        """Returns the views of sensors: those with a cell (V, 2) of that alone."""
        cells = cells or [None] * len(places_m)
        most = max((len(cell) for cell in cells if cell is not None), default=0)
        corners_m = np.zeros((len(cells), most, 2))
        numbers = np.full(len(cells), -1, np.int64)
        for index, cell in enumerate(cells):
            if cell is not None:
                corners_m[index, : len(cell)], numbers[index] = cell, len(cell)
        return cls(np.asarray(places_m, np.float64).reshape(-1, 2), corners_m, numbers)

    def and_whole(self, places_m: Floats) -> SensorViews:
        """Returns these and further sensors, of which all that they see is known."""
        others = len(places_m)
        empty = np.zeros((others, *self.corners_m.shape[1:]))
        return SensorViews(
            np.concatenate([self.places_m, places_m]),
            np.concatenate([self.corners_m, empty]),
            np.concatenate([self.numbers, np.full(others, -1, np.int64)]),
        )

    def within(self, places_m: Floats, range_m: float) -> Bools:
        """Returns which places (N, 2) are within range of a sensor that tells of them."""
        sensors_m = np.ascontiguousarray(self.places_m)
        return np.asarray(
            _within(places_m, sensors_m, self.corners_m, self.numbers, float(range_m**2))
        )


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

    def shares(self, sensors: SensorViews, range_m: float) -> Covered:
        """Returns by lane the shares within range of any sensor that tells of that place.

        Occlusion is not considered: a queue hides some of what is behind it.
        """
        upstream, from_bar = self._before.shares(sensors, range_m)
        downstream, _ = self._behind.shares(sensors, range_m)
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
        self._places_m = np.ascontiguousarray(places_m[order])
        self._owner = owner[order]
        self._total = np.bincount(owner, minlength=len(names))
        begins = np.cumsum(self._total) - self._total
        self._rank = np.arange(len(owner)) - begins[self._owner]

    def shares(self, sensors: SensorViews, range_m: float) -> tuple[CoverageShares, CoverageShares]:
        """Returns the shares of each lane: in all, and up to its first gap."""
        seen = sensors.within(self._places_m, range_m)
        number, first_gap = np.bincount(self._owner[seen], minlength=len(self._names)), self._total
        if not seen.all():
            first_gap = first_gap.copy()
            np.minimum.at(first_gap, self._owner[~seen], self._rank[~seen])
        return self._by_lane(number), self._by_lane(first_gap)

    def _by_lane(self, numbers: Ints) -> CoverageShares:
        """Returns the share that so many places (L,) are of each lane's, of lanes that have any."""
        rows = zip(self._names, numbers.tolist(), self._total.tolist(), strict=True)
        return {name: round(number / total, 3) for name, number, total in rows if total}


@njit("boolean(float64, float64, float64[:,::1], int64)", cache=True, nogil=True)
def _is_inside(x: float, y: float, corners: Floats, number: int) -> bool:
    """Whether a place lies in a convex polygon (V, 2) of so many corners, in CCW order."""
    has_area = False
    for corner in range(number):
        x0, y0 = corners[corner]
        x1, y1 = corners[(corner + 1) % number]
        along_x, along_y = x1 - x0, y1 - y0
        is_edge = abs(along_x) + abs(along_y) > LEAST_EDGE_M  # a shorter one has no direction
        if is_edge and along_x * (y - y0) - along_y * (x - x0) < 0.0:
            return False
        has_area |= is_edge
    return has_area


@njit(
    "boolean[::1](float64[:,::1], float64[:,::1], float64[:,:,::1], int64[::1], float64)",
    cache=True,
    nogil=True,
)
def _within(
    places_m: Floats, sensors_m: Floats, corners_m: Floats, numbers: Ints, range_m2: float
) -> Bools:
    """Returns which places (N, 2) are within: see `SensorViews.within`."""
    seen = np.zeros(len(places_m), np.bool_)
    for place in range(len(places_m)):
        x, y = places_m[place]
        for sensor in range(len(sensors_m)):
            away_x, away_y = x - sensors_m[sensor, 0], y - sensors_m[sensor, 1]
            if away_x * away_x + away_y * away_y > range_m2:
                continue
            number = numbers[sensor]
            if number < 0 or _is_inside(x, y, corners_m[sensor], number):
                seen[place] = True
                break
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
