"""Evaluation of detectors as in Table 1 of Chen et al. 2022: single scans, merged clouds.

Of merged clouds there are two kinds: detection in all points together (early fusion), and in each
scan alone, duplicates removed afterwards (late fusion). A scene is a square around the sensor, or
around the junction's centre for merged clouds.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.stats import t as student_t

from edge_server.config import EdgeConfig
from edge_server.fusion import fuse
from edge_server.lanes import LaneIndex
from learning.dataset import SceneSample
from perception.arrays import Bools, Floats, Ints
from perception.config import LEARNED, DetectorName
from perception.detector import Cloud, Detector, Vehicles
from perception.map_height import on_the_ground
from perception.registry import detector_of
from perception.roadway import Placed, Roadway
from protocol.geometry import SE3
from protocol.messages import ObjectClass
from protocol.roadmap import RoadMap
from studies.average_precision import (
    Outcomes,
    Scene,
    Score,
    View,
    average_precision,
    outcomes,
)
from studies.bench import JsonRow
from studies.ecvpr import VISIBLE_POINTS

Truth = Literal["all", "visible"]
Kind = tuple[Literal["single", "merged"], Literal["none", "early", "late"]]
Timed = tuple[Vehicles, float]  # detections, and their time in ms

RANGE_M = 80.0  # of x and y, as the paper's PointPillars
CUT_M = 90.0  # points are given so far, so that a vehicle at the border is whole
IOUS = (0.01, 0.1, 0.3, 0.5, 0.7)
VIEWS: tuple[View, ...] = ("bev", "3d")
TRUTHS: tuple[Truth, ...] = ("all", "visible")
KINDS: tuple[Kind, ...] = (("single", "none"), ("merged", "early"), ("merged", "late"))
EVERYTHING = "all"
LISTED_SCORE = 0.02  # of a learned detector, boxes down to this one are ranked for AP40
_WIDE_M = 150.0  # from the lanes: more than any point of a scene is away


VEHICLE = "vehicle"
OBJECTS = {
    VEHICLE: (ObjectClass.CAR, ObjectClass.TRUCK, ObjectClass.TWO_WHEELER),
    **{one.name.lower(): (one,) for one in ObjectClass},
}
"""Objects that can be evaluated, and the classes that they comprise."""


@dataclass(frozen=True, slots=True)
class EvalRow(JsonRow):
    """AP40, recall and precision of a detector for one kind of objects, cloud and view.

    `part` is `all`, a range of distances or one of points on the vehicle; of points there is recall
    only, because a false detection has none. `detect_ms` is the median time of a cloud. `objects`
    are `vehicle`, of whatever detected class, or a class: then detections and truth of that class
    alone count. `ap40_half` is half of AP40's 95 % interval over networks (jackknife); None for
    parts, or with fewer than three networks.
    """

    detector: str
    cloud: str
    fusion: str
    truth: Truth
    geofence: bool
    view: View
    iou: float
    part: str
    scenes: int
    vehicles: int
    ap40: float | None
    recall: float | None
    precision: float | None
    detect_ms: float
    objects: str = VEHICLE
    ap40_half: float | None = None


@dataclass(frozen=True, slots=True)
class Part:
    """Which vehicles count: by their distance or by the points on them, from low to below high."""

    name: str
    of: Literal["distance", "points"]
    low: float
    high: float


ALL = Part(EVERYTHING, "distance", 0, np.inf)
BY_DISTANCE = (
    Part("0-30 m", "distance", 0, 30),
    Part("30-50 m", "distance", 30, 50),
    Part("50-80 m", "distance", 50, 80),
    Part("beyond 80 m", "distance", 80, np.inf),
)
BY_POINTS = (
    Part("1-4 points", "points", 1, 5),
    Part("5-19 points", "points", 5, 20),
    Part("20-99 points", "points", 20, 100),
    Part("100+ points", "points", 100, np.inf),
)


@dataclass(frozen=True, slots=True, eq=False)
class ScoredScene:
    """A scene's detections beside its vehicles: (N,) as they were given, (M,) of the truth.

    Distances are those from the scene's middle; infinite for those that do not count.
    """

    network: str
    scene: Scene
    found_m: Floats
    vehicles_m: Floats
    points: Ints
    took_ms: float

    def due(self, truth: Truth, part: Part) -> Bools:
        """Marks the vehicles (M,) that must be found."""
        value = self.vehicles_m if part.of == "distance" else self.points
        due = np.isfinite(self.vehicles_m) & (value >= part.low) & (value < part.high)
        return np.asarray(due & (self.points >= VISIBLE_POINTS) if truth == "visible" else due)

    def fair(self, part: Part) -> Bools:
        """Marks the detections (N,) that are false where they match nothing."""
        fair = np.isfinite(self.found_m)
        if part.of == "distance":
            fair &= (self.found_m >= part.low) & (self.found_m < part.high)
        return fair


@dataclass(frozen=True, slots=True)
class SampleDetections:
    """Detections of a detector at a sample.

    In each scan alone, in the order of the scans; in all points together (early fusion); and in
    each scan alone, duplicates removed (late fusion). All but the last include boxes whose score is
    too low for a vehicle.
    """

    singles: list[Timed]
    merged: Timed
    late: Timed


class Site:
    """A junction's road, twice: as the geofence has it, and with the whole plane around it."""

    def __init__(self, road_map: RoadMap, config: EdgeConfig) -> None:
        self.road_map = road_map
        self.centre = SE3(np.eye(3), np.array(road_map.centre))
        self._config = config
        self._lanes = LaneIndex(road_map)
        self._detectors: dict[tuple[DetectorName, bool], Detector] = {}

    @cached_property
    def _fenced(self) -> Roadway:
        return Roadway.of(self.road_map, margin_m=self._config.geofence.margin_m)

    @cached_property
    def _wide(self) -> Roadway:
        """Every cell belongs to the road, at the height of the nearest lane."""
        return Roadway.of(self.road_map, margin_m=_WIDE_M)

    def roadway(self, *, geofence: bool) -> Roadway:
        """Returns the raster on which points are placed."""
        return self._fenced if geofence else self._wide

    def detector(self, name: DetectorName, *, geofence: bool) -> Detector:
        """Returns the detector of this name; it is made once."""
        key = (name, geofence)
        if key not in self._detectors:
            pillars = self._config.pillars.model_copy(update={"min_score": LISTED_SCORE})
            config = self._config.model_copy(update={"detector": name, "pillars": pillars})
            self._detectors[key] = detector_of(config, self.roadway(geofence=geofence))
        return self._detectors[key]

    def least_score(self, name: DetectorName) -> float:
        """Returns the score from which the edge takes a box for a vehicle."""
        return self._config.pillars.min_score if name in LEARNED else 0.0

    def place(self, sample: SceneSample, number: int, *, geofence: bool) -> Placed:
        """Moves a scan into the map; without the geofence, whatever its height."""
        fence, scan = self._config.geofence, sample.scans[number]
        below_m, above_m = (fence.below_m, fence.above_m) if geofence else (np.inf, np.inf)
        near = (np.abs(scan.points[:, :2]) < CUT_M).all(axis=1)
        return self.roadway(geofence=geofence).place(
            scan.points[near], scan.map_SE3_sensor, below_m=below_m, above_m=above_m
        )

    def on_road(self, boxes: Floats) -> Bools:
        """Marks the boxes (N, 7) whose middles are inside the geofence."""
        margin_m = np.full(len(boxes), self._config.geofence.margin_m)
        return np.asarray(self._lanes.locate(boxes, margin_m=margin_m).lane >= 0)

    def without_doubles(self, found: Vehicles) -> Vehicles:
        """Removes duplicates as the edge does."""
        return fuse(found, [], centres=self.centre.translation[None], config=self._config.fusion)


