"""Speed advice: when vehicles may pass their stop bars, and how fast they get there by then."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.messages import Detections
from signal_controller.config import SignalConfig
from signal_controller.observation import LaneVehicles, Observation
from signal_controller.policies import Predictive
from signal_controller.predictive import ExpectedVehicles, PlannerSettings, PredictivePlanner
from signal_controller.predictive_discharge import Problem, discharged
from signal_controller.predictive_model import STEP_S
from signal_controller.speed_advice import Passage, advised_mps, passages_of, soonest
from tests.messages import tracked
from tests.signal_controller.crossing import (
    LANES,
    PHASES,
    SITE,
    S,
    counts,
    green,
    seen,
    vehicles,
)

NS, NS_LEFT, EW = PHASES[:3]
LEAST_MPS, LIMIT_MPS = 5.0, 13.9
PLANNER = PredictivePlanner(SITE, PlannerSettings())
STEPS = PLANNER.steps
CHANGE_S, LOST_S, HEADWAY_S = 5.0, 1.5, 3600 / 1900


def problem() -> Problem:
    """No vehicle has been seen yet; none arrives unseen."""
    return PLANNER.problem(0.0, np.zeros((len(LANES), STEPS)), 0)


def expected(*rows: tuple[str, float, float]) -> ExpectedVehicles:
    """Returns vehicles of (lane, m to the stop bar, seconds to it)."""
    lanes = [row[0] for row in rows]
    return ExpectedVehicles(
        rows=list(range(len(rows))),
        lanes=lanes,
        distances_m=np.array([row[1] for row in rows], float),
        speeds_mps=np.full(len(rows), LIMIT_MPS),
        arrival_s=np.array([row[2] for row in rows], float),
        shares=np.eye(len(LANES))[[LANES.index(lane) for lane in lanes]],
    )


def speeds(passages: list[Passage]) -> list[float | None]:
    return [advised_mps(one, LEAST_MPS, LIMIT_MPS) for one in passages]


def at_limit(lane: str, distance_m: float) -> tuple[str, float, float]:
    return lane, distance_m, distance_m / LIMIT_MPS


def test_a_vehicle_before_red_passes_after_the_change_and_those_who_stand_before_it() -> None:
    courses = soonest(problem(), [(0, 0.0), (2, 9.0)], begun=1)
    assert courses == [[(0, 0.0)], [(0, 0.0), (2, 0.0)]]
    waiting = [("e_0", 1.0 + 7 * n, 1.0 + 0.8 * n) for n in range(3)]
    passages = passages_of(problem(), courses, expected(*waiting, at_limit("e_0", 100)))
    by_hand = [CHANGE_S + LOST_S + n * HEADWAY_S for n in range(4)]
    assert [one.passes_s for one in passages] == pytest.approx(by_hand, abs=STEP_S / 2)
    assert speeds(passages) == [None, None, None, pytest.approx(100 / passages[3].passes_s)]


def test_within_a_change_and_the_shortest_green_after_it_time_has_passed() -> None:
    begun = [(0, -7.5), (2, -7.5), (0, 20.0)]
    course = soonest(problem(), begun, begun=2)
    assert course == [begun[:2], [*begun[:2], (0, 2.5)]]
    changing = [[(0, -3.25), (2, -3.25)]]
    (one,) = passages_of(problem(), changing, expected(at_limit("e_0", 20)))
    assert one.passes_s == pytest.approx(CHANGE_S - 3.25 + LOST_S, abs=STEP_S / 2)


def test_a_phase_that_comes_later_comes_after_the_shortest_greens_of_those_before() -> None:
    courses = soonest(problem(), [(0, 0.0), (1, 20.0), (2, 40.0)], begun=1)
    assert courses[-1] == [(0, 0.0), (1, 0.0), (2, CHANGE_S + 5)]
    (one,) = passages_of(problem(), courses, expected(at_limit("e_0", 150)))
    assert one.passes_s == pytest.approx(2 * CHANGE_S + 5 + LOST_S, abs=STEP_S / 2)
    assert speeds([one]) == [pytest.approx(150 / one.passes_s)]


def test_nothing_is_said_of_a_lane_that_the_plan_never_opens() -> None:
    courses = soonest(problem(), [(0, 0.0), (2, 9.0)], begun=1)
    (one,) = passages_of(problem(), courses, expected(at_limit("n_1", 150)))
    assert math.isfinite(one.passes_s)  # it turns left, and yields
    (one,) = passages_of(problem(), [[(1, 0.0)]], expected(at_limit("e_0", 150)))
    assert one.passes_s == math.inf
    assert speeds([one]) == [None]


def test_nobody_is_advised_whose_stop_bar_is_not_known() -> None:
    unsure = expected(at_limit("e_0", 100))
    unsure = replace(unsure, shares=unsure.shares * 0.5)
    (one,) = passages_of(problem(), [[(0, 0.0), (2, 0.0)]], unsure)
    assert one.passes_s == math.inf


def test_vehicles_that_come_unseen_before_it_hold_it_up() -> None:
    crowded = problem()
    crowded.arrivals[LANES.index("e_0"), 0] = 3.0
    course = [[(0, 0.0), (2, 0.0)]]
    (one,) = passages_of(crowded, course, expected(at_limit("e_0", 100)))
    assert one.passes_s == pytest.approx(CHANGE_S + LOST_S + 3 * HEADWAY_S, abs=STEP_S / 2)
    crowded.arrivals[:] = 0.0
    crowded.arrivals[LANES.index("e_0"), 20] = 3.0  # behind it
    (one,) = passages_of(crowded, course, expected(at_limit("e_0", 100)))
    assert one.passes_s == pytest.approx(max(CHANGE_S + LOST_S, one.arrives_s))


def test_turns_that_yield_wait_for_those_who_have_right_of_way() -> None:
    lefts, opposing = at_limit("n_1", 100), [("s_0", 1.0 + 7 * n, 1.0) for n in range(8)]
    course = [[(0, 0.0)]]
    (free,) = passages_of(problem(), course, expected(lefts))
    waits = passages_of(problem(), course, expected(("n_1", 1.0, 0.5), lefts, *opposing))[1]
    assert free.passes_s == free.arrives_s
    assert waits.passes_s > waits.arrives_s + 5


lanes = st.sampled_from(LANES)
coming = st.tuples(lanes, st.floats(0.5, 300.0), st.floats(1.0, 1.5)).map(
    lambda one: (one[0], one[1], one[1] / LIMIT_MPS * one[2])
)
phases = st.lists(st.integers(0, len(PHASES) - 1), min_size=1, max_size=4).map(
    lambda found: [(one, 12.0 * n) for n, one in enumerate(found) if n == 0 or one != found[n - 1]]
)


@settings(max_examples=60)
@given(st.lists(coming, min_size=1, max_size=20), phases)
def test_advice_is_within_bounds_and_leads_to_the_stop_bar_when_one_may_pass(rows, plan) -> None:
    passages = passages_of(problem(), soonest(problem(), plan, begun=1), expected(*rows))
    for passage, speed_mps in zip(passages, speeds(passages), strict=True):
        assert passage.passes_s >= passage.arrives_s
        if speed_mps is None:
            continue
        assert LEAST_MPS <= speed_mps <= LIMIT_MPS
        assert passage.distance_m / speed_mps == pytest.approx(passage.passes_s)
        assert passage.passes_s - passage.arrives_s >= 2.0


@settings(max_examples=60)
@given(st.lists(coming, min_size=1, max_size=20), phases, st.floats(0.1, 300.0), st.data())
def test_one_more_vehicle_ahead_never_lets_anybody_pass_earlier(rows, plan, at_m, data) -> None:
    lane, distance_m, arrival_s = data.draw(st.sampled_from(rows))
    ahead = (lane, min(at_m, distance_m - 0.1), min(at_m / LIMIT_MPS, arrival_s))
    courses = soonest(problem(), plan, begun=1)
    before = passages_of(problem(), courses, expected(*rows))
    after = passages_of(problem(), courses, expected(*rows, ahead))
    for old, new in zip(before, after, strict=False):
        assert new.passes_s >= old.passes_s - 1e-6


@settings(max_examples=60)
@given(st.sampled_from(["n_0", "s_0"]), st.floats(2.5, 40.0))
def test_who_comes_alone_while_its_lane_is_green_is_not_advised(lane, arrival_s) -> None:
    plan = [(0, 0.0), (2, 0.0), (0, 30.0)]
    row = (lane, arrival_s * LIMIT_MPS, arrival_s)
    passages = passages_of(problem(), soonest(problem(), plan, begun=1), expected(row))
    assert passages[0].passes_s == passages[0].arrives_s
    assert speeds(passages) == [None]


@settings(max_examples=40)
@given(st.lists(coming, max_size=20), phases)
def test_no_more_pass_than_have_come_and_none_before_the_green(rows, plan) -> None:
    some = expected(*rows, at_limit("n_0", 50))
    arrivals = np.zeros((len(LANES), STEPS))
    for share, arrival_s in zip(some.shares, some.arrival_s, strict=True):
        arrivals[:, int(arrival_s)] += share
    passed = discharged(replace(problem(), arrivals=arrivals), plan)
    assert (np.diff(passed, axis=1) >= 0).all()
    assert (passed <= arrivals.cumsum(axis=1) + 1e-9).all()
    shown = PLANNER.model.status[plan[0][0]] @ PLANNER.model.lane_of
    begins = int(plan[1][1]) if len(plan) > 1 else STEPS
    assert (passed[shown == 0, :begins] == 0).all()


def named(*rows: tuple[str, float, float], agents: str) -> LaneVehicles:
    """Returns vehicles; those report themselves whose letter is none of `.`."""
    found = vehicles(*rows)
    return replace(found, agents=["" if one == "." else one for one in agents])


def advising(**keys: object) -> Predictive:
    return Predictive(SignalConfig(speed_advice=True, **keys), SITE)


WAITING = [("e_0", 1.0 + 7 * n, 0.0) for n in range(4)]


def test_those_who_report_themselves_are_advised_and_nobody_else() -> None:
    rows = [*WAITING, ("e_0", 120.0, 13.0), ("w_0", 120.0, 13.0)]
    decision = advising().decide(seen(60, NS, named(*rows, agents="a...b.")))
    assert decision.state == EW
    assert {*decision.advice} == {"b"}
    assert 5 < decision.advice["b"] < 13.9
    assert advising().decide(seen(60, NS, named(*rows, agents="......"))).advice == {}
    without = Predictive(SignalConfig(), SITE).decide(seen(60, NS, named(*rows, agents="a...b.")))
    assert without.advice == {}
    assert (without.state, without.policy) == (decision.state, decision.policy)


def test_a_lower_bound_lets_more_be_advised() -> None:
    rows = [*WAITING, ("e_0", 60.0, 10.0)]
    for least_mps, advised in ((3.0, {"a"}), (8.0, set())):
        known = advising(advice_min_mps=least_mps)
        assert {*known.decide(seen(60, NS, named(*rows, agents="....a"))).advice} == advised


def test_advice_ends_once_by_being_free() -> None:
    known, rows = advising(), [*WAITING, ("e_0", 120.0, 13.0)]
    assert known.decide(seen(60, NS, named(*rows, agents="....a"))).advice["a"] is not None
    gone = named(*WAITING, agents="....")
    assert known.decide(seen(60.1, NS, gone)).advice == {"a": None}
    assert known.decide(seen(60.2, NS, gone)).advice == {}


def test_advice_ends_where_the_signal_does_not_follow_the_plan_or_nothing_is_known() -> None:
    rows = [*WAITING, ("e_0", 120.0, 13.0)]
    known, found = advising(), named(*rows, agents="....a")
    known.decide(seen(60, NS, found))
    elsewhere = green(NS_LEFT, 61 * S).model_copy(update={"stage": "yellow"})
    assert known.decide(Observation(counts(0, 61 * S), elsewhere, found)).advice == {"a": None}
    known.decide(seen(62, NS, found))
    decision = known.decide(Observation(counts(0, 63 * S), green(NS, 63 * S), None))
    assert (decision.policy, decision.advice) == ("plan", {"a": None})


def test_within_the_change_advice_goes_on_to_the_same_moment() -> None:
    known, passes_s, asked = advising(), [], ""
    for tenth in range(0, 45, 5):
        distance_m = 120.0 - tenth
        second = 60 + tenth / 10
        found = named(*WAITING, ("e_0", distance_m, 10.0), agents="....a")
        state = green(NS, round(second * S))
        if tenth:
            state = state.model_copy(update={"stage": "yellow", "green": asked})
        all_seen = counts(0, round(second * S), **dict.fromkeys(LANES, 1.0))
        decision = known.decide(Observation(all_seen, state, found))
        asked = asked or decision.state
        assert decision.state == asked
        assert asked[LANES.index("e_0")] == "G"
        passes_s.append(second + distance_m / decision.advice["a"])
    assert np.ptp(passes_s) < 1.0
    assert np.mean(passes_s) == pytest.approx(60 + CHANGE_S + LOST_S + 4 * 2.0, abs=1.0)


def test_only_reports_of_this_frame_name_an_agent() -> None:
    number = 4
    detections = Detections(
        frame=1,
        sim_time_ns=1,
        agents=["a", "b"],
        boxes=np.ones((number, 7), np.float32),
        scores=np.ones(number, np.float32),
        classes=np.array([0, 0, 0, 3], np.uint8),
        lanes=["n_0"] * number,
        distances_m=np.ones(number, np.float32),
        sources=["lidar", "a", "b", "c"],
        **(tracked(number) | {"coasted_s": np.array([0, 0, 0.5, 0], np.float32)}),
    )
    found = LaneVehicles.of(detections)
    assert found.agents == ["", "a", ""]
    assert found.take(np.array([1])).agents == ["a"]
