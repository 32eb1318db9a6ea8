"""E-CVPR, the equivalent penetration rate of connected vehicles: matching, bounds, scores.

Chen et al. 2022: in each frame, the true detections over the vehicles present within 200 m upstream
and 100 m downstream of the stop bar. From top to bottom: where vehicles count, how detections are
matched with vehicles, the upper bounds of perception, the score of a frame and of a run.
"""

from __future__ import annotations

import heapq
import json
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from perception.arrays import Floats
from protocol.messages import PARKED, Equipment, ObjectClass, Setup, VehicleType, is_bystander
from protocol.roadmap import RoadMap
from recording.rows import parked_rows
from recording.run import Run
from recording.tables import DetectionRow, SightingRow, TruthRow
from sensing.config import Mount
from sensing.pose import mount_place
from studies.frame_rows import FrameRows, perceived_by_frame

UPSTREAM_M = 200.0
DOWNSTREAM_M = 100.0


def lane_owners(road_map: RoadMap) -> dict[str, str]:
    """Returns the signal of each lane; where the map has one signal, all lanes are its own."""
    signals = [one.tls for one in road_map.intersections]
    only = signals[0] if len(signals) == 1 else ""
    return {lane.id: lane.tls or only for lane in road_map.lanes}


class EvaluationArea:
    """The lanes before and behind the stop bars on which vehicles count.

    As in Chen et al. 2022: 200 m upstream, 100 m downstream, measured along the lanes. The
    junction's own lanes are downstream.
    """

    def __init__(
        self,
        road_map: RoadMap,
        upstream_m: float = UPSTREAM_M,
        downstream_m: float = DOWNSTREAM_M,
    ) -> None:
        lengths = {lane.id: lane.length_m for lane in road_map.lanes}
        successors = {lane.id: lane.successors for lane in road_map.lanes}
        incoming = [lane for lane in road_map.incoming if lane in lengths]
        after = [after for lane in incoming for after in successors[lane] if after in lengths]
        behind = [lane for one in road_map.intersections for lane in one.outgoing]
        starts = after or [lane for lane in behind if lane in lengths]
        # by lane: metres from its end to the stop bar, and from the stop bar to its beginning
        self._before = _distances(incoming, road_map.predecessors, lengths, upstream_m)
        self._after = _distances(starts, successors, lengths, downstream_m)
        self._lengths = lengths
        self._owners = lane_owners(road_map)
        self._upstream_m, self._downstream_m = upstream_m, downstream_m

    def present_at(self, vehicles: Iterable[TruthRow]) -> Counter[str]:
        """Returns how many of the vehicles within the area are on each signal's lanes."""
        return Counter(
            self._owners[v.lane] for v in vehicles if self.contains(v.lane, v.lane_position_m)
        )

    def contains(self, lane: str, position_m: float) -> bool:
        """Whether a vehicle at this distance from its lane's beginning is within the area."""
        if lane in self._before:
            remaining_m = self._lengths[lane] - position_m + self._before[lane]
            if remaining_m <= self._upstream_m:
                return True
        return lane in self._after and self._after[lane] + position_m <= self._downstream_m


def _distances(
    starts: Iterable[str],
    successors: Mapping[str, Iterable[str]],
    lengths: Mapping[str, float],
    limit_m: float,
) -> dict[str, float]:
    """Returns the shortest distance from the starts to each lane within the limit (Dijkstra)."""
    reached: dict[str, float] = {}
    queue = [(0.0, lane) for lane in sorted(starts)]
    while queue:
        distance_m, lane = heapq.heappop(queue)
        if lane in reached or distance_m > limit_m:
            continue
        reached[lane] = distance_m
        for after in successors.get(lane, ()):
            if after in lengths:
                heapq.heappush(queue, (distance_m + lengths[lane], after))
    return reached


MARGIN_M = 0.5


def match(
    centres_m: Floats, vehicles: Floats, sizes_m: Floats, margin_m: float = MARGIN_M
) -> list[tuple[int, int]]:
    """Returns pairs (detection, vehicle): a detection's centre lies in the vehicle's footprint.

    The nearest pairs are taken first, each detection and vehicle once. Ties are broken by position,
    never by order, so that a permutation of the input gives the same pairs.

    Args:
        centres_m: (N, 2) x, y of the detections.
        vehicles: (M, 3) x, y of the footprints' centres and yaw in rad.
        sizes_m: (M, 2) length and width.
        margin_m: the footprint grows by this on every side.
    """
    offset = centres_m[:, None, :] - vehicles[None, :, :2]
    cos, sin = np.cos(vehicles[:, 2]), np.sin(vehicles[:, 2])
    along = np.abs(offset[..., 0] * cos + offset[..., 1] * sin)
    across = np.abs(offset[..., 1] * cos - offset[..., 0] * sin)
    reach_m = sizes_m / 2 + margin_m
    detection, vehicle = np.nonzero((along <= reach_m[:, 0]) & (across <= reach_m[:, 1]))
    distance = np.hypot(along, across)[detection, vehicle]
    ties = (*vehicles[vehicle].T, *centres_m[detection].T)
    return _nearest_first(detection, vehicle, np.lexsort((*ties, distance)))


