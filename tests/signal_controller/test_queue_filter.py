"""Queue filter: a few vehicles that report themselves are evidence of those that do not."""

from __future__ import annotations

from dataclasses import replace
from itertools import count

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from signal_controller.observation import LaneVehicles
from signal_controller.predictive_model import JunctionModel
from signal_controller.queue_filter import QueueFilter, shortest_interval
from tests.signal_controller.crossing import LANES, SITE, vehicles

MODEL = JunctionModel(SITE, 7)
LANE = MODEL.lane_index["n_0"]
RED = np.zeros((len(LANES), 2))
GREEN = np.array([[1.0, 0.0]] * len(LANES))
NOBODY: dict[str, float] = {}  # is covered


def take(known: QueueFilter, second: float, *rows, shares=RED, coverage=NOBODY) -> None:
    known.take(second, vehicles(*rows), shares, coverage)


def test_at_red_an_unseen_queue_grows_by_the_expected_inflow_and_its_interval_widens() -> None:
    known = QueueFilter(MODEL, 360, 1900)
    take(known, 0)
    for second in range(1, 31):
        take(known, second)
    early = known.queue(LANE)
    for second in range(31, 91):
        take(known, second)
    late = known.queue(LANE)
    assert 1.5 < early.mean < 4
    assert late.mean > 2 * early.mean
    assert late.high - late.low > early.high - early.low


def test_who_stops_tells_how_many_stand_before_him() -> None:
    known = QueueFilter(MODEL, 360, 1900)
    take(known, 0)
    for second in range(1, 21):
        take(known, second)
    take(known, 21, ("n_0", 28.0, 0.0))
    assert 4 < known.queue(LANE).mean < 6
    assert known.queue(MODEL.lane_index["e_0"]).mean < 3


def test_who_passes_the_stop_bar_leaves_only_those_behind_him() -> None:
    known = QueueFilter(MODEL, 360, 1900)
    take(known, 0)
    take(known, 1, ("n_0", 63.0, 0.0))
    take(known, 2, ("n_0", 2.0, 5.0), shares=GREEN)
    take(known, 3, ("outs_0", -20.0, 8.0), shares=GREEN)
    assert known.queue(LANE).mean < 2


def test_a_queue_that_is_seen_is_known_exactly_and_one_that_fills_what_is_seen_is_not() -> None:
    known = QueueFilter(MODEL, 360, 1900)
    seen = dict.fromkeys(LANES, 1.0)
    queue = [("n_0", 3 + 7.0 * n, 0.0) for n in range(7)]
    take(known, 0, *queue, coverage=seen)
    assert (known.queue(LANE).low, known.queue(LANE).high) == (7, 7)
    for second in range(1, 40):
        take(known, second, *queue, coverage=dict.fromkeys(LANES, 0.25))
    assert known.queue(LANE).mean > 7.5


