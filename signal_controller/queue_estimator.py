"""Queue estimator for lanes before the stop bar that no sensor covers: unknown is not empty."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

from protocol.messages import LaneCounts, SignalState
from protocol.roadmap import Signal
from signal_controller.config import SignalConfig

Weight = Literal["vehicles", "queued"]
Lanes = Mapping[str, float]

LEAST_SEEN = 0.25  # of a lane's reach: less tells too little of the rest
SPACING_M = 7.0  # from one standing vehicle to the next: a lane's reach holds no more


def weighed(counts: LaneCounts, weight: Weight) -> tuple[Lanes, Lanes]:
    """Returns by lane what presses, before the stop bar and behind it."""
    if weight == "queued":
        return counts.queued_upstream, counts.queued_downstream
    return counts.upstream, counts.downstream


def unknown(lanes: Iterable[str], seen: Mapping[str, float]) -> list[str]:
    """Returns the lanes that nobody sees; where nobody can know, that is none."""
    return [lane for lane in lanes if seen.get(lane, 1.0) < LEAST_SEEN]


def completed(counts: Lanes, seen: Mapping[str, float]) -> Lanes:
    """Returns the vehicles to be expected on all of each lane, were it as full as what is seen.

    Of a lane of which less than `LEAST_SEEN` is seen, or of which nobody knows how much, the count
    stands as it is. Behind the stop bar it does so for good: who is there drives off within
    seconds, so that no number from before would help.
    """
    return {
        lane: count / share if (share := seen.get(lane, 1.0)) >= LEAST_SEEN else count
        for lane, count in counts.items()
    }


@dataclass(frozen=True, slots=True)
class QueueEstimate:
    """Vehicles by lane, of the lanes that nobody sees; `is_blind` once no number is worth much."""

    vehicles: dict[str, float]
    is_blind: bool


@dataclass(slots=True)
class _LaneEstimate:
    """What was last believed of a lane, and for how long nobody has seen it."""

    vehicles: float = 0.0
    unseen_ns: int = 0


class QueueEstimator:
    """Keeps for each lane the last known number of vehicles and reckons on from it.

    In simulated time the number grows by the inflow and, while a link of the lane is green, shrinks
    by the saturation flow; it stays between 0, or what was counted all the same (vehicles that
    report themselves), and what the lane's reach holds. A lane that was never seen starts empty.
    It goes on however long a lane is unseen, so that none starves while others are seen; only when
    no lane was seen for `reckon_s`, nothing is worth deciding by.
    """

    def __init__(self, signal: Signal, config: SignalConfig, reach_m: float) -> None:
        self._signal = signal
        self._config = config
        self._inflow_per_s = config.reckon_inflow_vph / 3600
        self._outflow_per_s = config.reckon_saturation_vph / 3600
        self._worth_ns = round(config.reckon_s * 1e9)
        self._most = reach_m / SPACING_M
        self._lanes = {link.from_lane: _LaneEstimate() for link in signal.links}
        self._time_ns: int | None = None

    def take(self, counts: LaneCounts, shown: SignalState | None) -> QueueEstimate:
        """Takes a frame's counts, and the signal's state of then as the clock; once a frame."""
        passed_ns = self._passed_ns(shown)
        before, _ = weighed(counts, self._config.weight)
        hidden = set(unknown(self._lanes, counts.seen_upstream))
        known = completed(before, counts.seen_upstream)
        for name, lane in self._lanes.items():
            count = known.get(name, 0)
            if name in hidden:
                self._reckon(lane, count, passed_ns, is_green=self._is_green(name, shown))
            else:
                lane.vehicles, lane.unseen_ns = count, 0
        vehicles = {name: lane.vehicles for name, lane in self._lanes.items() if name in hidden}
        is_blind = all(lane.unseen_ns >= self._worth_ns for lane in self._lanes.values())
        return QueueEstimate(vehicles, is_blind)

    def _reckon(self, lane: _LaneEstimate, count: float, passed_ns: int, *, is_green: bool) -> None:
        rate_per_s = self._inflow_per_s - (self._outflow_per_s if is_green else 0.0)
        most = max(self._most, lane.vehicles)
        lane.vehicles = max(count, min(most, lane.vehicles + rate_per_s * passed_ns / 1e9))
        lane.unseen_ns += passed_ns

    def _passed_ns(self, shown: SignalState | None) -> int:
        """Returns the time since the last frame; a gap or an absurd time is `reckon_s` at most."""
        if shown is None:
            return 0
        last_ns = shown.sim_time_ns if self._time_ns is None else self._time_ns
        self._time_ns = shown.sim_time_ns
        return min(max(0, shown.sim_time_ns - last_ns), self._worth_ns)

    def _is_green(self, lane: str, shown: SignalState | None) -> bool:
        return shown is not None and any(
            link.from_lane == lane and shown.state[link.index : link.index + 1] in ("G", "g")
            for link in self._signal.links
        )
