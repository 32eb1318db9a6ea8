"""Figures 3, 5 and 7 of Chen et al. 2022: clouds, detections and truth of one sample."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from learning.dataset import SceneSample
from perception.arrays import Bools, Floats, Floats32
from perception.config import DetectorName
from perception.detector import Vehicles
from protocol.roadmap import RoadMap
from studies import palette
from studies.accuracy import Scenario, junction_of
from studies.ecvpr import VISIBLE_POINTS, match
from studies.evaluate import Site, find
from studies.outlines import borders, footprints, resampled, ring, road_rings, stands_out
from studies.page.model import MapChart, Outlines, Points, Section, SideBySide, Text

Window = tuple[float, float, float, float]  # the lowest x and y, then the highest, m

HALF_WIDTH_M, HALF_HEIGHT_M = 50.0, 30.0
_BESIDE_M = 4.0  # of the road


@dataclass(frozen=True, slots=True, eq=False)
class ShownSample:
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


def shown_sample(site: Site, sample: SceneSample, name: DetectorName) -> ShownSample:
    """Detects at a sample, inside the geofence.

    Raises:
        ConfigError: the detector is not available here.
    """
    window = _window(site.road_map)
    found, least = find(site, sample, name, geofence=True), site.least_score(name)

    def shown(vehicles: Vehicles) -> Floats:
        boxes = vehicles.take(vehicles.scores >= least).boxes
        return boxes[site.on_road(boxes) & _inside(boxes, window)]

    agents = _names(sample)
    placed = [site.place(sample, n, geofence=True).points for n in range(len(agents))]
    here = site.on_road(sample.boxes) & _inside(sample.boxes, window)
    return ShownSample(
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
    """Returns names: posts by their ids, CAVs by number (vehicle ids mean nothing to readers)."""
    names, cavs = [], 0
    for scan in sample.scans:
        cavs += scan.own is not None
        names.append(scan.agent if scan.own is None else f"CAV {cavs}")
    return names


def _inside(points: Floats | Floats32, window: Window) -> Bools:
    low, high = window[:2], window[2:]
    return np.asarray(((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1))


SHOWN_POINTS = 3000
_POINT_SIZE = 3.0


def cloud_maps(view: ShownSample) -> tuple[MapChart, MapChart]:
    """Returns the cloud of the first agent, and all agents' clouds by agent."""
    first = next(iter(view.clouds))
    count = sum(len(points) for points in view.clouds.values())
    single = f"Cloud of one scan, {first}"
    merged = f"Merged cloud of {len(view.clouds)} scans"
    return (
        _map(view, single, points=_clouds(view, [first]), notes=_points(len(view.clouds[first]))),
        _map(view, merged, points=_clouds(view, list(view.clouds)), notes=_points(count)),
    )


def fusion_maps(view: ShownSample) -> tuple[MapChart, MapChart]:
    """Returns the detections of each scan by agent, and those without duplicates."""
    colours = _colours(view)
    before = [_outlines(name, boxes, colours[name]) for name, boxes in view.singles.items()]
    count = sum(len(boxes) for boxes in view.singles.values())
    after = [_outlines("detected", view.fused, palette.PLAIN)]
    return (
        _map(
            view, "Detections before fusion", outlines=before,
            notes=f"{count} detections of {len(before)} scans, one box over another where several "
            "scans show a vehicle.",
        ),
        _map(
            view, "Detections after fusion", outlines=after,
            notes=f"{len(view.fused)} detections, duplicates removed.",
        ),
    )  # fmt: skip


