"""From counts to the requested green."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.messages import LaneCounts, SignalState
from protocol.roadmap import Link, PlanPhase, Signal
from signal_controller.policies import fixed, max_pressure, pressure
from signal_controller.queue_estimator import MIN_COVERAGE, extrapolated
from tests.signal_controller.two_phases import MAIN, SIDE, SIGNAL


def counts(main: int, side: int, out_0: int = 0, out_1: int = 0) -> LaneCounts:
    return LaneCounts(
        frame=0,
        sim_time_ns=0,
        tls="j",
        agents=[],
        complete=True,
        upstream={"main": main, "side": side},
        downstream={"out_0": out_0, "out_1": out_1},
    )


def shown(green: str, stage: str = "green") -> SignalState:
    return SignalState(
        frame=0,
        sim_time_ns=0,
        tls="j",
        state=green,
        stage=stage,
        green=green,
        source="max_pressure",
        earliest_change_ns=0,
    )


def test_the_pressure_of_a_phase_counts_a_lane_once_and_its_exits_by_their_mean() -> None:
    given_counts = counts(9, 4, out_0=3, out_1=1)
    assert pressure(SIGNAL, MAIN, given_counts.upstream, given_counts.downstream) == 7.0
    assert pressure(SIGNAL, SIDE, given_counts.upstream, given_counts.downstream) == 1.0
    assert pressure(SIGNAL, MAIN, {}, {}) == 0.0


def test_the_phase_of_highest_pressure_wins() -> None:
    assert max_pressure(SIGNAL, counts(2, 5), shown(MAIN)).state == SIDE
    assert max_pressure(SIGNAL, counts(5, 2), shown(SIDE)).state == MAIN
    assert max_pressure(SIGNAL, counts(5, 5, out_0=4), shown(SIDE)).pressures == [3.0, 1.0]


def test_a_tie_leaves_the_present_green() -> None:
    assert max_pressure(SIGNAL, counts(3, 3), shown(SIDE)).state == SIDE
    assert max_pressure(SIGNAL, counts(3, 3), shown(MAIN)).state == MAIN
    assert max_pressure(SIGNAL, counts(3, 3), None).state == MAIN
    assert max_pressure(SIGNAL, counts(3, 3), shown("rrr", "all_red")).state == MAIN


def test_a_change_under_way_is_carried_through() -> None:
    assert max_pressure(SIGNAL, counts(9, 0), shown(SIDE, "yellow")).state == SIDE


def test_the_fixed_policy_asks_for_the_plan() -> None:
    greens = [fixed(SIGNAL, seconds * 10**9).state for seconds in (0, 29, 31, 53, 55, 58)]
    assert greens == [MAIN, MAIN, SIDE, SIDE, MAIN, MAIN]


@given(st.integers(0, 50), st.integers(0, 50), st.integers(0, 50), st.integers(0, 50))
def test_the_wish_is_always_a_green_of_the_plan(a: int, b: int, c: int, d: int) -> None:
    for state in (None, shown(MAIN), shown(SIDE, "yellow"), shown("yyr", "yellow")):
        assert max_pressure(SIGNAL, counts(a, b, c, d), state).state in SIGNAL.greens


def test_what_nobody_sees_of_a_lane_is_as_full_as_the_rest():
    assert extrapolated({"a": 4, "b": 4, "c": 4}, {"a": 0.5, "b": 1.0}) == {"a": 8, "b": 4, "c": 4}


@pytest.mark.parametrize("share", [0.0, MIN_COVERAGE - 0.01])
def test_of_a_lane_that_hardly_anybody_sees_the_count_stands(share):
    assert extrapolated({"a": 3}, {"a": share}) == {"a": 3}


@given(st.integers(0, 50), st.floats(0, 1))
def test_completing_never_takes_vehicles_away(cars: int, share: float) -> None:
    assert cars <= extrapolated({"a": cars}, {"a": share})["a"] <= cars / MIN_COVERAGE


def test_unseen_parts_may_turn_the_decision():
    given_counts = counts(4, 5).model_copy(update={"coverage_upstream": {"main": 0.5, "side": 1.0}})
    assert max_pressure(SIGNAL, given_counts, None, unseen="empty").state == SIDE
    assert max_pressure(SIGNAL, given_counts, None, unseen="alike").state == MAIN


def test_unseen_parts_behind_the_stop_bar_may_turn_the_decision():
    given_counts = counts(5, 4, out_1=1).model_copy(
        update={"coverage_downstream": {"out_0": 1.0, "out_1": MIN_COVERAGE}}
    )
    assert max_pressure(SIGNAL, given_counts, None, unseen="empty").state == MAIN
    assert max_pressure(SIGNAL, given_counts, None, unseen="alike").state == SIDE


def test_queued_vehicles_press_alone_where_that_is_asked_for():
    given_counts = counts(9, 2).model_copy(update={"stationary_upstream": {"main": 1, "side": 2}})
    assert max_pressure(SIGNAL, given_counts, None).state == MAIN
    assert max_pressure(SIGNAL, given_counts, None, "queued").state == SIDE


def test_a_lorry_presses_as_two_cars_where_that_is_asked_for():
    units = {"pcu_upstream": {"main": 3.0, "side": 4.0}, "pcu_downstream": {}}
    given_counts = counts(3, 2).model_copy(update=units)
    assert max_pressure(SIGNAL, given_counts, None).state == MAIN
    assert max_pressure(SIGNAL, given_counts, None, "pcu").state == SIDE


def test_a_permitted_green_presses_only_where_no_phase_gives_right_of_way() -> None:
    plan = [
        PlanPhase(duration_s=30, state="Grg"),
        PlanPhase(duration_s=10, state="rrG"),
        PlanPhase(duration_s=10, state="rgr"),
    ]
    links = [Link(index=n, from_lane=f"in_{n}", to_lane="out") for n in range(3)]
    turns = Signal(tls="j", links=links, conflicts=[], plan=plan)
    before = {"in_0": 3, "in_1": 4, "in_2": 5}
    assert [pressure(turns, green, before, {}) for green in turns.greens] == [3, 5, 4]
