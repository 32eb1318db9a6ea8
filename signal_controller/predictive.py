"""Predictive control: a plan over a rolling horizon, from where single vehicles are.

Each frame, vehicles become expected arrivals at the stop bars, `predictive_search` finds the phases
and durations of least cost, and the first of them is requested. In the spirit of COP (Sen and Head
1997) and of schedule-driven control (SURTRAC: Xie, Smith, Lu and Barlow 2012).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from protocol.messages import SignalState
from signal_controller.observation import LaneVehicles, SignalSite, VehicleAssociation
from signal_controller.predictive_model import (
    PERMITTED,
    PROTECTED,
    STEP_S,
    Floats,
    JunctionModel,
)
from signal_controller.predictive_search import Plan, Prices, Problem, search
from signal_controller.predictive_traffic import TrafficMemory
from signal_controller.queue_estimator import uncovered_lanes
from signal_controller.queue_filter import QueueFilter

MAX_VEHICLES = 1000
"""Vehicles that one decision looks at: the nearest."""


@dataclass(frozen=True, slots=True)
class PlannerSettings:
    """How far and how long the planner searches, and what it must not do.

    Attributes:
        horizon_s: how far a plan reaches.
        max_nodes: partial plans that a decision may extend.
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
    """Plans for one signal; learns from frame to frame. See the module."""

    def __init__(self, site: SignalSite, settings: PlannerSettings) -> None:
        self._settings = settings
        self.model = JunctionModel(site, settings.pedestrian_green_s)
        self.memory = TrafficMemory(self.model, settings.inflow_vph, settings.saturation_vph)
        self.queues = QueueFilter(self.model, settings.inflow_vph, settings.saturation_vph)
        self.plan: Plan | None = None
        self._association = VehicleAssociation()
        self._green_since_s: tuple[str, float] = "", 0.0
        self._compile()

    def request(
        self,
        time_s: float,
        vehicles: LaneVehicles,
        shown: SignalState,
        coverage: Mapping[str, float],
    ) -> str:
        """Returns the green to request, and keeps the `plan` that it belongs to.

        Args:
            time_s: of the vehicles and of what is shown.
            vehicles: on the lanes of the signal and others.
            shown: what the signal shows.
            coverage: share of each lane before the stop bars that sensors cover, 1 where it is not
                named; empty where vehicles report themselves alone.
        """
        vehicles = self._association.take(time_s, self._nearest(vehicles))
        model, memory = self.model, self.memory
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
        if least_s > model.site.cabinet.min_green_s:  # people walk: the cabinet knows nothing of it
            left_s = max(left_s, self._green_since_s[1] + least_s - time_s)
        if left_s > 1e-6:
            return model.phases[phase]
        forced = self._overdue_phase(time_s, phase)
        problem = self._problem(time_s, self.arrivals(vehicles), phase)
        self.plan = search(problem, self._settings.prices, self._settings.max_nodes, forced)
        if forced is not None:
            return model.phases[forced]
        after = [planned for planned, step in self.plan.phases if step == 0]
        return model.phases[after[-1]]

    def _compile(self) -> None:
        """Searches once, so that no decision waits for the compiler."""
        nothing = np.zeros((len(self.model.lanes), 1))
        search(self._problem(0.0, nothing, 0), self._settings.prices, 1)

    def _problem(self, time_s: float, arrivals: Floats, phase: int) -> Problem:
        model, memory = self.model, self.memory
        may = memory.shares * memory.has_room
        status = model.pair_status
        since_s = memory.lane_green_since_s
        begin = np.where(np.isinf(since_s), 0.0, since_s - time_s) + memory.lost_s
        return Problem(
            arrivals=arrivals,
            protected=np.where(status == PROTECTED, may, 0.0) @ model.lane_of,
            permitted=np.where(status == PERMITTED, may, 0.0) @ model.lane_of,
            head=memory.head_may_go(model.status),
            inside=memory.waiting_inside(time_s),
            headway_s=memory.headway_s,
            lost_s=memory.lost_s,
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

    def arrivals(self, vehicles: LaneVehicles) -> Floats:
        """Returns (L, T): vehicles expected at each stop bar in each step.

        Those that queue unseen stand at the stop bar; from where nobody is seen, others may come.
        """
        model, memory = self.model, self.memory
        steps = round(self._settings.horizon_s / STEP_S)
        result = np.zeros((len(model.lanes), steps))
        upstream, parked = model.approaches.upstream, memory.parked
        chosen = [
            index
            for index, (lane, name) in enumerate(zip(vehicles.lanes, vehicles.ids, strict=True))
            if lane in upstream and name not in parked
        ]
        if chosen:
            lanes = [vehicles.lanes[i] for i in chosen]
            distances_m = vehicles.distances_m[chosen]
            free_s = np.array(
                [model.free_flow_s(*of) for of in zip(lanes, distances_m.tolist(), strict=True)]
            )
            limits_mps = np.maximum(1.0, distances_m / np.maximum(free_s, 0.1))
            after_s = memory.arrival_s(distances_m, vehicles.speeds_mps[chosen], limits_mps)
            at = np.minimum(after_s / STEP_S, steps).astype(np.int64)
            for lane, step in zip(lanes, at.tolist(), strict=True):
                if step < steps:
                    result[:, step] += memory.chosen_lanes(lane)
        queues = self.queues
        result[:, 0] += np.maximum(0.0, queues.expected() - queues.queued())
        inflow_per_s = np.where(queues.is_seen, memory.arrivals_per_s, queues.arrivals_per_s)
        at_s = np.arange(steps)[None, :] * STEP_S
        seen_s = np.where(queues.is_seen, queues.shares, 0.0) * model.reach_s
        is_beyond = at_s >= model.reach_s[:, None]
        reported = np.where(is_beyond, 0.0, queues.reporting)
        result += (at_s >= seen_s[:, None]) * (1 - reported) * inflow_per_s[:, None] * STEP_S
        return result

    def _overdue_phase(self, time_s: float, phase: int) -> int | None:
        """Returns the phase that must come next because somebody has waited too long."""
        model, memory = self.model, self.memory
        waited_s = time_s - memory.served_s
        longest = int(np.argmax(waited_s))
        if waited_s[longest] < self._settings.max_red_s:
            return None
        best = model.status[:, longest].max()
        if best == 0:
            return None
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
