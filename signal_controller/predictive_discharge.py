"""Queue discharge model of the search: how queues discharge while phases are shown.

Queues are expectations: vehicles by lane, in steps of a second, with a fractional vehicle where
turns or arrivals are uncertain.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from signal_controller.predictive_model import Bools, Floats, Ints

YELLOW_USED_STEPS = 2  # in which vehicles still pass: of a later yellow, of one on unknown lanes
_BRAKING_MPS2 = 4.5  # of SUMO's drivers at yellow: who can stop with it does
_MARGIN_M = 1.0  # of those who need a little more, some stop too: SUMO brakes in steps
_FOLLOW_UP_S = 2.5  # between permitted turns that use the same gap in the opposing traffic
_CRITICAL_GAP_STEPS = 4  # the least gap that they take
_FORCED_HEADWAY_S = 25.0  # through a dense one: at the end of green


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Input of the search at the time of planning; R = P + P * P + 1 rows as `pair_status`.

    Attributes:
        arrivals: (L, T) vehicles that reach the stop bar in each step if nothing holds them.
        passing: (L, T) of these, the ones that cannot stop any more if their green ends now.
        is_known: (L,) whether vehicles near the stop bar are known one by one: then those that are
            `passing`, and no others, pass in a yellow that begins now. On other lanes, on those of
            which a turn keeps its green, and in a later yellow, a queue discharges for
            `YELLOW_USED_STEPS`.
        protected: (R, L) share of a lane's vehicles that may go, with right of way.
        permitted: (R, L) share that may go and yields.
        both: (P, P, L) share that may go in both of two phases.
        head: (P, L) probability that the first vehicle of a lane may go in a phase.
        inside: (L,) vehicles of a lane that wait for a gap behind its stop bar and block it.
        headway_s: (L,) between vehicles of a queue; `lost_s` (L,) from green to the first one.
        credit: (L,) part of a vehicle that a lane which discharges could have served since its last
            one passed: the next one needs the rest alone.
        begin: (L,) step from which on a lane discharges, in what is shown now.
        foe_shares: (P, L, F) share of the vehicles of `foes` that conflict with a lane.
        foes, change_steps, min_green_steps: of `JunctionModel`.
        phase: that is shown, or that the present change leads to.
        before: row of what is green during the rest of the present change.
        ready: step at which the present green begins; 0 if it has.
        free: step from which on the present green may end.
    """

    arrivals: Floats
    passing: Floats
    is_known: Bools
    protected: Floats
    permitted: Floats
    both: Floats
    head: Floats
    inside: Floats
    headway_s: Floats
    lost_s: Floats
    credit: Floats
    begin: Floats
    foes: Ints
    foe_shares: Floats
    change_steps: Ints
    min_green_steps: Ints
    phase: int
    before: int
    ready: int
    free: int


def can_stop(distances_m: Floats, speeds_mps: Floats) -> Bools:
    """Returns whether vehicles (N,) stop before their stop bars if yellow begins now.

    Who stands more than a metre behind the stop bar does not.
    """
    return np.asarray(distances_m >= speeds_mps**2 / (2 * _BRAKING_MPS2) - _MARGIN_M)


def discharged(problem: Problem, phases: Sequence[tuple[int, float]]) -> Floats:
    """Returns how many vehicles have passed each stop bar by the end of each step (L, T).

    Lanes discharge as in the search, except that the first vehicle is assumed to want what its lane
    may do, and that a queue discharges for `YELLOW_USED_STEPS` of each yellow.

    Args:
        problem: as known now.
        phases: with the step from now at which each is asked for, as in a `Plan`; the first one is
            shown, and a later one with a step before now is what it changes to, or did.
    """
    lanes, steps = problem.arrivals.shape
    queue, inside, begin = -problem.credit, problem.inside.copy(), problem.begin.copy()
    queues, at = np.zeros((lanes, steps)), 0
    arrivals = np.ascontiguousarray(problem.arrivals)
    protected = np.ascontiguousarray(problem.protected)
    permitted = np.ascontiguousarray(problem.permitted)
    open_share = protected + permitted
    for stretch in _stretches(problem, phases):
        if stretch.green > 0:
            closed = open_share[stretch.before] <= 0.0
            begin[closed] = stretch.green + problem.lost_s[closed]
        until = math.floor(min(stretch.until, steps))
        for step in range(at, until):
            run(queue, np.ones(lanes), inside, begin, stretch.row, stretch.phase, step, step + 1,
                 arrivals, protected, permitted, problem.headway_s, problem.foes,
                 problem.foe_shares, 0.0)  # fmt: skip
            queues[:, step] = queue
        at = max(at, until)
    passed = problem.arrivals.cumsum(axis=1) - np.maximum(queues, 0.0)
    return np.asarray(np.maximum.accumulate(passed, axis=1))


@dataclass(frozen=True, slots=True)
class _Stretch:
    """A part of a plan in which the same lanes are green, those of a row of `Problem`.

    Where a green begins, at step `green`, `before` is the row of the change that led to it.
    """

    row: int
    phase: int
    until: float
    green: float = 0.0
    before: int = -1


