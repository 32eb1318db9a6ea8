"""Errors of the edge's lane counts against the truth, and the detection figures of a bench."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator

import numpy as np

from edge_server.config import EdgeConfig
from edge_server.lanes import LaneIndex, LanePositions
from protocol.messages import Setup
from protocol.roadmap import RoadMap
from recording.run import Run
from recording.tables import CountRow, DetectionRow, TruthRow
from studies.ecvpr import (
    DOWNSTREAM_M,
    UPSTREAM_M,
    EvaluationArea,
    matched_vehicles,
    parked_bodies,
)
from studies.frame_rows import FrameRows, truth_by_frame


def count_errors(run: Run) -> dict[str, list[int]]:
    """Returns by signal the vehicles counted too many, negative if too few, by frame and lane.

    Lanes upstream and downstream of the stop bar, within the distances that the edge counts in.

    Raises:
        ConfigError: the run folder lacks its setup.
    """
    errors: dict[str, list[int]] = defaultdict(list)
    for row, present in counts_with_truth(run):
        errors[row.tls].append(row.vehicles - present)
    return dict(errors)


def counts_with_truth(run: Run) -> Iterator[tuple[CountRow, int]]:
    """Yields each count of a frame that has truth, with the true number of vehicles.

    Raises:
        ConfigError: the run folder lacks its setup.
    """
    config = EdgeConfig.model_validate(run.scenario.get("edge", {}))
    counter = TrueCounts(run.setup.road_map, config.upstream_m, config.downstream_m)
    counted = FrameRows(run.rows(CountRow))
    for frame, vehicles in truth_by_frame(run):
        rows = counted.of(frame)
        if rows:
            truth = counter.count(vehicles)
            yield from ((row, truth[row.tls, row.side].get(row.lane, 0)) for row in rows)


class TrueCounts:
    """Lane counts from true positions, within the distances that the edge counts in."""

    def __init__(self, road_map: RoadMap, upstream_m: float, downstream_m: float) -> None:
        self._index = LaneIndex(road_map)
        self._numbers = {lane.id: number for number, lane in enumerate(road_map.lanes)}
        self._measured = {lane.id: lane.measured_share for lane in road_map.lanes}
        self._upstream_m, self._downstream_m = upstream_m, downstream_m

    def count(self, vehicles: list[TruthRow]) -> dict[tuple[str, str], dict[str, int]]:
        """Returns vehicles by signal and side of its stop bars, and by lane."""
        lanes = [self._numbers.get(vehicle.lane, -1) for vehicle in vehicles]
        along_m = [one.lane_position_m * self._measured.get(one.lane, 1.0) for one in vehicles]
        place = LanePositions(np.array(lanes, np.int64), np.array(along_m, np.float64))
        found: dict[tuple[str, str], dict[str, int]] = {}
        for tls in self._index.approaches:
            upstream, downstream = self._index.count(
                place, tls, upstream_m=self._upstream_m, downstream_m=self._downstream_m
            )
            found |= {(tls, "upstream"): upstream, (tls, "downstream"): downstream}
        return found


class PerceptionTally:
    """Detection and count figures over frames; None without any frame."""

    def __init__(self, setup: Setup) -> None:
        self._area = EvaluationArea(setup.road_map)
        self._counter = TrueCounts(setup.road_map, UPSTREAM_M, DOWNSTREAM_M)
        self._types = {kind.name: kind for kind in setup.vehicle_types}
        self._parked = parked_bodies(setup)
        self._seen = self._found = self._false = self._frames = 0
        self._errors: list[int] = []

    def add(
        self,
        visible: set[str],
        detections: list[DetectionRow],
        counts: list[CountRow],
        vehicles: list[TruthRow],
    ) -> None:
        """Adds a frame: the visible vehicles, detections, counts, and the truth.

        Coasting boxes count as counted, not as detected.
        """
        here = {v.vehicle for v in vehicles if self._area.contains(v.lane, v.lane_position_m)}
        observed = [row for row in detections if row.coasted_s == 0]
        matched, wrong = matched_vehicles(observed, vehicles + self._parked, self._types)
        self._seen += len(visible & here)
        self._found += len(visible & here & matched)
        self._false += wrong
        self._frames += 1
        true = self._counter.count(vehicles)
        self._errors += [
            abs(row.vehicles - true[row.tls, row.side].get(row.lane, 0)) for row in counts
        ]

    @property
    def recall_visible(self) -> float | None:
        """The share of the visible vehicles near the signal that were detected."""
        return self._found / self._seen if self._seen else None

    @property
    def false_per_frame(self) -> float | None:
        """False detections per frame."""
        return self._false / self._frames if self._frames else None

    @property
    def count_error(self) -> float | None:
        """Mean absolute error of a lane's count, upstream and downstream of the stop bar."""
        return float(np.mean(self._errors)) if self._errors else None