def _nearest_first(
    detection: npt.NDArray[np.int64], vehicle: npt.NDArray[np.int64], order: npt.NDArray[np.int64]
) -> list[tuple[int, int]]:
    seen_detections: set[int] = set()
    seen_vehicles: set[int] = set()
    pairs = []
    for d, v in zip(detection[order].tolist(), vehicle[order].tolist(), strict=True):
        if d not in seen_detections and v not in seen_vehicles:
            seen_detections.add(d)
            seen_vehicles.add(v)
            pairs.append((d, v))
    return pairs


VISIBLE_POINTS = 5  # ours: in the scans of all agents together


class PerceptionBounds:
    """Upper bounds of perception: detectable vehicles, frame by frame in rising order.

    A vehicle that reports itself is visible and in range: the edge knows of it without a LiDAR.
    """

    def __init__(self, run: Run) -> None:
        self._sightings = FrameRows(run.rows(SightingRow))
        scenario = run.scenario
        mounts = [Mount.model_validate(one) for one in scenario.get("roadside_mounts", [])]
        places = [mount_place(mount, run.setup.road_map) for mount in mounts]
        self._roadside = np.array(places).reshape(-1, 2)
        self._roadside_range_m = _range_m(scenario, "roadside")
        self._cav_range_m = _range_m(scenario, "vehicle")

    def visible(self, frame: int, vehicles: list[TruthRow]) -> set[str]:
        """Returns the vehicles with `VISIBLE_POINTS` or more on them; frames must not decrease."""
        points: Counter[str] = Counter()
        for row in self._sightings.of(frame):
            points.update(json.loads(row.points))
        seen = {vehicle for vehicle, n in points.items() if n >= VISIBLE_POINTS}
        return seen | _reporting(vehicles)

    def in_range(self, vehicles: list[TruthRow]) -> set[str]:
        """Returns the vehicles whose centre is within the range of a LiDAR."""
        at = np.array([(v.x_m, v.y_m) for v in vehicles]).reshape(-1, 2)
        cavs = at[[v.equipment == Equipment.CAV for v in vehicles]]
        near = _within(at, self._roadside, self._roadside_range_m) | _within(
            at, cavs, self._cav_range_m
        )
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


@dataclass(frozen=True, slots=True)
class FrameScore:
    """One frame: vehicles present, those of them that were detected, false detections.

    `visible` of those present could have been detected, as LiDAR points lay on them or they report
    themselves; `in_range` were within the range of a LiDAR, or report themselves. `present_at` and
    `true_at` are the parts on each signal's lanes.
    """

    frame: int
    present: int
    true: int
    false: int
    visible: int = 0
    in_range: int = 0
    present_at: Mapping[str, int] = field(default_factory=dict, compare=False)
    true_at: Mapping[str, int] = field(default_factory=dict, compare=False)

    @property
    def e_cvpr(self) -> float | None:
        """The equivalent penetration rate, 0 to 1; None in an empty frame."""
        return self._share(self.true)

    @property
    def visible_share(self) -> float | None:
        """The visible share: a bound that detection alone hardly exceeds; coasting tracks may."""
        return self._share(self.visible)

    @property
    def in_range_share(self) -> float | None:
        """The share in range: the bound without occlusion."""
        return self._share(self.in_range)

    def _share(self, vehicles: int) -> float | None:
        return vehicles / self.present if self.present else None


def score(
    run: Run, area: EvaluationArea | None = None, margin_m: float = MARGIN_M
) -> list[FrameScore]:
    """Returns the score of every frame that has truth and was perceived.

    Raises:
        ConfigError: the run folder lacks its setup.
    """
    area = area or EvaluationArea(run.setup.road_map)
    types = {kind.name: kind for kind in run.setup.vehicle_types}
    parked = parked_bodies(run.setup)
    bounds, scores = PerceptionBounds(run), []
    for frame, found, vehicles in perceived_by_frame(run):
        one = score_frame(frame, found, vehicles + parked, types, area, margin_m)
        present = {v.vehicle for v in vehicles if area.contains(v.lane, v.lane_position_m)}
        visible = len(present & bounds.visible(frame, vehicles))
        in_range = len(present & bounds.in_range(vehicles))
        scores.append(replace(one, visible=visible, in_range=in_range))
    return scores


