"""Baselines of `cpnet bench control`: Webster's fixed plan, kinds of max pressure, tunings.

Each is a `SignalPolicy`, made as a plug-in is; SUMO's own programs are set by their parameters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from protocol.approaches import Approaches, bar_starts_m
from protocol.roadmap import PlanPhase, RoadMap, Signal, yellow_between
from signal_controller.observation import CabinetTimes, LaneVehicles, Observation, SignalSite
from signal_controller.policies import (
    Decision,
    FixedPlan,
    max_pressure,
    phase_of_highest,
    pressure,
)
from sim_host.compatible_phases import compatible_phases

MIN_CYCLE_S, MAX_CYCLE_S = 20.0, 120.0
_LOST_S = 1.0  # of a change beyond all-red: what start-up loses over what yellow still lets pass
SATURATION_VPH = 1900.0  # of a lane of SUMO's passenger cars
_MAX_LOAD = 0.95
_WALKING_MPS = 1.0


def webster_signal(
    signal: Signal,
    flows_vph: Mapping[str, float],
    saturation_vph: float,
    times: CabinetTimes,
    cycle_factor: float = 1.0,
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
        cycle_factor: of Webster's cycle, for a timer that is tuned further.
    """
    greens = signal.planned_greens
    ratios = [0.0] * len(greens)
    for lane, flow_vph in flows_vph.items():
        links = [link.index for link in signal.links if link.from_lane == lane]
        serving = _serving(greens, links)
        for phase in serving:
            ratios[phase] = max(ratios[phase], flow_vph / saturation_vph / len(serving))
    lost_s = len(greens) * (times.yellow_s + times.all_red_s + _LOST_S - 2.0)
    load = min(_MAX_LOAD, sum(ratios))
    cycle_s = min(MAX_CYCLE_S, max(MIN_CYCLE_S, cycle_factor * (1.5 * lost_s + 5) / (1 - load)))
    change_s = times.yellow_s + times.all_red_s
    for_green_s = cycle_s - len(greens) * change_s
    total = sum(ratios) or 1.0
    plan = []
    for green, after, ratio in zip(greens, greens[1:] + greens[:1], ratios, strict=True):
        green_s = max(times.min_green_s, for_green_s * ratio / total)
        losing = yellow_between(green, after)
        plan.append(PlanPhase(duration_s=round(green_s), state=green))
        if "y" in losing:  # and all-red in one: what stays green in it is no green to request
            plan.append(PlanPhase(duration_s=change_s, state=losing))
    return signal.model_copy(update={"plan": plan, "further_greens": []})


def _serving(greens: list[str], links: list[int]) -> list[int]:
    for served in (
        [all(green[i] == "G" for i in links) for green in greens],
        [all(green[i] in "Gg" for i in links) for green in greens],
        [any(green[i] in "Gg" for i in links) for green in greens],
    ):
        if any(served):
            return [phase for phase, is_served in enumerate(served) if is_served]
    return []


def webster(
    site: SignalSite, flows_vph: Mapping[str, float], cycle_factor: float = 1.0
) -> FixedPlan:
    """Returns the policy that follows Webster's plan."""
    return FixedPlan(
        webster_signal(site.signal, flows_vph, SATURATION_VPH, site.cabinet, cycle_factor)
    )


class WeightedPressure:
    """Weighted max pressure: vehicles weigh by position or by waiting time.

    `wave`: a vehicle before the stop bar, queued or approaching, weighs 1, one behind it nothing
    (MAXWAVE of Ault and Sharon 2021). `position`: a vehicle weighs 1 at the stop bar and 0 at the
    far end of what is known before it, and 1 right behind it and 0 at the far end there
    (position-weighted back-pressure, Li and Jabari 2019). `delay`: a vehicle before the stop bar
    weighs the seconds that it has stood still (delay-based back-pressure, Wu, Ghosal, Zhang and
    Chuah 2018), one behind it nothing.
    """

    needs_vehicles = True

    def __init__(self, site: SignalSite, kind: str, downstream_m: float) -> None:
        self._signal = site.signal
        self._around = Approaches(site.road_map, site.road_map.by_tls[site.signal.tls])
        self._starts_m = bar_starts_m(self._around.with_neighbours())
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
            if side is not None and self._kind == "position" and self._reach_m[1] > 0:
                behind_m = self._starts_m[lane] - distance_m - side.start_m
                behind[side.counts_for] += max(0.0, 1 - behind_m / self._reach_m[1])
        greens = self._signal.greens
        pressures = [pressure(self._signal, green, before, behind) for green in greens]
        state = phase_of_highest(greens, pressures, observation.shown)
        return Decision(state, pressures, f"max_pressure_{self._kind}")

    def _weight(self, distance_m: float, name: str) -> float:
        match self._kind:
            case "wave":
                return 1.0
            case "position":
                return 1 - distance_m / self._reach_m[0]
            case _:
                return self._stood_s.get(name, 0.0)

    def _note_delays(self, time_s: float, vehicles: LaneVehicles) -> None:
        passed_s = 0.0 if self._time_s is None else time_s - self._time_s
        self._time_s = time_s
        stood_s = {}
        for name, speed_mps in zip(vehicles.ids, vehicles.speeds_mps.tolist(), strict=True):
            stood_s[name] = self._stood_s.get(name, 0.0) + passed_s * (speed_mps < _WALKING_MPS)
        self._stood_s = stood_s


