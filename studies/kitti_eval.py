"""Evaluation of detectors on files with labels in KITTI's format, by KITTI's rules.

Detections of similar classes (vans for cars, sitting people for people) count neither as true nor
as false. Neither does a detection of which half or more, in the image, lies in a region DontCare,
one on a box DontCare, or one out of the image, where nothing is labelled. Labels harder than the
given level, or beyond the range, need not be found.

There is no map: the ground around the sensor is the road.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from edge_server.config import EdgeConfig
from learning.dataset import SceneSample, SensorScan
from learning.kitti_object import DONT_CARE, KittiFrame, KittiObject, points_in
from perception.arrays import Bools, Floats, Floats32, Ints
from perception.boxes import overlaps
from perception.config import DetectorName
from perception.detector import Cloud, Vehicles
from perception.map_height import on_the_ground
from protocol.geometry import SE3
from protocol.messages import ObjectClass
from recording.foreign_scans.importer import ground_around
from sensing.point_files import read_points
from studies.average_precision import Outcomes, Scene, average_precision, outcomes
from studies.ecvpr import VISIBLE_POINTS
from studies.evaluate import EVERYTHING, IOUS, OBJECTS, TRUTHS, VEHICLE, VIEWS, EvalRow, Site

_KINDS = {
    VEHICLE: (("Car", "Van", "Truck", "Cyclist"), ("Tram", "Misc", DONT_CARE)),
    "car": (("Car",), ("Van", DONT_CARE)),
    "truck": (("Truck",), ("Van", "Tram", DONT_CARE)),
    "two_wheeler": (("Cyclist",), (DONT_CARE,)),
    "pedestrian": (("Pedestrian",), ("Person_sitting", DONT_CARE)),
}
"""By evaluated object: KITTI's types that must be found, and similar ones, which are ignored."""
_LEVELS = {"easy": (40.0, 0, 0.15), "moderate": (25.0, 1, 0.3), "hard": (25.0, 2, 0.5)}
"""Least height in the image in pixels, most occlusion, most truncation."""
LEVELS = (EVERYTHING, *_LEVELS)
_DONT_CARE_SHARE = 0.5
_OWN_M = (2.75, 1.25)  # half of the carrying vehicle's length and width


@dataclass(frozen=True, slots=True, eq=False)
class JudgedFrame:
    """A frame's detections (N,) beside its labels with boxes (M,), and the points in these (M,).

    Of a learned detector, detections are listed down to scores too low for a vehicle; from
    `least_score` on they count.
    """

    frame: KittiFrame
    found: Vehicles
    objects: Sequence[KittiObject]
    points: Ints
    took_ms: float
    least_score: float

    @property
    def certain(self) -> Bools:
        """Which detections count (N,)."""
        return np.asarray(self.found.scores >= self.least_score)


def evaluate_kitti(
    frames: Iterable[KittiFrame],
    detectors: Sequence[DetectorName],
    config: EdgeConfig,
    range_m: float,
) -> list[EvalRow]:
    """Returns rows of these detectors, for objects and levels of difficulty.

    Raises:
        ConfigError: a cloud cannot be read, or a detector is not available here.
    """
    judged: dict[DetectorName, list[JudgedFrame]] = {name: [] for name in detectors}
    for number, frame in enumerate(frames):
        for name, one in judge(frame, detectors, config, range_m, number).items():
            judged[name].append(one)
    return [row for name, scenes in judged.items() for row in _rows(name, scenes, range_m)]


def judge(
    frame: KittiFrame,
    detectors: Sequence[DetectorName],
    config: EdgeConfig,
    range_m: float,
    seed: int = 0,
) -> dict[DetectorName, JudgedFrame]:
    """Detects in a frame; detections on the vehicle that carries the sensor are left out.

    Raises:
        ConfigError: the cloud cannot be read, or a detector is not available here.
    """
    config = config.model_copy(update={"solid_only": True})  # as a replay without a road map
    cloud = read_points(frame.cloud)
    site = Site(ground_around(cloud, frame.name, range_m), config)
    return {name: _judge(site, frame, cloud.points, name, seed) for name in detectors}


def _judge(
    site: Site, frame: KittiFrame, points: Floats32, name: DetectorName, number: int
) -> JudgedFrame:
    scan = SensorScan(frame.name, points, SE3.identity(), None)
    no_boxes = np.zeros((0, 7)), np.zeros(0, np.uint8), np.zeros((1, 0), np.int64)
    sample = SceneSample(frame.name, number, [scan], *no_boxes)
    placed = site.place(sample, 0, geofence=True)
    cloud = on_the_ground(Cloud([placed], [], np.zeros((1, 3))))
    start = time.perf_counter()
    found = site.detector(name, geofence=True).detect(cloud, np.random.default_rng(number))
    took_ms = 1e3 * (time.perf_counter() - start)
    is_own = np.asarray((np.abs(found.boxes[:, :2]) < _OWN_M).all(axis=1))
    objects = [one for one in frame.objects if np.isfinite(one.box).all()]
    counts = np.array([points_in(points, one.box) for one in objects], np.int64)
    least_score = site.least_score(name)
    return JudgedFrame(frame, found.take(~is_own), objects, counts, took_ms, least_score)


