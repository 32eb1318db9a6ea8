"""Speed advice (GLOSA): the speed at which a vehicle reaches the stop bar at green.

Green Light Optimal Speed Advisory, as in Katsaros, Kernchen, Dianati and Rieck (2011): the time
until the vehicle may pass gives its speed. That time follows from the phases that the predictive
policy plans, from how lanes discharge in them, and from the vehicles ahead on its lane.

The times of a plan that rolls on are not kept: a green that is to come in ten seconds is brought
forward or put off. A vehicle that drives slowly towards it misses the one or has to stop all the
same. So the earliest time counts: the phases come in the plan's order, each as soon as the cabinet
permits, and last as long as needed. If the model is right, such advice makes no vehicle later.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from protocol.messages import SignalState
from signal_controller.predictive import ExpectedVehicles, PredictivePlanner, add_arrivals
from signal_controller.predictive_discharge import Problem, discharged
from signal_controller.predictive_model import STEP_S, Floats

_LEAST_DELAY_S = 2.0  # a vehicle held up for less passes without a stop
_SURE = 0.5  # probability of a vehicle's stop bar from which it is known
_EPSILON = 1e-6  # of a vehicle


class SpeedAdviser:
    """Advises the vehicles that report themselves before one signal's stop bars."""

    def __init__(self, planner: PredictivePlanner, least_mps: float) -> None:
        self._planner = planner
        self._least_mps = least_mps
        self._advised: set[str] = set()

    def advise(self, time_s: float, shown: SignalState) -> dict[str, float | None]:
        """Returns speeds in m/s by agent, None for those whose last advice has ended.

        To be called after each request of the planner, with its arguments.
        """
        return self._told(self._speeds(time_s, shown))

    def release(self) -> dict[str, float | None]:
        """Ends all advice."""
        return self._told({})

    def _told(self, speeds: dict[str, float]) -> dict[str, float | None]:
        ended = dict.fromkeys(sorted(self._advised - speeds.keys()))
        self._advised = set(speeds)
        return {**speeds, **ended}

    def _speeds(self, time_s: float, shown: SignalState) -> dict[str, float]:
        planner, agents = self._planner, self._planner.vehicles.agents
        phases, begun = planner.phases_ahead(time_s, shown)
        if agents is None or not any(agents) or not phases:
            return {}
        expected = planner.expected(planner.vehicles)
        unseen = np.zeros((len(planner.model.lanes), planner.steps))
        planner.add_unseen(unseen)
        problem = planner.problem(time_s, unseen, phases[0][0])
        passages = passages_of(problem, soonest(problem, phases, begun), expected)
        by_id = planner.model.site.road_map.by_id
        speeds = {
            agents[row]: advised_mps(passage, self._least_mps, by_id[lane].speed_mps)
            for row, lane, passage in zip(expected.rows, expected.lanes, passages, strict=True)
            if agents[row]
        }
        return {agent: speed for agent, speed in speeds.items() if speed is not None}


@dataclass(frozen=True, slots=True)
class Passage:
    """Times of a vehicle at its stop bar, from now: in free flow, and at the earliest.

    `passes_s` is inf where the plan does not determine it, or where the stop bar is not sure.
    """

    distance_m: float
    arrives_s: float
    passes_s: float


Phases = list[tuple[int, float]]


def soonest(problem: Problem, phases: Phases, begun: int) -> list[Phases]:
    """Returns the courses that a signal can take soonest, in a plan's order.

    In the first the present phase goes on, in each other one the next phase is the last.

    Args:
        problem: as known now.
        phases: of the plan, see `PredictivePlanner.phases_ahead`.
        begun: how many of them have begun.
    """
    early = list(phases[:begun])
    courses = [list(early)]
    for phase, _ in phases[begun:]:
        early.append((phase, _may_end(problem, early)))
        courses.append(list(early))
    return courses


def _may_end(problem: Problem, phases: Phases) -> float:
    """Returns the step from which on the last of these phases may end."""
    if len(phases) == 1:
        return 0.0
    (before, _), (phase, asked) = phases[-2:]
    change = int(problem.change_steps[before, phase])
    return max(0.0, asked + change + int(problem.min_green_steps[phase]))


def passages_of(
    problem: Problem, courses: Sequence[Phases], expected: ExpectedVehicles
) -> list[Passage]:
    """Returns when vehicles (N,) pass their stop bars at the earliest.

    Args:
        problem: as known now, with the arrivals of those alone that are not among the vehicles.
        courses: that the signal may take, see `discharged`.
        expected: all vehicles that are known, advised or not.
    """
    lanes = [int(share.argmax()) for share in expected.shares]
    arrives_s, ahead = _in_line(expected, lanes, problem.arrivals)
    arrivals = problem.arrivals.copy()
    add_arrivals(arrivals, arrives_s, expected.shares)
    problem = replace(problem, arrivals=arrivals)
    passed = [discharged(problem, phases) for phases in courses]
    result = []
    for index, lane in enumerate(lanes):
        is_sure = expected.shares[index, lane] > _SURE
        soonest_s = min(_next_s(one[lane], ahead[index]) for one in passed)
        free_s = soonest_s if is_sure else math.inf
        arrival_s = float(arrives_s[index])
        distance_m = float(expected.distances_m[index])
        result.append(Passage(distance_m, arrival_s, max(free_s, arrival_s)))
    return result


def _in_line(expected: ExpectedVehicles, lanes: list[int], unseen: Floats) -> tuple[Floats, Floats]:
    """Returns arrival times of vehicles (N,), none before the one ahead, and how many are ahead.

    Args:
        expected: the vehicles.
        lanes: (N,) to whose stop bar they drive.
        unseen: (L, T) vehicles that arrive unseen.
    """
    arrives_s, ahead = np.zeros(len(lanes)), np.zeros(len(lanes))
    latest_s, nearer = np.zeros(len(unseen)), np.zeros(len(unseen))
    came = unseen.cumsum(axis=1)
    for index in np.argsort(expected.distances_m, kind="stable").tolist():
        lane = lanes[index]
        latest_s[lane] = arrives_s[index] = max(latest_s[lane], expected.arrival_s[index])
        step = min(int(arrives_s[index] / STEP_S), came.shape[1])
        ahead[index] = nearer[lane] + (came[lane, step - 1] if step else 0.0)
        nearer += expected.shares[index]
    return arrives_s, ahead


def _next_s(passed: Floats, ahead: float) -> float:
    """Returns when the next one passes after so many vehicles, inf if not within the steps (T,)."""
    step = int(np.searchsorted(passed, ahead + _EPSILON, side="right"))
    if step == len(passed):
        return math.inf
    before = float(passed[step - 1]) if step else 0.0
    return (step + max(0.0, ahead - before) / (float(passed[step]) - before)) * STEP_S


def advised_mps(passage: Passage, least_mps: float, limit_mps: float) -> float | None:
    """Returns the speed at which a vehicle is at the stop bar when it may pass.

    None if nothing holds it up, or if that speed is less than `least_mps`: then it must stop.
    """
    if passage.passes_s - passage.arrives_s < _LEAST_DELAY_S:
        return None
    speed_mps = passage.distance_m / passage.passes_s
    return min(speed_mps, limit_mps) if speed_mps >= least_mps else None
