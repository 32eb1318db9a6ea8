"""Regions: the intersections that one edge server serves, and the roads that it needs for that.

A lane belongs to the region of its intersection (`Lane.tls`). A region's `area` also holds lanes of
others: those on which vehicles count for its signals, behind their stop bars, and those that a
sensor at one of its intersections covers. Where the areas of two regions overlap is the border
strip between them.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from protocol.approaches import Approaches
from protocol.roadmap import MAP_RADIUS_M, Lane, RoadMap, distance_m

AROUND_M = 150.0
"""Distance around its area within which a region has all lanes, m: its agents stay within it."""
_EDGE_M = 10.0  # of the map: a vehicle there may be on a lane whose centreline lies beyond it


@dataclass(frozen=True, slots=True, eq=False)
class RegionMap:
    """A region's roads: its own and counted lanes, and all lanes on and around them.

    Both hold the region's intersections alone. `centres` (C, 3) are those of all of the net;
    beyond `bounds`, the least and the greatest x, y (2, 2), `surroundings` may lack lanes.
    """

    id: str
    area: RoadMap
    surroundings: RoadMap
    centres: npt.NDArray[np.float64]
    bounds: npt.NDArray[np.float64]

    @classmethod
    def whole(cls, road_map: RoadMap, region: str = "r0") -> RegionMap:
        """Returns a map as its only region."""
        centres = np.array([one.centre for one in road_map.intersections])
        return cls(region, road_map, road_map, centres, np.array([[-np.inf] * 2, [np.inf] * 2]))

    @classmethod
    def of(cls, road_map: RoadMap, region: str, scenario: Mapping[str, Any]) -> RegionMap:
        """Returns a region's part of the whole map of a scenario."""
        whole = cls.whole(road_map, region)
        junctions = scenario["regions"][region]
        if len(scenario["regions"]) == 1:
            return whole
        area = road_map.part(_area(road_map, junctions, scenario["edge"]), junctions)
        bounds = _around(area.lanes)
        around = road_map.part(_within(road_map, bounds), junctions)
        return cls(region, area, around, whole.centres, bounds)

    def knows(self, x_m: float, y_m: float) -> bool:
        """Whether the surroundings have every lane at a position; elsewhere roads are unknown."""
        low, high = self.bounds
        if not (low[0] <= x_m <= high[0] and low[1] <= y_m <= high[1]):
            return False
        away_m = np.hypot(self.centres[:, 0] - x_m, self.centres[:, 1] - y_m)
        return bool((away_m <= MAP_RADIUS_M - _EDGE_M).any())


def regions_of(road_map: RoadMap, scenario: Mapping[str, Any]) -> dict[str, RegionMap]:
    """Returns the roads of all regions by their id."""
    return {region: RegionMap.of(road_map, region, scenario) for region in scenario["regions"]}


def shared_lanes(one: RegionMap, other: RegionMap) -> RoadMap | None:
    """Returns the lanes of the border strip between two regions; None where there is none."""
    both = one.area.by_id.keys() & other.area.by_id.keys()
    return one.area.part(both, one.area.by_tls) if both else None


def _area(road_map: RoadMap, junctions: Collection[str], edge: Mapping[str, Any]) -> set[str]:
    found = {lane.id for lane in road_map.lanes if lane.tls in junctions}
    for tls in junctions:
        one = road_map.by_tls[tls]
        behind = Approaches(road_map, one).downstream
        found |= {n for n, reach in behind.items() if -reach.start_m < edge["downstream_m"]}
        at, range_m = np.array(one.centre[:2]), edge["coverage_range_m"]
        found |= {lane.id for lane in road_map.lanes if distance_m(lane.points, at) < range_m}
    return found


def _around(area: list[Lane]) -> npt.NDArray[np.float64]:
    inside = np.array([lane.bounds for lane in area])
    return np.array([inside[:, 0].min(axis=0) - AROUND_M, inside[:, 1].max(axis=0) + AROUND_M])


def _within(road_map: RoadMap, around: npt.NDArray[np.float64]) -> set[str]:
    low, high = around
    bounds = np.array([lane.bounds for lane in road_map.lanes])
    near = ((bounds[:, 1] >= low) & (bounds[:, 0] <= high)).all(axis=1)
    return {lane.id for lane, is_near in zip(road_map.lanes, near, strict=True) if is_near}
