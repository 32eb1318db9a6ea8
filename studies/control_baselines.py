"""Baselines of `cpnet bench control`: Webster's fixed plan, and kinds of max pressure.

Each is a `SignalPolicy`, made as a plug-in is.
"""

from __future__ import annotations

from collections.abc import Mapping

from protocol.approaches import Approaches
from protocol.roadmap import PlanPhase, Signal
from signal_controller.observation import CabinetTimes, LaneVehicles, Observation, SignalSite
from signal_controller.policies import (
    Decision,
    FixedPlan,
    max_pressure,
    phase_of_highest,
    pressure,
)

MIN_CYCLE_S, MAX_CYCLE_S = 30.0, 120.0
_LOST_S = 1.0  # of a change beyond all-red: what start-up loses over what yellow still lets pass
SATURATION_VPH = 1900.0  # of a lane of SUMO's passenger cars
_MAX_LOAD = 0.95
_WALKING_MPS = 1.0


def webster_signal(
    signal: Signal, flows_vph: Mapping[str, float], saturation_vph: float, times: CabinetTimes
) -> Signal:
    """Returns the signal with the cycle and the splits of Webster (1958).

    A lane's flow counts in equal parts for the phases in which all of its turns have right of way,
    else for those in which all may go, else for those in which any may; a phase's critical lane is
    the one with the highest flow.

    Args:
        signal: with the phases in the order of its own plan.
        flows_vph: by lane before the stop bar.
        saturation_vph: of a lane.
        times: of the cabinet, between the greens.
    """
    greens = signal.greens
    ratios = [0.0] * len(greens)
    for lane, flow_vph in flows_vph.items():
        links = [link.index for link in signal.links if link.from_lane == lane]
        serving = _serving(greens, links)
        for phase in serving:
            ratios[phase] = max(ratios[phase], flow_vph / saturation_vph / len(serving))
    lost_s = len(greens) * (times.yellow_s + times.all_red_s + _LOST_S - 2.0)
    load = min(_MAX_LOAD, sum(ratios))
    cycle_s = min(MAX_CYCLE_S, max(MIN_CYCLE_S, (1.5 * lost_s + 5) / (1 - load)))
    change_s = times.yellow_s + times.all_red_s
    for_green_s = cycle_s - len(greens) * change_s
    total = sum(ratios) or 1.0
    plan = []
    for green, after, ratio in zip(greens, greens[1:] + greens[:1], ratios, strict=True):
        green_s = max(times.min_green_s, for_green_s * ratio / total)
        losing = "".join(
            "y" if a in "Gg" and b not in "Gg" else a for a, b in zip(green, after, strict=True)
        )
        plan.append(PlanPhase(duration_s=round(green_s), state=green))
        if (
            "y" in losing
        ):  # yellow and all-red in one: what stays green in it is no green to ask for
            plan.append(PlanPhase(duration_s=change_s, state=losing))
    return signal.model_copy(update={"plan": plan})


def _serving(greens: list[str], links: list[int]) -> list[int]:
    for served in (
        [all(green[i] == "G" for i in links) for green in greens],
        [all(green[i] in "Gg" for i in links) for green in greens],
        [any(green[i] in "Gg" for i in links) for green in greens],
    ):
        if any(served):
            return [phase for phase, is_served in enumerate(served) if is_served]
    return []


def webster(site: SignalSite, flows_vph: Mapping[str, float]) -> FixedPlan:
    """Returns the policy that follows Webster's plan."""
    return FixedPlan(webster_signal(site.signal, flows_vph, SATURATION_VPH, site.cabinet))


class WeightedPressure:
    """Max pressure whose vehicles weigh by where they are or by how long they have waited.

    `position`: a vehicle weighs 1 at the stop bar and 0 at the far end of what is known before it,
    and 1 right behind it and 0 at the far end there (position-weighted back-pressure, Li and Jabari
    2019). `delay`: a vehicle before the stop bar weighs the seconds that it has stood still
    (delay-based back-pressure, Wu, Ghosal, Zhang and Chuah 2018), one behind it nothing.
    """

    needs_vehicles = True

    def __init__(self, site: SignalSite, kind: str, downstream_m: float) -> None:
        self._signal = site.signal
        self._around = Approaches(site.road_map, site.road_map.by_tls[site.signal.tls])
        self._kind = kind
        self._reach_m = site.upstream_m, downstream_m
        self._stood_s: dict[str, float] = {}
        self._time_s: float | None = None

    def decide(self, observation: Observation) -> Decision:
        """See `SignalPolicy.decide`."""
        counts, vehicles = observation.counts, observation.vehicles
        if vehicles is None:
            return max_pressure(self._signal, counts, observation.shown)
        before = dict.fromkeys(self._around.intersection.incoming, 0.0)
        behind = dict.fromkeys(self._around.intersection.outgoing, 0.0)
        self._note_delays(counts.sim_time_ns / 1e9, vehicles)
        rows = zip(vehicles.lanes, vehicles.distances_m.tolist(), vehicles.ids, strict=True)
        for lane, distance_m, name in rows:
            side = self._around.upstream.get(lane)
            if side is not None and 0 <= distance_m <= self._reach_m[0]:
                before[side.counts_for] += self._weight(distance_m, name)
            side = self._around.downstream.get(lane)
            if side is not None and self._kind == "position":
                away_m = min(max(0.0, -distance_m), self._reach_m[1])
                behind[side.counts_for] += 1 - away_m / self._reach_m[1]
        greens = self._signal.greens
        pressures = [pressure(self._signal, green, before, behind) for green in greens]
        state = phase_of_highest(greens, pressures, observation.shown)
        return Decision(state, pressures, f"max_pressure_{self._kind}")

    def _weight(self, distance_m: float, name: str) -> float:
        if self._kind == "position":
            return 1 - distance_m / self._reach_m[0]
        return self._stood_s.get(name, 0.0)

    def _note_delays(self, time_s: float, vehicles: LaneVehicles) -> None:
        passed_s = 0.0 if self._time_s is None else time_s - self._time_s
        self._time_s = time_s
        stood_s = {}
        for name, speed_mps in zip(vehicles.ids, vehicles.speeds_mps.tolist(), strict=True):
            stood_s[name] = self._stood_s.get(name, 0.0) + passed_s * (speed_mps < _WALKING_MPS)
        self._stood_s = stood_s
