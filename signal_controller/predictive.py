"""Predictive signal control: a plan over a rolling horizon, from positions of single vehicles.

Each frame, vehicles become expected arrivals at the stop bars, `predictive_search` finds the phases
and durations of least cost, and the first of them is requested. In the spirit of COP (Sen and Head
1997) and of schedule-driven control (SURTRAC: Xie, Smith, Lu and Barlow 2012).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from protocol.messages import SignalState
from signal_controller.observation import LaneVehicles, SignalSite, VehicleAssociation
from signal_controller.predictive_discharge import YELLOW_USED_STEPS, Problem, can_stop
from signal_controller.predictive_model import (
    PERMITTED,
    PROTECTED,
    RED,
    STEP_S,
    Floats,
    JunctionModel,
)
from signal_controller.predictive_search import Plan, Prices, search
from signal_controller.predictive_traffic import TrafficMemory
from signal_controller.queue_estimator import uncovered_lanes
from signal_controller.queue_filter import QueueFilter

MAX_VEHICLES = 1000
"""Vehicles that one decision considers: the nearest."""
_YELLOW_S = YELLOW_USED_STEPS * STEP_S  # a lane seen for less cannot tell which vehicles pass
_SOON_STEPS = 10  # a change that is planned within these is tried immediately, see `_planned`
_BETWEEN_S, _LONGEST_S = 0.5, 2.0  # between frames plans are made so often, so far ahead at most
_SOON_AFTER_S = 1.5  # a change that is planned so long after may be better before
_AT_ONCE_TOLERANCE = 0.02  # of a plan's cost: the end of the horizon changes it by as much


@dataclass(frozen=True, slots=True, eq=False)
class ExpectedVehicles:
    """Vehicles (N,) before the stop bars with free-flow arrival times; none is parked.

    Attributes:
        rows: which of the `LaneVehicles` they are.
        lanes: that they are on.
        distances_m: to their stop bars.
        speeds_mps: of each; what its lane allows where that is not known.
        arrival_s: from now until they are at the stop bar.
        shares: (N, L) probability of each stop bar.
    """

    rows: list[int]
    lanes: list[str]
    distances_m: Floats
    speeds_mps: Floats
    arrival_s: Floats
    shares: Floats

    def after(self, wait_s: float, may: Floats) -> Self:
        """Returns those that are still before the stop bars then, if all keep their speeds.

        `may` (L,) is the share of a lane that may go: others do not pass.
        """
        distances_m = self.distances_m - wait_s * self.speeds_mps
        passed = (distances_m <= 0.0) & (self.distances_m > 0.0) & (self.shares @ may > 0.5)
        left = np.flatnonzero(~passed)
        return type(self)(
            rows=[self.rows[n] for n in left],
            lanes=[self.lanes[n] for n in left],
            distances_m=distances_m[left],
            speeds_mps=self.speeds_mps[left],
            arrival_s=np.maximum(0.0, self.arrival_s[left] - wait_s),
            shares=self.shares[left],
        )


@dataclass(frozen=True, slots=True)
class PlannerSettings:
    """Settings of the planner: horizon, search effort and constraints.

    Attributes:
        horizon_s: how far a plan reaches.
        max_nodes: partial plans that a search may extend; a decision takes one to four of them.
        max_red_s: after which a movement for which somebody waits comes next.
        pedestrian_green_s: the least green of a phase in which people walk.
        inflow_vph: expected on each lane as long as nothing was learnt.
        saturation_vph: the same of a queue that discharges.
    """

    horizon_s: float = 60.0
    max_nodes: int = 1500
    max_red_s: float = 120.0
    pedestrian_green_s: float = 7.0
    inflow_vph: float = 500.0
    saturation_vph: float = 1900.0
    prices: Prices = field(default_factory=Prices)


class PredictivePlanner:
    """Plans for one signal; learns from frame to frame. See the module.

    What is requested is to be shown in `wait_s`, from `planned_s` on, and begins the `plan`.
    """

    def __init__(self, site: SignalSite, settings: PlannerSettings) -> None:
        self._settings = settings
        self.model = JunctionModel(site, settings.pedestrian_green_s)
        self._reach_m = {
            lane: float(self.model.reach_m[self.model.lane_index[side.counts_for]])
            for lane, side in self.model.approaches.upstream.items()
        }
        self.memory = TrafficMemory(self.model, settings.inflow_vph, settings.saturation_vph)
        self.queues = QueueFilter(self.model, settings.inflow_vph, settings.saturation_vph)
        self.plan: Plan | None = None
        self.planned_s = self.wait_s = 0.0
        self.vehicles = LaneVehicles([], np.zeros(0), np.zeros(0), np.zeros(0), [])
        self._association = VehicleAssociation()
        self._green_since_s: tuple[str, float] = "", 0.0
        self._time_s = math.inf
        self._compile()

    def request(
        self,
        time_s: float,
        vehicles: LaneVehicles,
        shown: SignalState,
        coverage: Mapping[str, float],
    ) -> str:
        """Returns the green to request; sets `wait_s`, and the `plan` that it belongs to.

        Args:
            time_s: of the vehicles and of what is shown.
            vehicles: on the lanes of the signal and others.
            shown: what the signal shows.
            coverage: share of each lane that sensors cover from the stop bar on without a gap, 1
                where it is not named; empty where vehicles report themselves alone.
        """
        vehicles = self.vehicles = self._association.take(time_s, self._nearest(vehicles))
        model, memory = self.model, self.memory
        interval_s = min(
            max(0.0, time_s - self._time_s), _LONGEST_S, model.site.cabinet.stale_after_s
        )
        self._time_s, self.wait_s = time_s, 0.0
        unseen = uncovered_lanes(model.lanes, coverage) if coverage else model.lanes
        memory.take(time_s, vehicles, shown.state, unseen)
        open_shares = memory.open_shares(shown.state)
        self.queues.take(time_s, vehicles, open_shares, coverage, memory.parked)
        phase = model.phase_of(shown.green)
        if shown.stage != "green":
            self._green_since_s = "", 0.0
            return model.phases[phase]
        if self._green_since_s[0] != shown.green:
            self._green_since_s = shown.green, time_s
        left_s = shown.earliest_change_ns / 1e9 - time_s
        least_s = model.min_green_steps[phase] * STEP_S
        if least_s > model.site.cabinet.min_green_s:  # people walk: the cabinet does not enforce it
            left_s = max(left_s, self._green_since_s[1] + least_s - time_s)
        if left_s > 1e-6:
            return model.phases[phase]
        forced = self._overdue_phase(time_s, phase)
        expected = self.expected(vehicles)
        problem = self.problem(time_s, self.arrivals(expected), phase, self.passing(expected))
        self.planned_s = time_s
        self.plan = self._planned(problem, forced)
        if forced is not None:
            return model.phases[forced]
        if problem.is_known.all():
            self._plan_between(time_s, interval_s, expected, problem)
        after = [planned for planned, step in self.plan.phases if step == 0]
        return model.phases[after[-1]]

    def _planned(self, problem: Problem, forced: int | None) -> Plan:
        """Returns the best plan found.

        Where vehicles are not known one by one, arrivals are equally likely at any time, and a
        change that is planned soon could be postponed again and again. So an immediate change is
        tested separately, and chosen if it is hardly worse: the search keeps few of the plans that
        do.
        """
        prices, max_nodes = self._settings.prices, self._settings.max_nodes
        plan = search(problem, prices, max_nodes, forced)
        if forced is not None or not plan.phases[1:] or problem.is_known.all():
            return plan
        phase, step = plan.phases[1]
        if not 0 < step <= _SOON_STEPS:
            return plan
        at_once = search(problem, prices, max_nodes, phase)
        best = at_once if at_once.cost <= (1 + _AT_ONCE_TOLERANCE) * plan.cost else plan
        return replace(best, nodes=plan.nodes + at_once.nodes)

    def _plan_between(
        self, time_s: float, interval_s: float, expected: ExpectedVehicles, now: Problem
    ) -> None:
        """Plans for times before the next frame, and keeps the first plan that changes at once.

        That frame is taken to come after as long as this one, with all vehicles as fast as now;
        `now` is the problem of this one.
        """
        assert self.plan is not None
        if not self.plan.phases[1:] or self.plan.phases[1][1] == 0:
            return
        changes_s, nodes = self.plan.phases[1][1] * STEP_S, self.plan.nodes
        may = now.protected[now.phase] + now.permitted[now.phase]
        for wait_s in np.arange(_BETWEEN_S, interval_s - 1e-6, _BETWEEN_S).tolist():
            if changes_s > wait_s + _SOON_AFTER_S:
                continue
            later = expected.after(wait_s, may)
            problem = self.problem(
                time_s, self.arrivals(later), now.phase, self.passing(later), wait_s
            )
            plan = self._planned(problem, None)
            nodes += plan.nodes
            plan = replace(plan, nodes=nodes)
            if plan.phases[1:] and plan.phases[1][1] == 0:
                self.plan, self.planned_s, self.wait_s = plan, time_s + wait_s, wait_s
                return
        self.plan = replace(self.plan, nodes=nodes)

    def _compile(self) -> None:
        """Searches once, so that no decision waits for the compiler."""
        nothing = np.zeros((len(self.model.lanes), 1))
        search(self.problem(0.0, nothing, 0), self._settings.prices, 1)

    def phases_ahead(
        self, time_s: float, shown: SignalState
    ) -> tuple[list[tuple[int, float]], int]:
        """Returns the plan's phases from the one that is shown on, and how many of them have begun.

        Each has the step from now at which it is asked for. Within a change to a phase, and within
        the shortest green after it, the one before it stands first. Without phases the signal does
        not do what was planned.
        """
        if self.plan is None:
            return [], 0
        passed = (time_s - self.planned_s) / STEP_S
        phases = [(phase, step - passed) for phase, step in self.plan.phases]
        now = sum(step <= 0 for _, step in phases) - 1 if passed > 0 else 0
        if phases[now][0] != self.model.phase_of(shown.green):
            return [], 0
        first = max(0, now - 1)
        return phases[first:], now - first + 1

    def problem(
        self,
        time_s: float,
        arrivals: Floats,
        phase: int,
        passing: Floats | None = None,
        wait_s: float = 0.0,
    ) -> Problem:
        """Returns the search problem at a time at which a phase is shown.

        Args:
            time_s: of the vehicles.
            arrivals: see `arrivals`.
            phase: that is shown.
            passing: see `passing`; without it, nobody is taken to be too close to stop.
            wait_s: from then until the plan begins.
        """
        model, memory = self.model, self.memory
        may = memory.shares * memory.has_room
        status = model.pair_status
        since_s = memory.lane_green_since_s
        protected = np.where(status == PROTECTED, may, 0.0) @ model.lane_of
        permitted = np.where(status == PERMITTED, may, 0.0) @ model.lane_of
        begin = np.where(np.isinf(since_s), 0.0, since_s - time_s - wait_s) + memory.lost_s
        inside = memory.waiting_inside(time_s)
        has_right = protected[phase] / np.maximum(protected[phase] + permitted[phase], 1e-9)
        is_ready = self.queues.is_seen * has_right * (1.0 - inside)
        return Problem(
            arrivals=arrivals,
            passing=np.zeros_like(arrivals) if passing is None else passing,
            is_known=self.queues.is_seen & (self.queues.coverage * model.reach_s >= _YELLOW_S),
            protected=protected,
            permitted=permitted,
            both=np.where(model.status[:, None] * model.status[None, :] > RED, may, 0.0)
            @ model.lane_of,
            head=memory.head_may_go(model.status),
            inside=inside,
            headway_s=memory.headway_s,
            lost_s=memory.lost_s,
            credit=is_ready * memory.credit(time_s + wait_s, -begin),
            begin=begin,
            foes=model.foes,
            foe_shares=model.foe_shares(memory.shares),
            change_steps=model.change_steps,
            min_green_steps=model.min_green_steps,
            phase=phase,
            before=len(status) - 1,
            ready=0,
            free=0,
        )

    def arrivals(self, expected: ExpectedVehicles) -> Floats:
        """Returns (L, T): vehicles expected at each stop bar in each step.

        Each counts in the first step that begins after it is there: one that comes into the second
        step of a later yellow may still stop. Those that queue unseen stand at the stop bar; others
        may arrive from where no sensor covers.
        """
        result = np.zeros((len(self.model.lanes), self.steps))
        add_arrivals(result, _step_begins_s(expected), expected.shares)
        self.add_unseen(result)
        return result

    def passing(self, expected: ExpectedVehicles) -> Floats:
        """Returns the arrivals (L, T) that could not stop if yellow began now."""
        result = np.zeros((len(self.model.lanes), self.steps))
        passes = ~can_stop(expected.distances_m, expected.speeds_mps)
        add_arrivals(result, _step_begins_s(expected)[passes], expected.shares[passes])
        return result

    @property
    def steps(self) -> int:
        """Horizon of a plan, in steps."""
        return round(self._settings.horizon_s / STEP_S)

    def expected(self, vehicles: LaneVehicles) -> ExpectedVehicles:
        """Returns the vehicles before the stop bars with their arrival times.

        Those that are farther away than vehicles can be known are part of the expected inflow.
        """
        model, memory = self.model, self.memory
        parked, reach_m = memory.parked, self._reach_m
        around = zip(vehicles.lanes, vehicles.ids, vehicles.distances_m.tolist(), strict=True)
        rows = [
            index
            for index, (lane, name, distance_m) in enumerate(around)
            if distance_m <= reach_m.get(lane, -math.inf) and name not in parked
        ]
        lanes = [vehicles.lanes[i] for i in rows]
        distances_m = vehicles.distances_m[rows]
        free_s = np.array(
            [model.free_flow_s(*of) for of in zip(lanes, distances_m.tolist(), strict=True)]
        )
        limits_mps = np.maximum(1.0, distances_m / np.maximum(free_s, 0.1))
        speeds_mps = vehicles.speeds_mps[rows]
        speeds_mps = np.where(np.isnan(speeds_mps), limits_mps, np.maximum(speeds_mps, 0.0))
        return ExpectedVehicles(
            rows,
            lanes,
            distances_m,
            speeds_mps,
            memory.arrival_s(distances_m, speeds_mps, limits_mps),
            np.array([memory.chosen_lanes(one) for one in lanes]).reshape(-1, len(model.lanes)),
        )

    def add_unseen(self, result: Floats) -> None:
        """Adds to arrivals (L, T) those of vehicles that are not known one by one.

        Those that queue where nothing is seen stand at the stop bar; where a queue may be longer
        than what is seen, they are at the end of that.
        """
        model, memory, steps = self.model, self.memory, result.shape[1]
        queues = self.queues
        counted_per_s = memory.arrivals_per_s
        inflow_per_s = np.where(queues.is_seen, counted_per_s, queues.arrivals_per_s)
        unreported_per_s = np.where(
            queues.is_seen, (1 - queues.reporting) * counted_per_s, queues.unreported_per_s
        )
        at_s = np.arange(steps)[None, :] * STEP_S
        seen_s = np.where(queues.is_seen, queues.coverage, 0.0) * model.reach_s
        ends = np.minimum(np.ceil(seen_s / STEP_S), steps - 1).astype(np.int64)
        result[np.arange(len(ends)), ends] += np.maximum(0.0, queues.expected() - queues.queued())
        is_beyond = at_s >= model.reach_s[:, None]
        unknown_per_s = np.where(is_beyond, inflow_per_s[:, None], unreported_per_s[:, None])
        result += (at_s >= seen_s[:, None]) * unknown_per_s * STEP_S

    def _overdue_phase(self, time_s: float, phase: int) -> int | None:
        """Returns the phase that must come next because a vehicle has waited too long."""
        model, memory = self.model, self.memory
        is_ever_green = model.status.max(axis=0) > RED
        waited_s = np.where(is_ever_green, time_s - memory.served_s, 0.0)
        longest = int(np.argmax(waited_s))
        if waited_s[longest] < self._settings.max_red_s:
            return None
        best = model.status[:, longest].max()
        serving = np.flatnonzero(model.status[:, longest] == best)
        total_s = [float(waited_s[model.status[p] == PROTECTED].sum()) for p in serving]
        if phase in serving:
            return phase
        return int(serving[int(np.argmax(total_s))])

    def _nearest(self, vehicles: LaneVehicles) -> LaneVehicles:
        """Returns the vehicles that matter, at most `MAX_VEHICLES`: the nearest."""
        matter = self.memory.watched_lanes
        order = np.array([i for i, lane in enumerate(vehicles.lanes) if lane in matter], np.int64)
        if len(order) > MAX_VEHICLES:
            away_m = np.abs(vehicles.distances_m[order])
            order = np.sort(order[np.argsort(away_m, kind="stable")[:MAX_VEHICLES]])
        return vehicles.take(order)


def _step_begins_s(expected: ExpectedVehicles) -> Floats:
    """Returns the begin of the first step after each vehicle (N,) is there."""
    return np.asarray(np.ceil(expected.arrival_s / STEP_S) * STEP_S)


def add_arrivals(result: Floats, arrival_s: Floats, shares: Floats) -> None:
    """Adds to arrivals (L, T) vehicles (N,) that come so soon, with shares (N, L) of each lane."""
    steps = result.shape[1]
    at = np.minimum(arrival_s / STEP_S, steps).astype(np.int64)
    for step, share in zip(at.tolist(), shares, strict=True):
        if step < steps:
            result[:, step] += share
