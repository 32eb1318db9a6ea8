"""What a signal policy is given: the place once, an observation each frame."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from protocol.messages import Detections, LaneCounts, ObjectClass, SignalState
from protocol.roadmap import RoadMap, Signal

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class CabinetTimes:
    """What the signal's cabinet keeps between greens, whatever is requested."""

    min_green_s: float = 5.0
    yellow_s: float = 4.0
    all_red_s: float = 1.0

    @classmethod
    def of(cls, section: Mapping[str, Any]) -> Self:
        """Reads the scenario's section `cabinet`."""
        return cls(*(section[key] for key in ("min_green_s", "yellow_s", "all_red_s")))


@dataclass(frozen=True, slots=True, eq=False)
class SignalSite:
    """The signal that a policy controls, the roads around it, and the limits of what is known.

    `road_map` holds the signal's intersection. Vehicles count `upstream_m` before the stop bars.
    """

    signal: Signal
    road_map: RoadMap
    upstream_m: float
    cabinet: CabinetTimes = CabinetTimes()


@dataclass(frozen=True, slots=True, eq=False)
class LaneVehicles:
    """Vehicles (N,) on lanes.

    `distances_m` is the way of the front bumper to the stop bar, negative behind it, as in
    `Detections`; `speeds_mps` is NaN and an id an empty string where it is unknown.
    """

    lanes: list[str]
    distances_m: Floats
    speeds_mps: Floats
    lengths_m: Floats
    ids: list[str]

    def take(self, rows: npt.NDArray[np.int64]) -> Self:
        """Returns some of them, by index."""
        return type(self)(
            lanes=[self.lanes[i] for i in rows],
            distances_m=self.distances_m[rows],
            speeds_mps=self.speeds_mps[rows],
            lengths_m=self.lengths_m[rows],
            ids=[self.ids[i] for i in rows],
        )

    @classmethod
    def of(cls, detections: Detections) -> Self:
        """Takes all detections on lanes but people, in the detections' order."""
        keep = [
            index
            for index, (lane, kind) in enumerate(
                zip(detections.lanes, detections.classes.tolist(), strict=True)
            )
            if lane and kind != ObjectClass.PEDESTRIAN
        ]
        lengths_m = detections.boxes[keep, 3].astype(np.float64)
        distances_m = detections.distances_m[keep].astype(np.float64) - lengths_m / 2
        speeds_mps = getattr(detections, "speeds_mps", None)
        ids = getattr(detections, "track_ids", None)
        unknown = np.full(len(keep), math.nan)
        return cls(
            lanes=[detections.lanes[index] for index in keep],
            distances_m=distances_m,
            speeds_mps=unknown if speeds_mps is None else np.asarray(speeds_mps, float)[keep],
            lengths_m=lengths_m,
            ids=[""] * len(keep) if ids is None else [str(ids[index]) for index in keep],
        )


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """What is known of a frame at a signal.

    Attributes:
        counts: vehicles by lane, with the covered share of each lane.
        shown: what the signal shows at the time of the counts; None before its first state.
        vehicles: single vehicles on the lanes of the signal's region; None where there are none
            to be had.
    """

    counts: LaneCounts
    shown: SignalState | None
    vehicles: LaneVehicles | None = None