def test_where_all_report_themselves_nobody_else_is_expected() -> None:
    known = QueueFilter(MODEL, 500, 1900)
    before = known.reporting
    for second in range(60):
        rows = [(lane, 3 + 7.0 * n, 0.0) for lane in LANES for n in range(second // 6)]
        take(known, second, *rows)
    assert known.reporting > 0.9 > before


class Traffic:
    """Vehicles that come at random on all lanes, queue at red, and report themselves or not."""

    def __init__(self, rate_vph: float, reporting: float, seed: int) -> None:
        self._rng, self._names = np.random.default_rng(seed), count()
        self._rate_per_s, self._reporting = rate_vph / 3600, reporting
        self._lanes: list[list[list]] = [[] for _ in LANES]  # name, metres to go, reports

    def step(self, second: int, *, is_green: bool) -> LaneVehicles:
        rows = []
        for lane, there in zip(LANES, self._lanes, strict=True):
            if self._rng.random() < self._rate_per_s:
                reports = self._rng.random() < self._reporting
                there.append([f"v{next(self._names)}", 195.0, reports])
            if there and is_green and there[0][1] <= 10.0 and second % 2 == 0:
                there.pop(0)
            for place, one in enumerate(there):
                ahead_m = max(one[1] - 10.0, 7.0 * place)
                if one[2]:
                    rows.append((one[0], lane, ahead_m, one[1] - ahead_m))
                one[1] = ahead_m
        names, lanes, distances_m, speeds_mps = zip(*rows, strict=True) if rows else ((),) * 4
        return LaneVehicles(
            list(lanes), np.array(distances_m, float), np.array(speeds_mps, float),
            np.full(len(rows), 4.5), list(names),
        )  # fmt: skip


def learnt(rate_vph: float, reporting: float, seed: int) -> tuple[float, float]:
    """Returns the share that reports itself and the rate, as known in minutes 3 to 8."""
    known, traffic = QueueFilter(MODEL, 500, 1900), Traffic(rate_vph, reporting, seed)
    shares, rates_vph = [], []
    for second in range(480):
        is_green = second % 60 >= 30
        found = traffic.step(second, is_green=is_green)
        known.take(second, found, GREEN if is_green else RED, NOBODY)
        if second > 120:
            shares.append(known.reporting)
            rates_vph.append(3600 * known.arrivals_per_s.mean())
    return float(np.mean(shares)), float(np.mean(rates_vph))


@pytest.mark.parametrize("reporting", [0.3, 0.6])
@pytest.mark.parametrize("rate_vph", [250, 600])
def test_how_many_report_themselves_is_learnt_with_how_many_come(rate_vph, reporting) -> None:
    found = np.mean([learnt(rate_vph, reporting, seed) for seed in (1, 2, 3)], axis=0)
    assert 0.7 < found[0] / reporting < 1.4
    assert 0.8 < found[1] / rate_vph < 1.3


def test_on_lanes_that_are_seen_it_is_counted_who_reports_himself() -> None:
    known, seen = QueueFilter(MODEL, 500, 1900), dict.fromkeys(LANES, 1.0)
    for number in range(60):
        found = vehicles(("n_0", 4.0, 8.0))
        agent = "cav" if number % 4 == 0 else ""
        found = replace(found, ids=[f"v{number}"], agents=[agent])
        known.take(4.0 * number, found, GREEN, seen)
    assert 0.17 < known.reporting < 0.33


@settings(deadline=None, max_examples=30)
@given(
    st.lists(
        st.lists(
            st.tuples(st.sampled_from(LANES), st.floats(-20, 220), st.floats(0, 30)), max_size=6
        ),
        max_size=8,
    ),
    st.floats(0, 1),
)
def test_whatever_is_reported_probabilities_stay_probabilities(frames, share: float) -> None:
    known = QueueFilter(MODEL, 500, 1900)
    for second, rows in enumerate(frames):
        take(known, second, *rows, coverage=dict.fromkeys(LANES[:3], share))
        for lane in range(len(LANES)):
            queue = known.queue(lane)
            assert 0 <= queue.low <= queue.median <= queue.high <= 60
            assert 0 <= queue.mean <= 60


def test_half_of_the_probability_lies_on_either_side_of_the_median() -> None:
    known = QueueFilter(MODEL, 360, 1900)
    for second in range(40):
        take(known, second)
        numbers = known._reporting_weights @ known._joint[:, LANE].sum(axis=1)
        median = known.queue(LANE).median
        assert numbers[:median].sum() <= 0.5 <= numbers[: median + 1].sum() + 1e-9


@given(st.lists(st.floats(0.001, 1), min_size=1, max_size=20))
def test_an_interval_holds_90_percent_to_within_half_of_what_an_end_holds(weights) -> None:
    chance = np.array(weights) / sum(weights)
    low, high = shortest_interval(chance)
    inside = chance[low : high + 1]
    beside = [*chance[max(0, low - 1) : low], *chance[high + 1 : high + 2]]
    assert inside.sum() >= 0.9 - max(beside, default=0.0) / 2 - 1e-5
    assert len(inside) == 1 or inside.sum() - min(inside[0], inside[-1]) / 2 <= 0.9 + 1e-5


def test_a_likely_number_alone_may_be_the_interval() -> None:
    assert shortest_interval(np.array([0.87, 0.08, 0.05])) == (0, 0)
    assert shortest_interval(np.array([0.05, 0.1, 0.6, 0.2, 0.05])) == (1, 3)


def test_of_a_lane_seen_half_of_the_time_the_same_rate_is_learnt() -> None:
    always, at_times = (QueueFilter(MODEL, 500, 1900) for _ in range(2))
    for second in range(600):
        rows = [] if second % 12 > 2 else [("n_0", 4.0 - second % 12, 8.0)]
        take(always, second, *rows, shares=GREEN, coverage=dict.fromkeys(LANES, 1.0))
        share = 1.0 if second % 120 < 60 else 0.0
        shown = rows if share else []
        take(at_times, second, *shown, shares=GREEN, coverage=dict.fromkeys(LANES, share))
    assert abs(always.arrivals_per_s[LANE] - 1 / 12) < 0.03
    assert abs(at_times.arrivals_per_s[LANE] - 1 / 12) < 0.03