def evaluate(
    samples: Iterable[tuple[Site, SceneSample]],
    detectors: Sequence[DetectorName],
    geofences: Sequence[bool] = (True, False),
) -> list[EvalRow]:
    """Returns all rows of these detectors, with and without the geofence.

    Raises:
        ConfigError: a detector is not available here.
    """
    judged: dict[tuple[str, bool, Kind, str], list[ScoredScene]] = {}
    least: dict[str, float] = {}
    for site, sample in samples:
        for name in detectors:
            least[name] = site.least_score(name)
            for geofence in geofences:
                for kind, objects, one in score_sample(site, sample, name, geofence=geofence):
                    judged.setdefault((name, geofence, kind, objects), []).append(one)
    return [row for key, scenes in judged.items() for row in rows_of(*key, scenes, least[key[0]])]


def find(
    site: Site, sample: SceneSample, name: DetectorName, *, geofence: bool
) -> SampleDetections:
    """Detects in a sample's scans, alone and together."""
    detector = site.detector(name, geofence=geofence)
    placed = [site.place(sample, n, geofence=geofence) for n in range(len(sample.scans))]
    sensors = np.array([scan.map_SE3_sensor.translation for scan in sample.scans])
    cut = [_cut(part, site.centre) for part in placed]

    def timed(near: Sequence[Placed], seen_from: Floats, number: int) -> Timed:
        rng = np.random.default_rng([sample.frame, number])
        start = time.perf_counter()
        found = detector.detect(on_the_ground(Cloud(near, [], seen_from)), rng)
        return found, 1e3 * (time.perf_counter() - start)

    singles = [timed([one], sensors[n : n + 1], n) for n, one in enumerate(placed)]
    together = Vehicles.from_lidar(np.zeros((0, 7)), np.zeros(0))
    for found, _ in singles:
        together = together + found
    together = together.take(together.scores >= site.least_score(name))
    late = site.without_doubles(together), sum(took_ms for _, took_ms in singles)
    return SampleDetections(singles, timed(cut, sensors, len(placed)), late)


