"""Input of a signal policy: the signal and its roads once, an observation each frame."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from protocol.messages import Detections, LaneCounts, ObjectClass, SignalState
from protocol.roadmap import RoadMap, Signal

Floats = npt.NDArray[np.float64]
_LIDAR = "lidar"  # the source of a detection that is no agent's own, see `Detections`


@dataclass(frozen=True, slots=True)
class CabinetTimes:
    """Times that the signal's cabinet enforces, whatever is requested."""

    min_green_s: float = 5.0
    yellow_s: float = 4.0
    all_red_s: float = 1.0
    stale_after_s: float = 3.0

    @classmethod
    def of(cls, section: Mapping[str, Any]) -> Self:
        """Reads the scenario's section `cabinet`."""
        return cls(**{one.name: section[one.name] for one in fields(cls)})


@dataclass(frozen=True, slots=True, eq=False)
class SignalSite:
    """The signal that a policy controls, the roads around it, and its cabinet's times.

    `road_map` holds the signal's intersection. Vehicles count `upstream_m` before the stop bars.
    """

    signal: Signal
    road_map: RoadMap
    upstream_m: float
    cabinet: CabinetTimes = CabinetTimes()

    @property
    def lanes(self) -> list[str]:
        """Ids of the lanes before the stop bars, in link order."""
        return self.road_map.by_tls[self.signal.tls].incoming


@dataclass(frozen=True, slots=True, eq=False)
class LaneVehicles:
    """Vehicles (N,) on lanes.

    `distances_m` is the distance of the front bumper to the stop bar, negative behind it, as in
    `Detections`; `speeds_mps` is NaN where it is unknown. Ids are empty strings without tracking;
    then `VehicleAssociation` uses `places_m` (N, 2), x and y in the map frame. `agents` names those
    that have reported themselves in this frame, with empty strings for others.
    """

    lanes: list[str]
    distances_m: Floats
    speeds_mps: Floats
    lengths_m: Floats
    ids: list[str]
    places_m: Floats | None = None
    agents: list[str] | None = None

    def take(self, rows: npt.NDArray[np.int64]) -> Self:
        """Returns some of them, by index."""
        return type(self)(
            lanes=[self.lanes[i] for i in rows],
            distances_m=self.distances_m[rows],
            speeds_mps=self.speeds_mps[rows],
            lengths_m=self.lengths_m[rows],
            ids=[self.ids[i] for i in rows],
            places_m=None if self.places_m is None else self.places_m[rows],
            agents=None if self.agents is None else [self.agents[i] for i in rows],
        )

    @classmethod
    def of(cls, detections: Detections) -> Self:
        """Selects all detections on lanes but people, in the detections' order."""
        keep = [
            index
            for index, (lane, kind) in enumerate(
                zip(detections.lanes, detections.classes.tolist(), strict=True)
            )
            if lane and kind != ObjectClass.PEDESTRIAN
        ]
        boxes = detections.boxes[keep].astype(np.float64)
        tracks, reported = detections.track_ids[keep], detections.coasted_s[keep] == 0
        sources = [detections.sources[index] for index in keep]
        return cls(
            lanes=[detections.lanes[index] for index in keep],
            distances_m=detections.distances_m[keep].astype(np.float64) - boxes[:, 3] / 2,
            speeds_mps=np.where(tracks == 0, math.nan, detections.speeds_mps[keep]),
            lengths_m=boxes[:, 3],
            ids=[str(track) if track else "" for track in tracks.tolist()],
            places_m=boxes[:, :2],
            agents=[
                source if source != _LIDAR and is_new else ""
                for source, is_new in zip(sources, reported.tolist(), strict=True)
            ],
        )


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """Observation of one frame at a signal.

    Attributes:
        counts: vehicles by lane, with the covered share of each lane.
        shown: what the signal shows at the time of the counts; None before its first state.
        vehicles: single vehicles on the lanes of the signal's region; None if not available.
    """

    counts: LaneCounts
    shown: SignalState | None
    vehicles: LaneVehicles | None = None


_GATE_M, _GATE_MPS = 3.0, 4.0  # how far off its prediction a vehicle may be, and per second
_NEW_GATE_MPS = 16.0  # the same of one whose speed is not known yet
_SMOOTHING_S = 0.5  # over which speeds are averaged
_MAX_GAP_S = 2.0


class VehicleAssociation:
    """Associates vehicles from frame to frame by position alone, where nothing tracks.

    The nearest pair of a prediction and a vehicle is the same vehicle, then the next nearest.
    """

    def __init__(self) -> None:
        self._time_s = -math.inf
        self._places_m = np.zeros((0, 2))
        self._velocities_mps = np.zeros((0, 2))
        self._is_new = np.zeros(0, np.bool_)
        self._ids: list[str] = []
        self._count = 0

    def take(self, time_s: float, vehicles: LaneVehicles) -> LaneVehicles:
        """Returns the vehicles with ids and speeds; those that have ids as they are."""
        places_m = vehicles.places_m
        if places_m is None or any(vehicles.ids):
            return vehicles
        passed_s = time_s - self._time_s
        old = self._matches(places_m, passed_s) if 0 < passed_s <= _MAX_GAP_S else {}
        velocities_mps, is_new = np.zeros_like(places_m), np.ones(len(places_m), np.bool_)
        ids = []
        for row in range(len(places_m)):
            before = old.get(row)
            if before is None:
                self._count += 1
                ids.append(f"~{self._count}")
                continue
            ids.append(self._ids[before])
            is_new[row] = False
            velocity_mps = (places_m[row] - self._places_m[before]) / passed_s
            weight = 1.0 if self._is_new[before] else min(1.0, passed_s / _SMOOTHING_S)
            known_mps = self._velocities_mps[before]
            velocities_mps[row] = known_mps + weight * (velocity_mps - known_mps)
        self._time_s, self._places_m, self._ids = time_s, places_m, ids
        self._velocities_mps, self._is_new = velocities_mps, is_new
        speeds_mps = np.where(is_new, math.nan, np.linalg.norm(velocities_mps, axis=1))
        return replace(vehicles, ids=ids, speeds_mps=speeds_mps)

    def _matches(self, places_m: Floats, passed_s: float) -> dict[int, int]:
        """Returns the earlier row by the present row."""
        expected_m = self._places_m + self._velocities_mps * passed_s
        away_m = np.linalg.norm(places_m[:, None] - expected_m[None], axis=2)
        gates_m = _GATE_M + np.where(self._is_new, _NEW_GATE_MPS, _GATE_MPS) * passed_s
        rows, before = np.nonzero(away_m <= gates_m[None])
        found: dict[int, int] = {}
        taken: set[int] = set()
        for index in np.argsort(away_m[rows, before], kind="stable"):
            row, old = int(rows[index]), int(before[index])
            if row not in found and old not in taken:
                found[row] = old
                taken.add(old)
        return found
