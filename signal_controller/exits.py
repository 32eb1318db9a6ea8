"""Exits of a junction: which can take one more vehicle, by who stands behind the junction."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping

import numpy as np

from protocol.approaches import bar_starts_m
from signal_controller.observation import LaneVehicles
from signal_controller.predictive_model import Bools, JunctionModel
from signal_controller.tracked_vehicle import STOPPED_MPS, TrackedVehicle

_ROOM_M = 8.0  # that an exit needs for one more vehicle
_ENTRY_M = 20.0  # of an exit: who is first seen so near its start comes from the junction


class Exits:
    """Exit lanes of a signal's movements.

    Attributes:
        starts_m: distance of each lane's start to the stop bar, as vehicles have it.
    """

    def __init__(self, model: JunctionModel) -> None:
        self._model = model
        exits = {lane for one in model.movements for lane in one.exit_lanes}
        starts_m = bar_starts_m(model.approaches.with_neighbours())
        self.starts_m = {lane: starts_m[lane] for lane in exits & starts_m.keys()}

    def room(self, vehicles: LaneVehicles, tracks: Mapping[str, TrackedVehicle]) -> Bools:
        """Returns whether the exit of each movement (M,) can take a vehicle.

        `tracks` are by id, as of the frame before.
        """
        tails_m: dict[str, float] = {}
        rows = zip(
            vehicles.ids,
            vehicles.lanes,
            vehicles.distances_m.tolist(),
            vehicles.lengths_m.tolist(),
            vehicles.speeds_mps.tolist(),
            strict=True,
        )
        for name, lane, distance_m, length_m, speed_mps in rows:
            track = tracks.get(name)
            is_queue = track is None or track.lane != lane or not track.is_no_queue
            if lane in self.starts_m and speed_mps < STOPPED_MPS and is_queue:
                tail_m = self.starts_m[lane] - distance_m - length_m
                tails_m[lane] = min(tail_m, tails_m.get(lane, math.inf))
        tails = (
            max(tails_m.get(lane, math.inf) for lane in movement.exit_lanes)
            for movement in self._model.movements
        )
        return np.array([tail_m >= _ROOM_M for tail_m in tails], np.bool_)

    def note_driven_past(self, time_s: float, tracks: Collection[TrackedVehicle]) -> None:
        """Notes who stands on an exit while one that came later is farther down: it is no queue."""
        present = [t for t in tracks if t.time_s == time_s and t.lane in self.starts_m]
        last: dict[str, TrackedVehicle] = {}  # of those that stand, by lane
        for one in present:
            if one.speed_mps < STOPPED_MPS and not one.is_no_queue:
                before = last.get(one.lane)
                if before is None or one.distance_m > before.distance_m:
                    last[one.lane] = one
        for one in present:
            other = last.get(one.lane)
            drives = one.speed_mps >= STOPPED_MPS  # in a queue one that stands may get another id
            is_through = drives and self.starts_m[one.lane] - one.from_m <= _ENTRY_M
            if other is not None and is_through and one.since_s > other.stands_since_s:
                other.is_no_queue |= one.distance_m < other.distance_m - _ROOM_M