def parked_bodies(setup: Setup) -> list[TruthRow]:
    """Returns a setup's parked cars as if they were in the truth of a frame.

    Detections of them are neither false nor vehicles in traffic.
    """
    return [
        TruthRow(-1, car.vehicle, car.type, Equipment.NONE, *car[2:], 0.0, "", 0.0)
        for car in parked_rows(setup)
    ]


def vehicles_of(detections: list[DetectionRow]) -> list[DetectionRow]:
    """Returns the detections that are vehicles: people count neither as true nor as false."""
    return [one for one in detections if one.object_class != ObjectClass.PEDESTRIAN]


def score_frame(
    frame: int,
    detections: list[DetectionRow],
    vehicles: list[TruthRow],
    types: dict[str, VehicleType],
    area: EvaluationArea,
    margin_m: float = MARGIN_M,
) -> FrameScore:
    """Returns the score of one frame.

    A vehicle outside the area is neither true nor false, nor is a parked car, which only those
    detections can match that match no vehicle. One of a vehicle where a pedestrian is, is false.
    A vehicle that reports itself counts as detected, whatever its positioning error.
    """
    found, false = _found_and_false(detections, vehicles, types, margin_m)
    present = [one for one in vehicles if not is_bystander(one.vehicle)]
    reporting = {detection.source for detection in detections}
    present_at = area.present_at(present)
    true_at = area.present_at(v for v in present if v.vehicle in found | reporting)
    return FrameScore(
        frame,
        present_at.total(),
        true_at.total(),
        len(false),
        present_at=present_at,
        true_at=true_at,
    )


def _pairs(
    detections: list[DetectionRow],
    vehicles: list[TruthRow],
    types: dict[str, VehicleType],
    margin_m: float,
) -> list[tuple[int, int]]:
    centres = np.array([(d.x_m, d.y_m) for d in detections], np.float64).reshape(-1, 2)
    poses = np.array([(v.x_m, v.y_m, v.yaw_rad) for v in vehicles], np.float64).reshape(-1, 3)
    sizes = np.array([_size(types, v.type) for v in vehicles], np.float64).reshape(-1, 2)
    return match(centres, poses, sizes, margin_m)


def _size(types: dict[str, VehicleType], name: str) -> tuple[float, float]:
    kind = types.get(name)
    return (kind.length_m, kind.width_m) if kind else (0.0, 0.0)


def matched_vehicles(
    detections: list[DetectionRow], vehicles: list[TruthRow], types: dict[str, VehicleType]
) -> tuple[set[str], int]:
    """Returns which vehicles that do not report themselves were detected, and false detections."""
    matched, false = matches(detections, vehicles, types)
    return matched, len(false)


def matches(
    detections: list[DetectionRow], vehicles: list[TruthRow], types: dict[str, VehicleType]
) -> tuple[set[str], list[DetectionRow]]:
    """Returns which vehicles that do not report themselves were detected, and false detections."""
    return _found_and_false(detections, vehicles, types, MARGIN_M)


def _found_and_false(
    detections: list[DetectionRow],
    vehicles: list[TruthRow],
    types: dict[str, VehicleType],
    margin_m: float,
) -> tuple[set[str], list[DetectionRow]]:
    """Matches vehicles in traffic first; the rest may be a parked car, never a pedestrian."""
    reporting = {detection.source for detection in detections}
    others = [vehicle for vehicle in vehicles if vehicle.vehicle not in reporting]
    names = {vehicle.vehicle for vehicle in vehicles}
    left = [detection for detection in vehicles_of(detections) if detection.source not in names]
    traffic = [one for one in others if not is_bystander(one.vehicle)]
    parked = [one for one in others if one.vehicle.startswith(PARKED)]
    pairs, left = _matched(left, traffic, types, margin_m)
    _, left = _matched(left, parked, types, margin_m)
    return {traffic[vehicle].vehicle for _, vehicle in pairs}, left


def _matched(
    detections: list[DetectionRow],
    vehicles: list[TruthRow],
    types: dict[str, VehicleType],
    margin_m: float,
) -> tuple[list[tuple[int, int]], list[DetectionRow]]:
    """Returns pairs as `match` does, and the detections without a vehicle."""
    pairs = _pairs(detections, vehicles, types, margin_m)
    true = {detection for detection, _ in pairs}
    return pairs, [detection for i, detection in enumerate(detections) if i not in true]