@dataclass(frozen=True, slots=True)
class Tuning:
    """One set of parameters that an advocate of a baseline would try.

    Attributes:
        text: what is set, for a table.
        upstream_m, downstream_m: the fence; None as the case has it.
        own: of the baseline itself, see `OWN_SETTINGS`.
        cabinet: of the scenario's section `cabinet`.
        settings: of its section `signal`.
    """

    text: str
    upstream_m: float | None = None
    downstream_m: float | None = None
    own: Mapping[str, float] = field(default_factory=dict)
    cabinet: Mapping[str, Any] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)


PRESSURES = {
    "max_pressure": "vehicles",
    "queue_pressure": "queued",
    "position_pressure": "position",
    "delay_pressure": "delay",
    "max_wave": "wave",
}
"""The weight of a vehicle, by kind of max pressure."""
SUMO_TYPES = {"actuated": 3, "delay_based": 5}
"""SUMO's own kinds of control, by SUMO's numbers."""
OWN_SETTINGS: Mapping[str, tuple[str, ...]] = {
    "webster": ("cycle_factor",),
    "actuated": ("max-gap", "detector-gap"),
    "delay_based": ("minTimeLoss", "detectorRange"),
    **dict.fromkeys(PRESSURES, ("hold_s",)),
}
"""Parameters of each baseline; those of SUMO's programs by SUMO's names."""


def _fence(upstream_m: float, downstream_m: float, hold_s: float = 0.0) -> Tuning:
    text = f"{upstream_m:g} m before, {downstream_m:g} m behind"
    text += f", greens of {hold_s:g} s" if hold_s else ""
    return Tuning(text, upstream_m, downstream_m, {"hold_s": hold_s})


def _gaps(gap_s: float, detector_s: float, max_green_s: float) -> Tuning:
    return Tuning(
        f"gap {gap_s:g} s, loops {detector_s:g} s before, at most {max_green_s:g} s",
        own={"max-gap": gap_s, "detector-gap": detector_s},
        cabinet={"max_green_s": max_green_s},
    )


def _losses(loss_s: float, range_m: float, max_green_s: float) -> Tuning:
    return Tuning(
        f"loss {loss_s:g} s, {range_m:g} m before, at most {max_green_s:g} s",
        own={"minTimeLoss": loss_s, "detectorRange": range_m},
        cabinet={"max_green_s": max_green_s},
    )


COMPATIBLE: Mapping[str, Any] = {"phases": "compatible"}
"""Settings with which a policy chooses among all that signal groups allow."""
_FENCES = (
    _fence(200, 100),
    _fence(100, 0),
    _fence(50, 0),
    _fence(30, 0),
    _fence(50, 0, 10),
    _fence(100, 50, 10),
)
_WITH_PHASES = (
    *_FENCES,
    *(replace(o, text=f"{o.text}, compatible phases", settings=COMPATIBLE) for o in _FENCES),
)
TUNINGS: Mapping[str, tuple[Tuning, ...]] = {
    "webster": tuple(
        Tuning(f"cycle x {factor:g}", own={"cycle_factor": factor})
        for factor in (1.0, 0.7, 0.85, 1.2, 1.5)
    ),
    "actuated": (
        _gaps(3, 2, 50),
        _gaps(3, 2, 25),
        _gaps(2, 2, 50),
        _gaps(2, 2, 25),
        _gaps(2, 1, 35),
        _gaps(1.5, 1, 25),
    ),
    "delay_based": (
        _losses(1, 100, 50),
        _losses(1, 100, 25),
        _losses(1, 50, 50),
        _losses(1, 50, 25),
        _losses(3, 50, 35),
        _losses(0.5, 30, 25),
    ),
    **dict.fromkeys(PRESSURES, _WITH_PHASES),
}
"""Parameters that are tried for each baseline; the first is the default. Others are not tuned."""


def worth_trying(tunings: Sequence[Tuning], road_map: RoadMap) -> list[Tuning]:
    """Returns the tunings; those with compatible phases if a signal of the map has any."""
    has_phases = any(compatible_phases(one.signal, road_map) for one in road_map.intersections)
    return [one for one in tunings if has_phases or one.settings != COMPATIBLE]
