"""What perception could reach at best: the vehicles that are visible, and those in range."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from itertools import groupby
from operator import attrgetter
from typing import Any

import numpy as np

from perception.arrays import Floats
from protocol.messages import Equipment
from recorder.run import Run
from recorder.tables import SightingRow, TruthRow

VISIBLE_POINTS = 5  # in the scans of all agents together, as in Chen et al. 2022


class Bounds:
    """Answers frame after frame, in their order.

    A vehicle that reports itself is both: the edge knows of it whatever LiDARs see.
    """

    def __init__(self, run: Run) -> None:
        self._sightings = _by_frame(run.rows(SightingRow))
        self._next = next(self._sightings, None)
        centre = np.array(run.setup.road_map.centre[:2])
        scenario = run.scenario
        mounts: list[dict[str, float]] = scenario.get("roadside_mounts", [])
        places = [centre + np.array([mount["x_m"], mount["y_m"]]) for mount in mounts]
        self._posts = np.array(places).reshape(-1, 2)
        self._post_range_m = _range_m(scenario, "roadside")
        self._cav_range_m = _range_m(scenario, "vehicle")

    def visible(self, frame: int, vehicles: list[TruthRow]) -> set[str]:
        """Returns the vehicles with `VISIBLE_POINTS` or more on them; frames must not go back."""
        points: Counter[str] = Counter()
        while self._next is not None and self._next[0] <= frame:
            if self._next[0] == frame:
                points = self._next[1]
            self._next = next(self._sightings, None)
        seen = {vehicle for vehicle, n in points.items() if n >= VISIBLE_POINTS}
        return seen | _reporting(vehicles)

    def in_range(self, vehicles: list[TruthRow]) -> set[str]:
        """Returns the vehicles whose middle is within the range of a LiDAR."""
        at = np.array([(v.x_m, v.y_m) for v in vehicles]).reshape(-1, 2)
        cavs = at[[v.equipment == Equipment.CAV for v in vehicles]]
        near = _within(at, self._posts, self._post_range_m) | _within(at, cavs, self._cav_range_m)
        inside = {v.vehicle for v, is_near in zip(vehicles, near, strict=True) if is_near}
        return inside | _reporting(vehicles)


def _reporting(vehicles: list[TruthRow]) -> set[str]:
    return {vehicle.vehicle for vehicle in vehicles if vehicle.equipment != Equipment.NONE}


def _within(places: Floats, sensors: Floats, range_m: float) -> np.ndarray:
    apart = np.linalg.norm(places[:, None] - sensors, axis=2)
    return np.asarray((apart <= range_m).any(axis=1))


def _range_m(scenario: dict[str, Any], kind: str) -> float:
    lidar: dict[str, Any] = scenario.get("lidar", {})
    return float(lidar.get(kind, {}).get("range", 0.0))


def _by_frame(rows: Iterator[SightingRow]) -> Iterator[tuple[int, Counter[str]]]:
    """Yields frames with the points on each vehicle, of all agents together."""
    for frame, group in groupby(rows, key=attrgetter("frame")):
        points: Counter[str] = Counter()
        for row in group:
            points.update(json.loads(row.points))
        yield frame, points