def truth_map(view: ShownSample) -> MapChart:
    """Returns boxes found in the merged cloud over the vehicles."""
    true, found = view.matched()
    missed, hidden = view.visible & ~found, ~view.visible & ~found
    outlines = [
        _outlines("vehicle with too few points", view.vehicles[hidden], palette.QUIET),
        _outlines("vehicle, found", view.vehicles[found], palette.GOOD),
        _outlines("vehicle, visible but missed", view.vehicles[missed], palette.BAD),
        _outlines("detected", view.merged, palette.INK),
    ]
    points = [
        _crosses("missed", view.vehicles[missed], palette.BAD),
        _crosses("false detection", view.merged[~true], palette.INK),
    ]
    of_visible = int((found & view.visible).sum())
    notes = (
        f"Visible vehicles found: {of_visible} of {int(view.visible.sum())}; vehicles in all: "
        f"{len(view.vehicles)}. Boxes: {len(view.merged)}, of them false, second ones of a vehicle "
        f"included: {int((~true).sum())}."
    )
    return _map(
        view, "Detected boxes over true boxes",
        outlines=[one for one in outlines if one.rings],
        points=[one for one in points if one.x_m],
        notes=notes,
    )  # fmt: skip


def _map(
    view: ShownSample,
    title: str,
    *,
    points: list[Points] | None = None,
    outlines: list[Outlines] | None = None,
    notes: str,
) -> MapChart:
    surfaces, lines = road_rings(view.road_map)
    return MapChart(
        title, surfaces, lines, tuple(points or ()), tuple(outlines or ()), view.window, notes
    )


def _colours(view: ShownSample) -> dict[str, str]:
    return {a: palette.SERIES[n % len(palette.SERIES)] for n, a in enumerate(view.clouds)}


def _clouds(view: ShownSample, agents: list[str]) -> list[Points]:
    """Returns clouds without the ground, thinned together to about `SHOWN_POINTS`."""
    colours = _colours(view)
    clouds = {name: _standing(view.clouds[name]) for name in agents}
    total = sum(len(points) for points in clouds.values())
    share = min(1.0, SHOWN_POINTS / max(total, 1))
    return [_cloud(name, _thinned(cloud, share), colours[name]) for name, cloud in clouds.items()]


def _standing(points: Floats32) -> Floats:
    cloud = points.astype(np.float64)
    chosen: Bools = stands_out(cloud)
    return cloud[chosen]


def _thinned(points: Floats, share: float) -> Floats:
    """Returns a share of points, evenly drawn, always the same ones."""
    count = round(share * len(points))
    chosen = np.random.default_rng(0).choice(len(points), count, replace=False)
    return points[np.sort(chosen)]


def _cloud(name: str, points: Floats, colour: str) -> Points:
    x_m, y_m = (tuple(column.tolist()) for column in points[:, :2].round(2).T)
    return Points(name, x_m, y_m, _POINT_SIZE, "disc", colour)


def _crosses(name: str, boxes: Floats, colour: str) -> Points:
    x_m, y_m = (tuple(column.tolist()) for column in boxes[:, :2].round(2).T)
    return Points(name, x_m, y_m, 7.0, "cross", colour)


def _outlines(name: str, boxes: Floats, colour: str) -> Outlines:
    return Outlines(name, tuple(ring(corners) for corners in footprints(boxes)), colour)


def _points(count: int) -> str:
    return f"{count:,} points on the road here; drawn is a sample of those above the ground."


LOOKED_AT = 12  # samples, of which one is shown


def scenes_section(scenario: Scenario, detector: DetectorName, samples: int = LOOKED_AT) -> Section:
    """Returns clouds, detections and truth at the sample with the most scans.

    Raises:
        ConfigError: the junction or the detector is not available.
    """
    title = "Figures 3, 5 and 7: clouds, detections, truth"
    site, listed = junction_of(scenario, samples)
    sample = best_of(listed)
    if sample is None:
        return Section(title, (Text("No sample had a scan, so that there is nothing to show."),))
    view = shown_sample(site, sample, detector)
    return Section(
        title,
        (
            Text(
                f"One sample of {samples}, the one with the most scans, as the detector {detector} "
                f"sees it inside the geofence; all figures are of the part that is shown."
            ),
            Text("Figure 3: clouds before and after merging."),
            SideBySide(cloud_maps(view)),
            Text("Figure 5: detections before and after fusion."),
            SideBySide(fusion_maps(view)),
            Text("Figure 7: detected boxes over true boxes."),
            truth_map(view),
        ),
    )
