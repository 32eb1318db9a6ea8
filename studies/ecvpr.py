"""E-CVPR: which penetration rate of connected vehicles perception is worth.

Chen et al. 2022: in each frame, the true detections over the vehicles present within 200 m upstream
and 100 m downstream of the stop bar.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import groupby
from operator import attrgetter
from typing import TypeVar

import numpy as np

from protocol.messages import VehicleType
from recorder.run import Run
from recorder.tables import CountRow, DetectionRow, TruthRow
from studies.bounds import Bounds
from studies.matching import MARGIN_M, match
from studies.reach import Reach

R = TypeVar("R", TruthRow, DetectionRow, CountRow)


@dataclass(frozen=True, slots=True)
class FrameScore:
    """One frame: vehicles present, those of them that were detected, detections of nothing.

    `visible` of those present could have been detected, as LiDAR points lay on them or they report
    themselves; `in_range` were near enough to a LiDAR for that, or report themselves.
    """

    frame: int
    present: int
    true: int
    false: int
    visible: int = 0
    in_range: int = 0

    @property
    def e_cvpr(self) -> float | None:
        """The equivalent penetration rate, 0 to 1; None in an empty frame."""
        return self._share(self.true)

    @property
    def visible_share(self) -> float | None:
        """The share that is visible: what no detector can exceed."""
        return self._share(self.visible)

    @property
    def in_range_share(self) -> float | None:
        """The share in range: what no occlusion would leave."""
        return self._share(self.in_range)

    def _share(self, vehicles: int) -> float | None:
        return vehicles / self.present if self.present else None


def score(run: Run, reach: Reach | None = None, margin_m: float = MARGIN_M) -> list[FrameScore]:
    """Returns the score of every frame that has truth and was perceived.

    Raises:
        ConfigError: the run folder lacks its setup.
    """
    reach = reach or Reach(run.setup.road_map)
    types = {kind.name: kind for kind in run.setup.vehicle_types}
    perceived = {n for (n,) in run.query("SELECT frame FROM frames WHERE detections IS NOT NULL")}
    detections, bounds = by_frame(run.rows(DetectionRow)), Bounds(run)
    waiting = next(detections, None)
    scores = []
    for frame, vehicles in by_frame(run.rows(TruthRow)):
        while waiting is not None and waiting[0] < frame:
            waiting = next(detections, None)
        found = waiting[1] if waiting is not None and waiting[0] == frame else []
        if frame in perceived:
            one = score_frame(frame, found, vehicles, types, reach, margin_m)
            present = {v.vehicle for v in vehicles if reach.contains(v.lane, v.lane_position_m)}
            visible = len(present & bounds.visible(frame, vehicles))
            in_range = len(present & bounds.in_range(vehicles))
            scores.append(replace(one, visible=visible, in_range=in_range))
    return scores


def score_frame(
    frame: int,
    detections: list[DetectionRow],
    vehicles: list[TruthRow],
    types: dict[str, VehicleType],
    reach: Reach,
    margin_m: float = MARGIN_M,
) -> FrameScore:
    """Returns the score of one frame. A vehicle outside the reach is neither true nor false.

    A vehicle that reports itself is detected, however far off its satellite positioning is.
    """
    index = {vehicle.vehicle: i for i, vehicle in enumerate(vehicles)}
    selves = {index[d.source] for d in detections if d.source in index}
    others = [i for i in range(len(vehicles)) if i not in selves]
    seen = [d for d in detections if d.source not in index]
    pairs = _pairs(seen, [vehicles[i] for i in others], types, margin_m)
    present = {i for i, v in enumerate(vehicles) if reach.contains(v.lane, v.lane_position_m)}
    true = len(present & (selves | {others[vehicle] for _, vehicle in pairs}))
    return FrameScore(frame, len(present), true, len(seen) - len(pairs))


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
    """Returns which vehicles that do not report themselves were detected, and what was nothing."""
    reporting = {detection.source for detection in detections}
    others = [vehicle for vehicle in vehicles if vehicle.vehicle not in reporting]
    names = {vehicle.vehicle for vehicle in vehicles}
    seen = [detection for detection in detections if detection.source not in names]
    pairs = _pairs(seen, others, types, MARGIN_M)
    true = {detection for detection, _ in pairs}
    false = [detection for i, detection in enumerate(seen) if i not in true]
    return {others[vehicle].vehicle for _, vehicle in pairs}, false


def by_frame(rows: Iterator[R]) -> Iterator[tuple[int, list[R]]]:
    """Groups rows that are in the order of frames."""
    for frame, group in groupby(rows, key=attrgetter("frame")):
        yield frame, list(group)
