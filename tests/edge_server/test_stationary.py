"""Who stands still: told from where vehicles were found a second ago."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge_server.stationary import StationaryVehicles

S = 1_000_000_000


def at(*x_m: float) -> np.ndarray:
    return np.array([(x, 0.0) for x in x_m]).reshape(-1, 2)


@pytest.mark.parametrize("period_ns", [S // 10, S])
def test_the_slow_stand_and_the_fast_do_not(period_ns):
    standing = StationaryVehicles(1.4)
    for k in range(2 * S // period_ns + 1):
        t_s = k * period_ns / S
        marked = standing.mark(k * period_ns, at(0.0, 20 + 1.0 * t_s, 50 + 3.0 * t_s))
        assert marked.tolist() == [t_s >= 1 - 1e-9 or t_s >= 0.9] * 2 + [False]


def test_nobody_stands_who_was_not_seen_before():
    standing = StationaryVehicles(1.4)
    assert not standing.mark(0, at(0.0)).any()
    assert standing.mark(S, at(0.0, 9.0)).tolist() == [True, False]


def test_a_gap_in_time_forgets():
    standing = StationaryVehicles(1.4)
    standing.mark(0, at(0.0))
    assert not standing.mark(3 * S, at(0.0)).any()


def test_time_that_goes_back_begins_anew():
    standing = StationaryVehicles(1.4)
    standing.mark(5 * S, at(0.0))
    assert not standing.mark(S, at(0.0)).any()
    assert standing.mark(2 * S, at(0.0)).all()


@given(st.lists(st.lists(st.floats(-100, 100), max_size=6), max_size=8))
def test_the_mark_has_the_length_of_what_was_given(frames):
    standing = StationaryVehicles(1.4)
    for k, x_m in enumerate(frames):
        assert standing.mark(k * S, at(*x_m)).shape == (len(x_m),)


@pytest.mark.parametrize(("apart_m", "is_stationary"), [(1.3, True), (1.3001, False)])
def test_the_limit_is_the_way_at_the_limiting_speed_and_a_boxs_jitter(apart_m, is_stationary):
    vehicles = StationaryVehicles(1.0)
    vehicles.mark(0, at(0.0))
    assert vehicles.mark(S, at(apart_m)).tolist() == [is_stationary]


@pytest.mark.parametrize(("age_ns", "is_known"), [(2_100_000_000, True), (2_100_000_001, False)])
def test_a_frame_is_remembered_for_2_1_s(age_ns, is_known):
    vehicles = StationaryVehicles(1.4)
    vehicles.mark(0, at(0.0))
    assert vehicles.mark(age_ns, at(0.0)).tolist() == [is_known]


@pytest.mark.parametrize(("age_ns", "is_old"), [(900_000_000, True), (899_999_999, False)])
def test_a_frame_less_than_0_9_s_old_says_nothing(age_ns, is_old):
    vehicles = StationaryVehicles(1.4)
    vehicles.mark(0, at(0.0))
    vehicles.mark(1, at())  # does not push out the frame before it
    assert vehicles.mark(age_ns, at(0.0)).tolist() == [is_old]


def test_without_an_earlier_frame_the_marks_are_booleans_too():
    assert StationaryVehicles(1.4).mark(0, at(0.0, 1.0)).dtype == np.bool_