def score_sample(
    site: Site, sample: SceneSample, name: DetectorName, *, geofence: bool
) -> Iterator[tuple[Kind, str, ScoredScene]]:
    """Detects in a sample's scans, alone and together, and compares with the truth, by objects."""
    on_road = site.on_road(sample.boxes) if geofence else np.ones(len(sample.boxes), np.bool_)
    found = find(site, sample, name, geofence=geofence)
    together = sample.points_on.sum(axis=0), on_road
    clouds = [(KINDS[1], found.merged, site.centre, together)]
    clouds += [(KINDS[2], found.late, site.centre, together)]
    for number, (scan, single) in enumerate(zip(sample.scans, found.singles, strict=True)):
        others = on_road & (np.arange(len(sample.boxes)) != (-1 if scan.own is None else scan.own))
        seen = sample.points_on[number], others
        clouds.append((KINDS[0], single, scan.map_SE3_sensor, seen))
    for kind, (vehicles, took_ms), map_SE3_scene, seen in clouds:
        inside = vehicles.take(site.on_road(vehicles.boxes)) if geofence else vehicles
        for objects in OBJECTS:
            yield kind, objects, _scored(sample, (inside, took_ms), map_SE3_scene, seen, objects)


def _scored(
    sample: SceneSample, found: Timed, map_SE3_scene: SE3, seen: tuple[Ints, Bools], objects: str
) -> ScoredScene:
    """Compares detections with the truth, of some classes; `seen` are points on vehicles."""
    vehicles, took_ms = found
    detected = vehicles.take(np.isin(vehicles.classes, OBJECTS[objects]))
    asked = np.isin(sample.classes, OBJECTS[objects])
    boxes, (points, counts) = sample.boxes[asked], seen
    return ScoredScene(
        sample.network,
        Scene.of(detected.boxes, detected.scores, boxes),
        _away_m(detected.boxes, map_SE3_scene),
        np.where(counts[asked], _away_m(boxes, map_SE3_scene), np.inf),
        points[asked],
        took_ms,
    )


