"""Queue estimator for lanes before the stop bar that no sensor covers: unknown is not empty."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

from protocol.messages import LaneCounts, SignalState
from protocol.roadmap import Signal
from signal_controller.config import SignalConfig

Weight = Literal["vehicles", "pcu", "queued"]
Lanes = Mapping[str, float]

MIN_COVERAGE = 0.25  # of a lane's counted part: less is not representative
SPACING_M = 7.0  # from one stationary vehicle to the next: a lane holds no more


def weighted_counts(counts: LaneCounts, weight: Weight) -> tuple[Lanes, Lanes]:
    """Returns the weight of each lane, before the stop bar and behind it."""
    if weight == "queued":
        return counts.stationary_upstream, counts.stationary_downstream
    if weight == "pcu":
        return counts.pcu_upstream, counts.pcu_downstream
    return counts.upstream, counts.downstream


def uncovered_lanes(lanes: Iterable[str], seen: Mapping[str, float]) -> list[str]:
    """Returns the lanes that no sensor covers; none where coverage is unknown."""
    return [lane for lane in lanes if seen.get(lane, 1.0) < MIN_COVERAGE]


def extrapolated(counts: Lanes, seen: Mapping[str, float]) -> Lanes:
    """Returns the vehicles expected on all of each lane, by the density of its covered part.

    The count stays as it is where coverage is less than `MIN_COVERAGE` or unknown. Behind the stop
    bar that is final: vehicles there drive off within seconds, so that no earlier number helps.
    """
    return {
        lane: count / share if (share := seen.get(lane, 1.0)) >= MIN_COVERAGE else count
        for lane, count in counts.items()
    }


@dataclass(frozen=True, slots=True)
class QueueEstimate:
    """Vehicles on the lanes that no sensor covers; `is_blind` once no estimate is reliable."""

    vehicles: dict[str, float]
    is_blind: bool


@dataclass(slots=True)
class _LaneEstimate:
    """Last estimate of a lane, and for how long no sensor has covered it."""

    vehicles: float = 0.0
    unseen_ns: int = 0


class QueueEstimator:
    """Extrapolates in time from the last known number of vehicles on each lane.

    In simulated time the number grows by the inflow and, while a link of the lane is green, shrinks
    by the saturation flow. It stays between 0, or the count of vehicles that report themselves, and
    what the counted part of the lane holds. A lane that was never covered starts empty. It goes on
    however long a lane is uncovered, so that none starves while others are covered; only when no
    lane was covered for `estimator_timeout_s` is it invalid.
    """

    def __init__(self, signal: Signal, config: SignalConfig, upstream_m: float) -> None:
        self._signal = signal
        self._config = config
        self._inflow_per_s = config.estimator_inflow_vph / 3600
        self._outflow_per_s = config.estimator_saturation_vph / 3600
        self._max_unseen_ns = round(config.estimator_timeout_s * 1e9)
        self._max_vehicles = upstream_m / SPACING_M
        self._lanes = {link.from_lane: _LaneEstimate() for link in signal.links}
        self._time_ns: int | None = None

    def take(self, counts: LaneCounts, shown: SignalState | None) -> QueueEstimate:
        """Updates by a frame's counts, with the signal state of that time as the clock."""
        passed_ns = self._passed_ns(shown)
        before, _ = weighted_counts(counts, self._config.weight)
        uncovered = set(uncovered_lanes(self._lanes, counts.coverage_upstream))
        known = extrapolated(before, counts.coverage_upstream)
        for name, lane in self._lanes.items():
            count = known.get(name, 0)
            if name in uncovered:
                self._extend(lane, count, passed_ns, is_green=self._is_green(name, shown))
            else:
                lane.vehicles, lane.unseen_ns = count, 0
        vehicles = {name: lane.vehicles for name, lane in self._lanes.items() if name in uncovered}
        is_blind = all(lane.unseen_ns >= self._max_unseen_ns for lane in self._lanes.values())
        return QueueEstimate(vehicles, is_blind)

    def _extend(self, lane: _LaneEstimate, count: float, passed_ns: int, *, is_green: bool) -> None:
        rate_per_s = self._inflow_per_s - (self._outflow_per_s if is_green else 0.0)
        most = max(self._max_vehicles, lane.vehicles)
        lane.vehicles = max(count, min(most, lane.vehicles + rate_per_s * passed_ns / 1e9))
        lane.unseen_ns += passed_ns

    def _passed_ns(self, shown: SignalState | None) -> int:
        """Returns the time since the last frame, at most `estimator_timeout_s`."""
        if shown is None:
            return 0
        last_ns = shown.sim_time_ns if self._time_ns is None else self._time_ns
        self._time_ns = shown.sim_time_ns
        return min(max(0, shown.sim_time_ns - last_ns), self._max_unseen_ns)

    def _is_green(self, lane: str, shown: SignalState | None) -> bool:
        return shown is not None and any(
            link.from_lane == lane and shown.state[link.index : link.index + 1] in ("G", "g")
            for link in self._signal.links
        )
