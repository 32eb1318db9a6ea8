"""One sample as its pictures show it: what lies in a window around the junction."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from learning.dataset import SceneSample
from perception.arrays import Bools, Floats, Floats32
from perception.config import DetectorName
from perception.detector import Vehicles
from protocol.roadmap import RoadMap
from studies.ecvpr import VISIBLE_POINTS, match
from studies.evaluate import Site, find
from studies.outlines import borders, resampled

Window = tuple[float, float, float, float]  # the lowest x and y, then the highest, m

HALF_WIDTH_M, HALF_HEIGHT_M = 50.0, 30.0
_BESIDE_M = 4.0  # of the road


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Points and boxes on the road in the window, map frame.

    `clouds` has the points (N, 3) of each agent, `singles` the boxes (N, 7) found in its scan;
    `fused` are the latter without duplicates, `merged` those found in all points together. Of the
    `vehicles` (M, 7), `visible` (M,) have points enough.
    """

    road_map: RoadMap
    window: Window
    clouds: dict[str, Floats32]
    singles: dict[str, Floats]
    fused: Floats
    merged: Floats
    vehicles: Floats
    visible: Bools

    def matched(self) -> tuple[Bools, Bools]:
        """Marks which of `merged` (N,) are of a vehicle, and which vehicles (M,) were found.

        A box is a vehicle's if its middle lies in the vehicle's footprint, as for E-CVPR.
        """
        boxes, vehicles = self.merged, self.vehicles
        pairs = match(boxes[:, :2], vehicles[:, [0, 1, 6]], vehicles[:, 3:5])
        true, found = np.zeros(len(boxes), np.bool_), np.zeros(len(vehicles), np.bool_)
        for box, vehicle in pairs:
            true[box] = found[vehicle] = True
        return true, found


def best_of(samples: Iterable[SceneSample]) -> SceneSample | None:
    """Returns the sample with the most scans, of those the one with the most visible vehicles.

    The first of equals; None if there is none.
    """
    return max(samples, key=_worth, default=None)


def view_of(site: Site, sample: SceneSample, name: DetectorName) -> View:
    """Detects at a sample, inside the geofence.

    Raises:
        ConfigError: the detector cannot be had here.
    """
    window = _window(site.road_map)
    found, least = find(site, sample, name, geofence=True), site.least_score(name)

    def shown(vehicles: Vehicles) -> Floats:
        boxes = vehicles.take(vehicles.scores >= least).boxes
        return boxes[site.on_road(boxes) & _inside(boxes, window)]

    agents = _names(sample)
    placed = [site.place(sample, n, geofence=True).points for n in range(len(agents))]
    here = site.on_road(sample.boxes) & _inside(sample.boxes, window)
    return View(
        road_map=site.road_map,
        window=window,
        clouds={a: p[_inside(p, window)] for a, p in zip(agents, placed, strict=True)},
        singles={a: shown(one) for a, (one, _) in zip(agents, found.singles, strict=True)},
        fused=shown(found.late[0]),
        merged=shown(found.merged[0]),
        vehicles=sample.boxes[here],
        visible=_visible(sample)[here],
    )


def _window(road_map: RoadMap) -> Window:
    """Returns a rectangle around the centre, no larger than the road in it needs."""
    centre, half = np.array(road_map.centre[:2]), np.array([HALF_WIDTH_M, HALF_HEIGHT_M])
    sides = [side for lane in road_map.lanes for side in borders(lane)]
    road = np.concatenate([resampled(side)[:, :2] for side in sides]) - centre
    road = road[(np.abs(road) <= half).all(axis=1)]
    low = np.maximum(road.min(axis=0, initial=0.0) - _BESIDE_M, -half) + centre
    high = np.minimum(road.max(axis=0, initial=0.0) + _BESIDE_M, half) + centre
    return (float(low[0]), float(low[1]), float(high[0]), float(high[1]))


def _worth(sample: SceneSample) -> tuple[int, int]:
    return len(sample.scans), int(_visible(sample).sum())


def _visible(sample: SceneSample) -> Bools:
    return np.asarray(sample.points_on.sum(axis=0) >= VISIBLE_POINTS)


def _names(sample: SceneSample) -> list[str]:
    """Returns posts by their ids and CAVs by number: a vehicle's id tells the reader nothing."""
    names, cavs = [], 0
    for scan in sample.scans:
        cavs += scan.own is not None
        names.append(scan.agent if scan.own is None else f"CAV {cavs}")
    return names


def _inside(points: Floats | Floats32, window: Window) -> Bools:
    low, high = window[:2], window[2:]
    return np.asarray(((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1))