def rows_of(
    detector: str,
    geofence: bool,
    kind: Kind,
    objects: str,
    scenes: list[ScoredScene],
    least_score: float,
) -> list[EvalRow]:
    """Returns the rows of scenes of one kind: all counted both ways, vehicles by parts, too."""
    cells = [(truth, ALL) for truth in TRUTHS]
    if objects == VEHICLE:
        cells += [("visible", part) for part in BY_DISTANCE] + [("all", part) for part in BY_POINTS]
    median_ms = float(np.median([one.took_ms for one in scenes]))
    rows = []
    for truth, part in cells:
        due = [one.due(truth, part) for one in scenes]
        fair = [one.fair(part) for one in scenes]
        for view in VIEWS:
            for iou in IOUS:
                found = [
                    outcomes(one.scene, view, iou, *masks)
                    for one, *masks in zip(scenes, due, fair, strict=True)
                ]
                tally = _Tally(scenes, found, [int(mask.sum()) for mask in due], least_score)
                score = tally.score()
                of_points = part.of == "points"
                rows.append(
                    EvalRow(
                        detector, *kind, truth, geofence, view, iou, part.name,
                        scenes=len(scenes),
                        vehicles=score.vehicles,
                        ap40=None if of_points else score.ap40,
                        recall=score.recall,
                        precision=None if of_points else score.precision,
                        detect_ms=median_ms,
                        objects=objects,
                        ap40_half=tally.ap40_half() if part is ALL else None,
                    )
                )  # fmt: skip
    return rows


@dataclass(frozen=True, slots=True)
class _Tally:
    """Scenes, the outcomes of their detections, and how many objects each has to be found."""

    scenes: list[ScoredScene]
    found: list[Outcomes]
    due: list[int]
    least_score: float

    def score(self, without: str | None = None) -> Score:
        """Returns the score of all scenes, or of all but one network's."""
        chosen = [n for n, one in enumerate(self.scenes) if one.network != without]
        return average_precision(
            [self.found[n] for n in chosen],
            [self.scenes[n].scene.scores for n in chosen],
            sum(self.due[n] for n in chosen),
            self.least_score,
        )

    def ap40_half(self) -> float | None:
        """Returns half of the 95 % interval of AP40 over networks: jackknife, Student's t."""
        networks = sorted({one.network for one in self.scenes})
        if len(networks) < LEAST_NETWORKS:
            return None
        left = [self.score(without=name).ap40 for name in networks]
        known = np.array([one for one in left if one is not None])
        if len(known) < len(networks):
            return None
        spread = (len(known) - 1) / len(known) * float(((known - known.mean()) ** 2).sum())
        quantile = float(student_t.ppf(0.975, len(known) - 1))
        return float(quantile * np.sqrt(spread))


LEAST_NETWORKS = 3


def _away_m(boxes: Floats, map_SE3_scene: SE3) -> Floats:
    """Returns the level distance (N,) from a scene's middle, infinite out of its range."""
    local = (boxes[:, :3] - map_SE3_scene.translation) @ map_SE3_scene.rotation
    inside = (np.abs(local[:, :2]) <= RANGE_M).all(axis=1)
    return np.where(inside, np.hypot(local[:, 0], local[:, 1]), np.inf)


def _cut(placed: Placed, map_SE3_scene: SE3) -> Placed:
    off = np.abs(placed.points[:, :2] - map_SE3_scene.translation[:2].astype(np.float32))
    near = (off < CUT_M).all(axis=1)
    return Placed.of(placed.points[near], placed.road_m[near])
