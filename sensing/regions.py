"""Regions that an agent publishes to: those whose roads its sensor covers, with hysteresis."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from protocol.geometry import Floats
from protocol.regions import RegionMap
from protocol.roadmap import RoadMap
from sensing.road import resample

HYSTERESIS_M = 20.0
"""Hysteresis, m: an agent leaves a region this much farther from its roads than it entered it."""
_STEP_M = 10.0


class RegionTracker:
    """Follows which regions each agent belongs to.

    An agent enters a region within `range_m` of its area, and leaves it `HYSTERESIS_M` farther
    away; it always belongs to one region, the nearest, at least.
    """

    def __init__(self, regions: Mapping[str, RegionMap], range_m: float) -> None:
        self._names = list(regions)
        self._places = [_places(region.area) for region in regions.values()]
        self._range_m = range_m
        self._members: dict[str, tuple[str, ...]] = {}

    def update(self, agent: str, place: Sequence[float] | Floats) -> tuple[str, ...]:
        """Returns the regions of an agent that is at x, y (2,) now, in the scenario's order."""
        if len(self._names) == 1:
            return tuple(self._names)
        before = self._members.get(agent, ())
        away_m = [_away_m(places, place) for places in self._places]
        within = [
            name
            for name, metres in zip(self._names, away_m, strict=True)
            if metres <= self._range_m + (HYSTERESIS_M if name in before else 0.0)
        ]
        found = tuple(within or [self._names[int(np.argmin(away_m))]])
        self._members[agent] = found
        return found

    def forget_all_but(self, agents: Iterable[str]) -> None:
        """Forgets the agents that are not named."""
        for agent in self._members.keys() - set(agents):
            del self._members[agent]


def _places(area: RoadMap) -> Floats:
    return np.concatenate([resample(lane.points[:, :2], _STEP_M) for lane in area.lanes])


def _away_m(places: Floats, place: Sequence[float] | Floats) -> float:
    x, y = places[:, 0] - place[0], places[:, 1] - place[1]
    return float(np.sqrt((x * x + y * y).min()))
