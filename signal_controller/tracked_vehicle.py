"""A vehicle before the stop bars as the predictive policy follows it from frame to frame."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from signal_controller.predictive_model import Floats

STOPPED_MPS = 1.0
_OVERTAKEN_M = 8.0  # one from so far behind has driven past; less may be a box that wandered


@dataclass(slots=True)
class TrackedVehicle:
    """A vehicle as last seen; `passed` is the lane whose stop bar it has crossed.

    `wish` are the probabilities of the movements that it wants, the last that of none, once it was
    the first. It is on its lane since `since_s`, from `from_m` on, and has stood since
    `stands_since_s`; others have driven past it there if it `is_no_queue`. `parked_at` is the lane
    and the distance to the stop bar at which it is parked, None if it is not.
    """

    lane: str
    incoming: int
    distance_m: float
    time_s: float
    speed_mps: float = math.nan
    visited: set[str] = field(default_factory=set)
    has_stopped: bool = False
    passed: int = -1
    wish: Floats | None = None
    since_s: float = math.nan
    from_m: float = math.nan
    stands_since_s: float = math.inf
    is_no_queue: bool = False
    parked_at: tuple[str, float] | None = None

    @property
    def is_parked(self) -> bool:
        """Whether it stands in a parked place: it is no queue that a green would discharge."""
        return self.parked_at is not None

    def move(self, lane: str, distance_m: float, time_s: float, speed_mps: float) -> None:
        """Updates its position."""
        stands = speed_mps < STOPPED_MPS
        if lane != self.lane:
            self.wish = None
        if lane != self.lane or math.isnan(self.since_s):
            self.since_s, self.from_m = time_s, distance_m
        self.stands_since_s = min(self.stands_since_s, time_s) if stands else math.inf
        self.is_no_queue &= stands and lane == self.lane
        self.lane, self.distance_m, self.time_s = lane, distance_m, time_s
        self.speed_mps = speed_mps

    def has_overtaken(self, other: TrackedVehicle) -> bool:
        """Whether it came from behind another that stood on its lane all the time."""
        is_behind = self.from_m > other.distance_m + _OVERTAKEN_M
        stood_there = max(other.stands_since_s, other.since_s) <= self.since_s
        return other.lane == self.lane and is_behind and stood_there
