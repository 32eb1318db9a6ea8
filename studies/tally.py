"""How well a stretch of traffic was seen: visible vehicles found, false ones, errors of counts."""

from __future__ import annotations

import numpy as np

from protocol.messages import Setup
from recorder.tables import CountRow, DetectionRow, TruthRow
from studies.count_error import TrueCounts
from studies.ecvpr import matched_vehicles
from studies.reach import DOWNSTREAM_M, UPSTREAM_M, Reach


class Tally:
    """Takes frame after frame; a figure without any frame is None."""

    def __init__(self, setup: Setup) -> None:
        self._reach = Reach(setup.road_map)
        self._counter = TrueCounts(setup.road_map, UPSTREAM_M, DOWNSTREAM_M)
        self._types = {kind.name: kind for kind in setup.vehicle_types}
        self._seen = self._found = self._false = self._frames = 0
        self._errors: list[int] = []

    def add(
        self,
        visible: set[str],
        detections: list[DetectionRow],
        counts: list[CountRow],
        vehicles: list[TruthRow],
    ) -> None:
        """Takes a frame: what there was to see, what was found and counted, and the truth."""
        here = {v.vehicle for v in vehicles if self._reach.contains(v.lane, v.lane_position_m)}
        matched, wrong = matched_vehicles(detections, vehicles, self._types)
        self._seen += len(visible & here)
        self._found += len(visible & here & matched)
        self._false += wrong
        self._frames += 1
        true = self._counter.count(vehicles)
        self._errors += [abs(row.vehicles - true[row.side].get(row.lane, 0)) for row in counts]

    @property
    def recall_visible(self) -> float | None:
        """The share of the visible vehicles within the signal's reach that were found."""
        return self._found / self._seen if self._seen else None

    @property
    def false_per_frame(self) -> float | None:
        """Detections of nothing."""
        return self._false / self._frames if self._frames else None

    @property
    def count_error(self) -> float | None:
        """The mean absolute error of a lane's count, before and behind the stop bar, vehicles."""
        return float(np.mean(self._errors)) if self._errors else None
