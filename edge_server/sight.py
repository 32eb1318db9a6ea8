"""How much of each lane's reach lies within sight of a LiDAR."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from edge_server.lanes import LaneIndex, Reach
from perception.arrays import Bools, Floats
from protocol.roadmap import Lane, RoadMap

SPACING_M = 4.0
Shares = dict[str, float]


class Sight:
    """Knows places along the reach of each lane that counts: before the stop bar, and behind it."""

    def __init__(
        self, road_map: RoadMap, lanes: LaneIndex, *, upstream_m: float, downstream_m: float
    ) -> None:
        before = _places(road_map, lanes.upstream, 0.0, upstream_m)
        behind = _places(road_map, lanes.downstream, -downstream_m, np.inf)
        self._sides = [
            _Side(road_map.incoming, *before),
            _Side(road_map.outgoing, *behind),
        ]

    def shares(self, sensors_m: Floats, sight_m: float) -> tuple[Shares, Shares]:
        """Returns by lane the share within sight of any sensor (S, 2), upstream and downstream.

        What stands in between is not asked: a queue hides some of what is behind it.
        """
        upstream, downstream = (side.shares(sensors_m, sight_m) for side in self._sides)
        return upstream, downstream


class _Side:
    """Places (N, 2) and the number of the lane that each counts for (N,)."""

    def __init__(self, names: list[str], places_m: Floats, owners: list[str]) -> None:
        self._names = names
        self._places_m = places_m
        number = {name: index for index, name in enumerate(names)}
        self._owner = np.array([number[owner] for owner in owners], np.int64)
        self._total = np.bincount(self._owner, minlength=len(names))

    def shares(self, sensors_m: Floats, sight_m: float) -> Shares:
        x_m, y_m = self._places_m.T[:, :, None]
        apart_m2 = (x_m - sensors_m[:, 0]) ** 2 + (y_m - sensors_m[:, 1]) ** 2
        near: Bools = (apart_m2 <= sight_m**2).any(axis=1)
        seen = np.bincount(self._owner[near], minlength=len(self._names))
        known = zip(self._names, seen.tolist(), self._total.tolist(), strict=True)
        return {name: round(one / all_of, 3) for name, one, all_of in known if all_of}


def _places(
    road_map: RoadMap, reaches: Mapping[str, Reach], low_m: float, high_m: float
) -> tuple[Floats, list[str]]:
    """Returns places whose distance to the stop bar is between two, and whom each counts for."""
    places, owners = [np.zeros((0, 2))], []
    for lane in road_map.lanes:
        reach = reaches.get(lane.id)
        if reach is None:
            continue
        along_m = np.arange(SPACING_M / 2, lane.length_m, SPACING_M)
        left_m = reach.start_m - along_m
        along_m = along_m[(left_m >= low_m) & (left_m <= high_m)]
        places.append(_at(lane, along_m))
        owners += [reach.counts_for] * len(along_m)
    return np.concatenate(places), owners


def _at(lane: Lane, along_m: Floats) -> Floats:
    """Returns places (N, 2) so far along a lane's centreline (N,)."""
    points = lane.points[:, :2]
    ends_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    scaled = along_m * ends_m[-1] / lane.length_m
    return np.column_stack([np.interp(scaled, ends_m, points[:, axis]) for axis in range(2)])