NEAR_M, NEAR_IOU = 2.0, 0.3
"""Off a vehicle's middle, or from above with it: what makes a detection right in `hits_of`."""


@dataclass(frozen=True, slots=True)
class Hits:
    """Labelled vehicles, those found, detected vehicles, and those of them that are right."""

    vehicles: int
    found: int
    boxes: int
    right: int


def hits_of(one: JudgedFrame, range_m: float) -> Hits:
    """Counts cars and lorries within range by a rule that suits labels made by hand.

    A label with fewer than 5 points need not be found; a detection that is right for no vehicle but
    on a DontCare, or on a vehicle of few points, is not counted.
    """
    detected = one.found.take((one.found.classes < ObjectClass.TWO_WHEELER) & one.certain)
    boxes = detected.boxes[np.hypot(*detected.boxes[:, :2].T) <= range_m]
    labels = np.array([label.box for label in one.objects]).reshape(-1, 7)
    due = np.array([label.kind in _KINDS[VEHICLE][0] for label in one.objects], np.bool_)
    due &= (one.points >= VISIBLE_POINTS) & (np.hypot(*labels[:, :2].T) <= range_m)
    off_m = np.hypot(*(boxes[:, None, :2] - labels[None, :, :2]).transpose(2, 0, 1))
    match = (overlaps(boxes, labels)[0] > NEAR_IOU) | (off_m < NEAR_M)
    right = match[:, due].any(axis=1)
    ignored = match.any(axis=1) & ~right
    found = int(match[:, due].any(axis=0).sum())
    return Hits(int(due.sum()), found, int((~ignored).sum()), int(right.sum()))


def _rows(detector: str, scenes: Sequence[JudgedFrame], range_m: float) -> Iterator[EvalRow]:
    if not scenes:
        return
    median_ms = float(np.median([one.took_ms for one in scenes]))
    for objects in OBJECTS:
        for level in LEVELS:
            compared = [_compared(one, objects, level, range_m) for one in scenes]
            for truth in TRUTHS:
                due = [
                    one.due & (one.points >= VISIBLE_POINTS) if truth == "visible" else one.due
                    for one in compared
                ]
                for view in VIEWS:
                    for iou in IOUS:
                        results: list[Outcomes] = [
                            outcomes(one.scene, view, iou, must, one.fair)
                            for one, must in zip(compared, due, strict=True)
                        ]
                        score = average_precision(
                            results,
                            [one.scene.scores for one in compared],
                            sum(int(must.sum()) for must in due),
                            scenes[0].least_score,
                        )
                        yield EvalRow(
                            detector, "single", "none", truth, False, view, iou, level,
                            scenes=len(scenes),
                            vehicles=score.vehicles,
                            ap40=score.ap40,
                            recall=score.recall,
                            precision=score.precision,
                            detect_ms=median_ms,
                            objects=objects,
                        )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class _Compared:
    """Detections and labels of some classes: which labels are due (M,), which detections fair."""

    scene: Scene
    due: Bools
    points: Ints
    fair: Bools


def _compared(one: JudgedFrame, objects: str, level: str, range_m: float) -> _Compared:
    due_kinds, neither = _KINDS[objects]
    known = [n for n, label in enumerate(one.objects) if label.kind in (*due_kinds, *neither)]
    labels = [one.objects[n] for n in known]
    truth = np.array([label.box for label in labels]).reshape(-1, 7)
    due = np.array([label.kind in due_kinds and _is_of(label, level) for label in labels], np.bool_)
    due &= np.hypot(truth[:, 0], truth[:, 1]) <= range_m
    found = one.found.take(np.isin(one.found.classes, OBJECTS[objects]))
    fair = np.hypot(found.boxes[:, 0], found.boxes[:, 1]) <= range_m
    image, inside = one.frame.calibration.image_of(found.boxes)
    fair &= inside & ~_not_cared_for(image, one.frame.objects)
    if level in _LEVELS:
        fair &= ~(image[:, 3] - image[:, 1] < _LEVELS[level][0])
    scene = Scene.of(found.boxes, found.scores, truth)
    return _Compared(scene, due, one.points[known], np.asarray(fair))


def _is_of(label: KittiObject, level: str) -> bool:
    """Whether a label is within a level of difficulty; unknown values make it no harder."""
    if level not in _LEVELS:
        return True
    least_px, most_occluded, most_truncated = _LEVELS[level]
    height_px = label.image[3] - label.image[1]
    too_small = bool(np.isfinite(height_px) and height_px < least_px)
    return not (too_small or label.occluded > most_occluded or label.truncated > most_truncated)


def _not_cared_for(image: Floats, objects: Sequence[KittiObject]) -> Bools:
    """Marks detections (N, 4) of which half or more lies in a region DontCare."""
    result = np.zeros(len(image), np.bool_)
    area = np.prod(image[:, 2:] - image[:, :2], axis=1)
    for label in objects:
        if label.kind == DONT_CARE and np.isfinite(label.image).all():
            low = np.maximum(image[:, :2], label.image[:2])
            high = np.minimum(image[:, 2:], label.image[2:])
            common = np.prod((high - low).clip(0), axis=1)
            result |= common >= _DONT_CARE_SHARE * np.maximum(area, 1e-9)
    return result