def _stretches(problem: Problem, phases: Sequence[tuple[int, float]]) -> Iterator[_Stretch]:
    """Yields the greens of a plan, with the yellows that are used, and the rest of its changes."""
    count, (phase, _) = len(problem.min_green_steps), phases[0]
    green, before = 0.0, -1
    for after, asked in phases[1:]:
        change = int(problem.change_steps[phase, after])
        pair = count + phase * count + after
        yellow_ends = asked + min(change, YELLOW_USED_STEPS)
        yield _Stretch(phase, phase, yellow_ends, green, before)
        yield _Stretch(pair, phase, asked + change)
        phase, green, before = after, asked + change, pair
    yield _Stretch(phase, phase, math.inf, green, before)


@njit(cache=True)
def _gap_headway_s(
    queue: Floats,
    lane: int,
    phase: int,
    step: int,
    arrivals: Floats,
    foes: Ints,
    foe_shares: Floats,
) -> float:
    """Returns the headway of a lane's permitted turns, by gap acceptance.

    With the probability that no conflicting vehicle comes for a critical gap they follow each
    other, as in the Highway Capacity Manual's model of permitted left turns.
    """
    free, steps = 1.0, arrivals.shape[1]
    for index in range(foes.shape[2]):
        foe = foes[phase, lane, index]
        if foe < 0:
            break
        coming = max(queue[foe], 0.0)
        for ahead in range(step, min(step + _CRITICAL_GAP_STEPS, steps)):
            coming += arrivals[foe, ahead]
        free *= 1.0 - min(1.0, coming) * foe_shares[phase, lane, index]
    return 1.0 / (free / _FOLLOW_UP_S + (1.0 - free) / _FORCED_HEADWAY_S)


@njit(cache=True)
def run(
    queue: Floats,
    fresh: Floats,
    inside: Floats,
    begin: Floats,
    row: int,
    phase: int,
    first: int,
    last: int,
    arrivals: Floats,
    protected: Floats,
    permitted: Floats,
    headway_s: Floats,
    foes: Ints,
    foe_shares: Floats,
    stop_price: float,
) -> float:
    """Lets lanes discharge by a row from step `first` to `last`; returns the cost.

    That is the delay of all, in vehicle-seconds, and a price for each that has to stop. `fresh`
    (L,) is the probability that a lane's first vehicle may go, `begin` (L,) the step from which on
    it discharges; other arrays are as of `Problem`. `queue` and `inside` are changed in place. A
    queue below zero is `credit`, which an empty lane gains.
    """
    cost = 0.0
    steps = arrivals.shape[1]
    for step in range(first, last):
        for lane in range(queue.shape[0]):
            come = arrivals[lane, step] if step < steps else 0.0
            before = queue[lane]
            open_share = protected[row, lane] + permitted[row, lane]
            if permitted[row, lane] <= 0.0:
                inside[lane] = 0.0  # the opposing traffic has stopped
            part = min(1.0, step + 1.0 - begin[lane])
            if open_share <= 0.0 or part <= 0.0:
                after = max(before, 0.0) + come
                cost += stop_price * come
                queue[lane] = after
                cost += after
                continue
            need_s = protected[row, lane] * headway_s[lane]
            if permitted[row, lane] > 0.0:
                gap_s = _gap_headway_s(queue, lane, phase, step, arrivals, foes, foe_shares)
                need_s += permitted[row, lane] * gap_s
                cost += inside[lane]
                part *= 1.0 - inside[lane]
                inside[lane] *= max(0.0, 1.0 - 1.0 / gap_s)
            rate = part * open_share / need_s
            may = rate * fresh[lane]
            after = max(before + come - may, fresh[lane] * (min(1.0, rate) - 1.0))
            served = max(before, 0.0) + come - max(after, 0.0)
            if before > 0.5:
                cost += stop_price * come
            if open_share < 1.0 and served > 0.0 and fresh[lane] > 0.0:
                fresh[lane] *= max(0.0, 1.0 - (1.0 - open_share) * served / fresh[lane])
            queue[lane] = after
            cost += max(after, 0.0)
    return cost


@njit(cache=True)
def turn_head(
    queue: Floats,
    fresh: Floats,
    last_open: Ints,
    old: int,
    new: int,
    protected: Floats,
    permitted: Floats,
    both: Floats,
    head: Floats,
) -> None:
    """Turns the probability that a lane's first vehicle may go into that for the new phase.

    A vehicle that the last open phase did not hold up wants one of the movements open in it; one
    that it held up wants another.
    """
    for lane in range(fresh.shape[0]):
        if protected[old, lane] + permitted[old, lane] > 0.0:
            last_open[lane] = old
        since = last_open[lane]
        share = protected[new, lane] + permitted[new, lane]
        if share <= 0.0:
            continue  # a vehicle that the last open phase held up is still there in the next one
        if since < 0:
            fresh[lane] = head[new, lane]
            continue
        if queue[lane] <= 0.0:
            fresh[lane] = share
            continue
        was = protected[since, lane] + permitted[since, lane]
        kept = both[since, new, lane]
        value = fresh[lane] * kept / was
        if was < 1.0:
            value += (1.0 - fresh[lane]) * max(0.0, share - kept) / (1.0 - was)
        fresh[lane] = min(1.0, value)
