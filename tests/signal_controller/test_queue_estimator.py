"""A lane that no sensor covers is unknown, not empty."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.messages import LaneCounts, SignalState
from signal_controller.config import SignalConfig
from signal_controller.policies import fallback_plan, max_pressure
from signal_controller.queue_estimator import MIN_COVERAGE, SPACING_M, QueueEstimate, QueueEstimator
from tests.signal_controller.two_phases import MAIN, SIDE, SIGNAL

S = 1_000_000_000
REACH_M = 200.0
CONFIG = SignalConfig(
    estimator_inflow_vph=360, estimator_saturation_vph=1800
)  # 0.1 and 0.5 a second


def counts(main: int, side: int, /, **seen: float) -> LaneCounts:
    return LaneCounts(
        frame=0,
        sim_time_ns=0,
        tls="j",
        agents=[],
        complete=True,
        upstream={"main": main, "side": side},
        downstream={},
        coverage_upstream=seen,
    )


def shown(second: float, state: str = MAIN) -> SignalState:
    return SignalState(
        frame=0,
        sim_time_ns=round(second * S),
        tls="j",
        state=state,
        stage="green",
        green=state,
        source="test",
        earliest_change_ns=0,
    )


def estimator(**keys: float) -> QueueEstimator:
    return QueueEstimator(SIGNAL, CONFIG.model_copy(update=keys), REACH_M)


def test_what_is_seen_is_not_estimated():
    known = estimator()
    assert known.take(counts(3, 4, main=1.0, side=MIN_COVERAGE), shown(0)) == QueueEstimate(
        {}, False
    )
    assert known.take(counts(3, 4), shown(99)) == QueueEstimate({}, False)


def test_a_lane_grows_while_red_and_shrinks_while_green_from_what_was_last_seen():
    known = estimator()
    known.take(counts(4, 2, main=0.5, side=0.5), shown(0))
    after = known.take(counts(0, 0, main=0.0, side=0.0), shown(10))
    assert after.vehicles == pytest.approx({"main": 4, "side": 5})
    after = known.take(counts(0, 0, main=0.0, side=0.0), shown(14, SIDE))
    assert after.vehicles == pytest.approx({"main": 4.4, "side": 3.4})
    assert known.take(counts(1, 0, main=1.0, side=0.0), shown(14)).vehicles.keys() == {"side"}


def test_a_lane_that_was_never_seen_starts_empty_and_never_overflows():
    known = estimator(estimator_inflow_vph=3600)
    first = known.take(counts(0, 0, main=0.0, side=0.0), shown(500))
    assert first == QueueEstimate({"main": 0.0, "side": 0.0}, False)
    for second in range(501, 600):
        known.take(counts(0, 0, main=0.0, side=1.0), shown(second, SIDE))
    last = known.take(counts(0, 0, main=0.0, side=1.0), shown(600, SIDE))
    assert last.vehicles == {"main": REACH_M / SPACING_M}


def test_vehicles_that_report_themselves_are_the_least_there_is():
    known = estimator()
    assert known.take(counts(7, 0, main=0.0, side=1.0), shown(0)).vehicles == {"main": 7}
    assert known.take(counts(2, 0, main=0.0, side=1.0), shown(4)).vehicles == {
        "main": pytest.approx(5.4)
    }


def test_after_a_while_without_sight_nothing_is_worth_deciding_by_until_something_is_seen():
    known = estimator(estimator_timeout_s=3.0)
    blinds = [
        known.take(counts(0, 0, main=0.0, side=0.0), shown(second)).is_blind for second in range(6)
    ]
    assert blinds == [False, False, False, True, True, True]
    assert not known.take(counts(0, 1, main=0.0, side=1.0), shown(6)).is_blind
    assert not known.take(counts(0, 0, main=0.0, side=0.0), shown(8)).is_blind
    assert known.take(counts(0, 0, main=0.0, side=0.0), shown(9)).is_blind


def test_an_absurd_time_does_no_lasting_harm():
    known = estimator()
    dark, clear = counts(0, 0, main=0.0, side=0.0), counts(1, 1, main=1.0, side=1.0)
    known.take(clear, shown(0))
    known.take(dark, shown(1 << 31))
    known.take(clear, shown(1))
    assert known.take(dark, shown(2)).vehicles == pytest.approx({"main": 0.6, "side": 1.1})


def test_no_lane_starves_however_long_nobody_sees_it():
    known, green, served = estimator(), MAIN, 0
    for second in range(600):
        dark_side = counts(5, 0, main=1.0, side=0.0)
        estimate = known.take(dark_side, shown(second, green))
        green = max_pressure(
            SIGNAL, dark_side, shown(second, green), "vehicles", "alike", estimate.vehicles
        ).state
        served += green == SIDE
        assert not estimate.is_blind
    assert served > 60


steps = st.lists(
    st.tuples(
        st.integers(-5, 90), st.integers(0, 60), st.floats(0, 1), st.sampled_from([MAIN, SIDE, ""])
    ),
    max_size=30,
)


@given(steps)
def test_numbers_stay_within_what_was_counted_and_what_a_lane_holds(
    stream: list[tuple[int, int, float, str]],
) -> None:
    known, second, most = estimator(), 0, REACH_M / SPACING_M
    for passed, count, share, state in stream:
        second += passed
        estimate = known.take(counts(count, 0, main=share, side=0.0), shown(second, state))
        most = max(most, count / max(share, MIN_COVERAGE))
        assert estimate.vehicles["side"] <= REACH_M / SPACING_M
        if share < MIN_COVERAGE:
            assert count <= estimate.vehicles["main"] <= most


def test_what_is_estimated_may_turn_the_decision_and_is_named():
    found = max_pressure(SIGNAL, counts(4, 0, main=1.0, side=0.0), None, estimated={"side": 6.5})
    assert (found.state, found.pressures, found.unknown) == (SIDE, [4, 6.5], ("side",))
    assert found.policy == "max_pressure"


def test_who_knows_nothing_asks_for_the_plan():
    found = [fallback_plan(SIGNAL, seconds * S, ["main"]) for seconds in (29, 35)]
    assert [(one.state, one.policy, one.unknown) for one in found] == [
        (MAIN, "plan", ("main",)),
        (SIDE, "plan", ("main",)),
    ]


def test_what_was_counted_at_first_stands_until_the_clock_is_known():
    known = estimator()
    first = known.take(counts(0, 0, main=0.0, side=0.0), None)
    assert first.vehicles == {"main": 0, "side": 0}
    after = known.take(counts(0, 0, main=0.0, side=0.0), shown(7, SIDE))
    assert after.vehicles == {"main": 0, "side": 0}


def test_a_lane_without_a_count_is_empty_while_it_is_covered():
    known = estimator()
    silent = counts(0, 0, main=1.0, side=1.0).model_copy(update={"upstream": {}})
    known.take(silent, shown(0, SIDE))
    after = known.take(counts(0, 0, main=0.0, side=0.0), shown(10, SIDE))
    assert after.vehicles == {"main": 1.0, "side": 0}


def test_queues_are_estimated_where_queues_are_weighed():
    known = estimator(weight="queued")
    queued = counts(9, 9, main=1.0, side=1.0).model_copy(
        update={"stationary_upstream": {"main": 2, "side": 3}}
    )
    known.take(queued, shown(0, SIDE))
    after = known.take(counts(0, 0, main=0.0, side=0.0), shown(10, SIDE))
    assert after.vehicles == {"main": 3.0, "side": 0}


def test_estimates_are_worth_nothing_from_exactly_the_timeout_on():
    known = estimator(estimator_timeout_s=20)
    known.take(counts(1, 1, main=1.0, side=1.0), shown(0))
    uncovered = counts(0, 0, main=0.0, side=0.0)
    assert not known.take(uncovered, shown(20 - 1e-9)).is_blind
    assert known.take(uncovered, shown(20)).is_blind


def test_a_permissive_green_lets_vehicles_leave():
    known = estimator()
    known.take(counts(9, 9, main=1.0, side=1.0), shown(0, "ggr"))
    after = known.take(counts(0, 0, main=0.0, side=0.0), shown(10, "ggr"))
    assert after.vehicles == pytest.approx({"main": 5, "side": 10})
