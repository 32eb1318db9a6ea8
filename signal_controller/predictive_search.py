"""Search for the plan of least cost: phases, their order and durations, some 60 s ahead.

Forward dynamic programming over time and phase, in the spirit of COP (Sen and Head 1997): of the
plans that are in the same phase at the same time, the best few are kept, by their cost so far and
an estimate of what their queues will still cost. Unlike COP, phases come in any order and queues
are expectations, see `predictive_discharge`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from signal_controller.predictive_discharge import YELLOW_USED_STEPS, Problem, run, turn_head
from signal_controller.predictive_model import Bools, Floats, Ints

MAX_STEPS = 120
_YIELDING = 0.3  # of a lane's discharge, where its turns yield
_SERVED = 0.05  # of a lane's vehicles: a phase that serves fewer is of no help to its queue
_LONGEST_GREEN_S = 120.0  # that a queue is taken to need
_BUSIEST = 0.8  # of what a lane can discharge: more does not come in the long run


@dataclass(frozen=True, slots=True)
class Prices:
    """Costs of a plan besides delay, in vehicle-seconds.

    Attributes:
        stop: of a vehicle that has to stop.
        switch: of a change of phase.
        left_s: delay of a vehicle that waits at red when the plan ends, beside its queue's.
    """

    stop: float = 6.0
    switch: float = 1.0
    left_s: float = 12.0


@dataclass(frozen=True, slots=True)
class Plan:
    """Phases with the step at which each begins to be asked for, the first at 0.

    `cost` is in vehicle-seconds; `nodes` says how many partial plans were extended.
    """

    phases: tuple[tuple[int, int], ...]
    cost: float
    nodes: int


def search(
    problem: Problem, prices: Prices, max_nodes: int, allowed_first: int | None = None
) -> Plan:
    """Returns the best plan found; after `max_nodes` extended ones the best of those so far.

    `allowed_first` is the phase that must come next, as soon as the present green may end.
    """
    phases = len(problem.min_green_steps)
    kept = 4 if phases <= 4 else 2
    path, cost, nodes = _search(
        np.ascontiguousarray(problem.arrivals),
        np.ascontiguousarray(problem.passing),
        problem.is_known,
        np.concatenate([problem.protected, np.zeros_like(problem.protected[:1])]),
        np.concatenate([problem.permitted, np.zeros_like(problem.permitted[:1])]),
        np.ascontiguousarray(problem.both),
        np.ascontiguousarray(problem.head),
        problem.inside,
        problem.headway_s,
        problem.lost_s,
        problem.credit,
        problem.begin,
        problem.foes,
        problem.foe_shares,
        problem.change_steps,
        problem.min_green_steps,
        np.array(
            [
                problem.phase,
                problem.before,
                problem.ready,
                problem.free,
                -1 if allowed_first is None else allowed_first,
                kept,
                max_nodes,
            ]
        ),
        np.array([prices.stop, prices.switch, prices.left_s]),
    )
    return Plan(tuple((int(phase), int(step)) for phase, step in path), float(cost), int(nodes))


@njit(cache=True)
def _left(
    queue: Floats,
    fresh: Floats,
    begin: Floats,
    step: int,
    row: int,
    protected: Floats,
    permitted: Floats,
    left_s: float,
    drain_s: Floats,
    served_in: Ints,
    held_per_s: Floats,
    closed_s: float,
    green_s: Floats,
) -> float:
    """Estimates the cost of the remaining queues at a step (cost to go), for themselves and others.

    They wait for their green and for each other, and the green that they need delays vehicles that
    arrive on other lanes meanwhile (`_held_up`). Without the latter, a queue whose green costs
    others more than it saves before the plan ends would be put off from plan to plan.

    Args:
        queue: vehicles of each lane (L,); `fresh` and `begin` (L,) are as of `run`.
        fresh: see `queue`.
        begin: see `queue`.
        step: at which they are there, in a phase `row`; (R, L) as of `Problem`.
        row: see `step`.
        protected: see `step`.
        permitted: see `step`.
        left_s: that a vehicle without green waits for it.
        drain_s: seconds of each vehicle (L,), see `_drain_s`.
        served_in: the phase that serves a lane (L,), -1 for none.
        held_per_s: vehicles that a second of a phase holds up (P,).
        closed_s: how long they are held up beside that, see `_closed_s`.
        green_s: to work in (P,).
    """
    cost = 0.0
    green_s[:] = 0.0
    for lane in range(queue.shape[0]):
        left = queue[lane]
        if left <= 0.0:
            continue
        is_open = (protected[row, lane] + _YIELDING * permitted[row, lane]) * fresh[lane]
        wait_s = left_s * (1.0 - is_open) + max(0.0, begin[lane] - step) * is_open
        cost += left * (wait_s + 0.5 * drain_s[lane] * left)
        phase = served_in[lane]
        if phase >= 0:
            may = protected[phase, lane] + permitted[phase, lane]
            pace = (protected[phase, lane] + _YIELDING * permitted[phase, lane]) / may
            need_s = min(_LONGEST_GREEN_S, left * drain_s[lane] / pace)
            green_s[phase] = max(green_s[phase], need_s)
    for phase in range(green_s.shape[0]):
        cost += held_per_s[phase] * green_s[phase] * (0.5 * green_s[phase] + closed_s)
    return cost


@njit(cache=True)
def _drain_s(arrivals: Floats, headway_s: Floats) -> Floats:
    """Returns the seconds (L,) that each vehicle of a queue takes, with those who join it."""
    steps = arrivals.shape[1]
    result = np.empty(arrivals.shape[0])
    for lane in range(len(result)):
        rate = arrivals[lane, steps // 2 :].mean()
        result[lane] = headway_s[lane] / (1.0 - min(_BUSIEST, rate * headway_s[lane]))
    return result


@njit(cache=True)
def _closed_s(change_steps: Ints) -> float:
    """Returns how long the changes to a phase and back keep the other lanes closed, on average."""
    phases, total = change_steps.shape[0], 0.0
    for one in range(phases):
        for other in range(phases):
            if one != other:
                change = change_steps[one, other]
                total += 2 * (change - min(change, YELLOW_USED_STEPS))
    return float(total / max(1, phases * (phases - 1)))


@njit(cache=True)
def _held_up(
    arrivals: Floats,
    protected: Floats,
    permitted: Floats,
    headway_s: Floats,
    drain_s: Floats,
    phases: int,
) -> tuple[Ints, Floats]:
    """Returns which phase serves each lane at least cost (L,), and what a green of each holds up.

    The latter are the vehicles (P,) that come in a second of it on lanes that it does not serve,
    with those who come until their queues have gone. Lanes that no phase serves have -1, and are
    not held up.
    """
    lanes, steps = arrivals.shape
    per_s = np.zeros(phases)
    for lane in range(lanes):
        may = protected[:phases, lane] + permitted[:phases, lane]
        if may.max() >= _SERVED:
            come = arrivals[lane, steps // 2 :].mean() * drain_s[lane] / headway_s[lane]
            per_s += come * (1.0 - may)
    served_in = np.full(lanes, -1)
    for lane in range(lanes):
        least = np.inf
        for phase in range(phases):
            served = protected[phase, lane] + _YIELDING * permitted[phase, lane]
            may = protected[phase, lane] + permitted[phase, lane]
            if may >= _SERVED and (1e-6 + per_s[phase]) / served < least:
                least, served_in[lane] = (1e-6 + per_s[phase]) / served, phase
    return served_in, per_s


@njit(cache=True)
def _end_now(
    coming: Floats,
    arrivals: Floats,
    passing: Floats,
    is_known: Bools,
    inside: Floats,
    protected: Floats,
    permitted: Floats,
    phase: int,
    pair: int,
) -> float:
    """Sets up the yellow of a change that begins now; returns what turners inside wait for it.

    On known lanes that lose their green, those in `passing` are gone, and `coming` (L, T) stop. On
    others, also where some turns keep their green, the queue discharges as in `phase`. So the last
    row of `protected` and `permitted` (R + 1, L) holds the shares of one or the other.
    """
    cost = 0.0
    for lane in range(len(is_known)):
        was_open = protected[phase, lane] + permitted[phase, lane] > 0.0
        is_closed = was_open and protected[pair, lane] + permitted[pair, lane] <= 0.0
        row, coming[lane] = phase, arrivals[lane]
        if is_closed and is_known[lane]:
            row, coming[lane] = pair, arrivals[lane] - passing[lane]
            if permitted[phase, lane] > 0.0:
                cost += YELLOW_USED_STEPS * inside[lane]
        protected[-1, lane], permitted[-1, lane] = protected[row, lane], permitted[row, lane]
    return cost


@njit(cache=True)
def _search(
    arrivals: Floats,
    passing: Floats,
    is_known: Bools,
    protected: Floats,
    permitted: Floats,
    both: Floats,
    head: Floats,
    inside0: Floats,
    headway_s: Floats,
    lost_s: Floats,
    credit: Floats,
    begin0: Floats,
    foes: Ints,
    foe_shares: Floats,
    change_steps: Ints,
    min_green: Ints,
    start: Ints,
    prices: Floats,
) -> tuple[Ints, float, int]:
    lanes, steps = arrivals.shape
    phases = min_green.shape[0]
    first_phase, before, ready, free, allowed, kept, max_nodes = start
    drain_s = _drain_s(arrivals, headway_s)
    served_in, held_per_s = _held_up(arrivals, protected, permitted, headway_s, drain_s, phases)
    closed_s, green_s = _closed_s(change_steps), np.zeros(phases)
    stop_price, switch_price, left_s = prices
    slots = (steps + 1) * phases * kept
    queue = np.zeros((slots + 1, lanes))
    fresh = np.zeros((slots + 1, lanes))
    inside = np.zeros((slots + 1, lanes))
    begin = np.zeros((slots + 1, lanes))
    last_open = np.zeros((slots + 1, lanes), np.int64)
    cost = np.zeros(slots)
    value = np.zeros(slots)
    parent = np.full(slots, -1)
    asked = np.zeros(slots, np.int64)  # step at which the last phase was asked for
    count = np.zeros((steps + 1, phases), np.int64)
    work = slots  # the row of arrays that holds a plan while it is extended
    coming = np.empty_like(arrivals)  # the arrivals of a plan that changes now
    last_row = len(protected) - 1

    # What is shown must go on until it may end.
    queue[work] = -credit * head[first_phase]
    begin[work] = begin0
    last_open[work] = -1
    fresh[work] = head[first_phase]
    inside[work] = inside0
    paid = 0.0
    ready, free = min(ready, steps), min(max(free, ready), steps)
    if ready > 0:
        paid += run(queue[work], fresh[work], inside[work], begin[work], before,
                     first_phase, 0, ready, arrivals, protected, permitted, headway_s, foes,
                     foe_shares, stop_price)  # fmt: skip
        for lane in range(lanes):
            if protected[before, lane] + permitted[before, lane] <= 0.0:
                begin[work, lane] = ready + lost_s[lane]
    paid += run(queue[work], fresh[work], inside[work], begin[work], first_phase,
                 first_phase, ready, free, arrivals, protected, permitted, headway_s, foes,
                 foe_shares, stop_price)  # fmt: skip
    slot = (free * phases + first_phase) * kept
    queue[slot], fresh[slot], begin[slot] = queue[work], fresh[work], begin[work]
    inside[slot], last_open[slot] = inside[work], last_open[work]
    cost[slot] = paid
    value[slot] = paid + _left(queue[work], fresh[work], begin[work], free, first_phase,
                               protected, permitted, left_s, drain_s, served_in, held_per_s,
                               closed_s, green_s)  # fmt: skip
    count[free, first_phase] = 1
    root = slot

    nodes = 0
    best = root
    best_value = np.inf
    for step in range(free, steps + 1):
        for phase in range(phases):
            for number in range(count[step, phase]):
                slot = (step * phases + phase) * kept + number
                if step == steps:
                    if value[slot] < best_value:
                        best_value = value[slot]
                        best = slot
                    continue
                is_spent = nodes >= max_nodes  # then plans end in the phase that they are in
                nodes += 1
                for after in range(phases):
                    is_kept = after == phase
                    is_first = slot == root and allowed >= 0
                    if (is_first and after != allowed) or (
                        is_spent and not is_kept and not is_first
                    ):
                        continue
                    queue[work], fresh[work], begin[work] = queue[slot], fresh[slot], begin[slot]
                    inside[work], last_open[work] = inside[slot], last_open[slot]
                    paid = cost[slot]
                    if is_kept:
                        until = min(steps, step + (1 if step < 12 else 2 if step < 30 else 3))
                        if is_spent:
                            until = steps
                        paid += run(queue[work], fresh[work], inside[work], begin[work], phase,
                                     phase, step, until, arrivals, protected, permitted, headway_s,
                                     foes, foe_shares, stop_price)  # fmt: skip
                    else:
                        change = change_steps[phase, after]
                        used = min(change, YELLOW_USED_STEPS)
                        pair = phases + phase * phases + after
                        middle = min(steps, step + used)
                        green = min(steps, step + change)
                        until = min(steps, max(step + change + min_green[after], step + 1))
                        paid += switch_price
                        come, yellow = arrivals, phase
                        if slot == root and free == 0:
                            come, yellow = coming, last_row
                            paid += _end_now(coming, arrivals, passing, is_known, inside[work],
                                             protected, permitted, phase, pair)  # fmt: skip
                        paid += run(queue[work], fresh[work], inside[work], begin[work], yellow,
                                     phase, step, middle, come, protected, permitted, headway_s,
                                     foes, foe_shares, stop_price)  # fmt: skip
                        paid += run(queue[work], fresh[work], inside[work], begin[work], pair,
                                     phase, middle, green, come, protected, permitted,
                                     headway_s, foes, foe_shares, stop_price)  # fmt: skip
                        turn_head(queue[work], fresh[work], last_open[work], phase, after,
                                   protected, permitted, both, head)  # fmt: skip
                        for lane in range(lanes):
                            if protected[pair, lane] + permitted[pair, lane] <= 0.0:
                                begin[work, lane] = step + change + lost_s[lane]
                        paid += run(queue[work], fresh[work], inside[work], begin[work], after,
                                     after, green, until, come, protected, permitted, headway_s,
                                     foes, foe_shares, stop_price)  # fmt: skip
                    worth = paid + _left(queue[work], fresh[work], begin[work], until, after,
                                         protected, permitted, left_s, drain_s, served_in,
                                         held_per_s, closed_s, green_s)  # fmt: skip
                    base = (until * phases + after) * kept
                    place = base + count[until, after]
                    if count[until, after] == kept:
                        place = base
                        for other in range(base + 1, base + kept):
                            if value[other] > value[place]:
                                place = other
                        if value[place] <= worth:
                            continue
                    else:
                        count[until, after] += 1
                    queue[place], fresh[place] = queue[work], fresh[work]
                    begin[place], last_open[place] = begin[work], last_open[work]
                    inside[place] = inside[work]
                    cost[place], value[place] = paid, worth
                    parent[place] = slot
                    asked[place] = asked[slot] if is_kept else step

    # Back from the best one to its first phase.
    found = np.zeros((steps + 2, 2), np.int64)
    length, slot = 0, best
    while True:
        phase = (slot // kept) % phases
        if length == 0 or found[length - 1, 0] != phase:
            found[length, 0] = phase
            found[length, 1] = asked[slot]
            length += 1
        if parent[slot] < 0:
            break
        slot = parent[slot]
    return found[:length][::-1], best_value, nodes
