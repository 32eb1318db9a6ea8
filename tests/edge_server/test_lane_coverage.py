"""Sensor coverage: how much of each lane lies within the range of a LiDAR."""

from __future__ import annotations

import numpy as np
import pytest

from edge_server.coverage import Covered, LaneCoverage, SensorViews
from protocol.approaches import Approaches
from protocol.roadmap import RoadMap
from tests.roads import lane, one_junction, signal, straight_road


def around(road: RoadMap) -> Approaches:
    return Approaches(road, road.intersections[0])


def at(*places: tuple[float, float]) -> SensorViews:
    return SensorViews.of(np.array(places, np.float64).reshape(-1, 2))


@pytest.fixture
def sight() -> LaneCoverage:
    road = straight_road()
    return LaneCoverage(road, around(road), upstream_m=100, downstream_m=100)


def test_a_sensor_at_the_stop_bar_sees_as_far_as_it_is_trusted(sight):
    found = sight.shares(at((0, 0)), 50.0)
    assert found.upstream == {"in": pytest.approx(0.45, abs=0.03)}  # the stop bar lies at -5 m
    assert found.downstream == {"out": pytest.approx(0.5, abs=0.06)}
    assert found.from_bar == found.upstream


def test_where_no_lane_leads_to_a_signal_none_has_a_share():
    ground = one_junction(
        name="open", centre=(0, 0, 0), lanes=[lane("a", [(0, 0, 0), (9, 0, 0)])],
        signal=signal("j"), junction=[],
    )  # fmt: skip
    seen = LaneCoverage(ground, around(ground), upstream_m=100, downstream_m=100)
    assert seen.shares(at((0, 0)), 50.0) == Covered({}, {}, {})


def test_nobody_sees_nothing(sight):
    assert sight.shares(at(), 50.0) == Covered({"in": 0.0}, {"out": 0.0}, {"in": 0.0})


def test_a_lane_is_seen_from_its_stop_bar_on_as_far_as_there_is_no_gap(sight):
    far_m, near_m = (-80.0, 0.0), (0.0, 0.0)  # of the lane, 5 to 105 m before the bar
    assert sight.shares(at(far_m), 20.0) == Covered({"in": 0.4}, {"out": 0.0}, {"in": 0.0})
    both = sight.shares(at(far_m, near_m), 20.0)
    assert both.upstream == {"in": 0.52}
    assert both.from_bar == {"in": 0.12}
    assert sight.shares(at(near_m), 20.0).upstream == both.from_bar
    whole = sight.shares(at(far_m, near_m, (-40.0, 0.0)), 26.0)
    assert whole.from_bar == whole.upstream == {"in": 1.0}


def test_where_two_lanes_lead_to_one_a_gap_in_either_counts():
    lanes = [
        lane("in", [(-40, 0, 0), (0, 0, 0)], "out", length_m=40),
        lane("a", [(-80, 0, 0), (-40, 0, 0)], "in", length_m=40),
        lane("b", [(-40, 40, 0), (-40, 0, 0)], "in", length_m=40),
        lane("out", [(0, 0, 0), (100, 0, 0)]),
    ]
    road = one_junction(
        name="fork", centre=(0, 0, 0), lanes=lanes, signal=signal("j", ("in", "out")), junction=[]
    )
    seen = LaneCoverage(road, around(road), upstream_m=80, downstream_m=100)
    found = seen.shares(at((-20.0, 0.0), (-60.0, 0.0)), 21.0)
    assert found.upstream == {"in": 0.733}  # 10 + 10 + 2 of 30
    assert found.from_bar == {"in": pytest.approx(0.5, abs=0.04)}  # up to 8 m behind the fork


def test_two_who_see_the_same_see_no_more(sight):
    one = sight.shares(at((0, 0)), 50.0)
    assert sight.shares(at((0, 0), (0, 0)), 50.0) == one


def test_each_adds_what_the_others_do_not_see(sight):
    found = sight.shares(at((0.0, 0.0), (-100.0, 0.0)), 50.0)
    assert found.upstream == {"in": 1.0}


def test_more_trust_never_sees_less(sight):
    found = [sight.shares(at((-30.0, 5.0)), m).upstream["in"] for m in (1, 10, 30, 60, 200)]
    assert found == sorted(found)
    assert found[-1] == 1.0


def test_the_share_is_that_of_places_every_4_m_whose_distance_is_within_range(sight):
    found = sight.shares(at((-53.0, 30.0)), 50.0)  # as far as 40 m along the lane
    assert found.upstream == {"in": 0.84}  # 21 of 25, both ends included
    found = sight.shares(at((45.0, -30.0)), 50.0)
    assert found.downstream == {"out": 0.8}  # 20 of 25


def test_shares_have_three_digits_and_a_lane_without_a_place_has_none():
    road = straight_road()
    lanes = around(road)
    short = LaneCoverage(road, lanes, upstream_m=12, downstream_m=100)
    assert short.shares(at((-9.0, 0.0)), 1.0).upstream == {"in": 0.333}
    none = LaneCoverage(road, lanes, upstream_m=0.5, downstream_m=100)
    assert none.shares(at((0.0, 0.0)), 200.0) == Covered({}, {"out": 1.0}, {})
    none_behind = LaneCoverage(road, lanes, upstream_m=12, downstream_m=0)
    all_of_it = Covered({"in": 1.0}, {}, {"in": 1.0})
    assert none_behind.shares(at((0.0, 0.0)), 200.0) == all_of_it


def test_places_follow_a_lane_around_a_bend_and_sensors_see_their_own_side():
    bent = lane("in", [(-60, 48, 0), (-60, 0, 0), (0, 0, 0)], "out", length_m=108)
    road = one_junction(
        name="bent", centre=(0, 0, 0), lanes=[bent, lane("out", [(0, 0, 0), (100, 0, 0)])],
        signal=signal("j", ("in", "out")), junction=[],
    )  # fmt: skip
    seen = LaneCoverage(road, around(road), upstream_m=108, downstream_m=100)
    assert seen.shares(at((-60.0, 48.0)), 24.0).upstream == {"in": 0.222}  # 6 of 27
    assert seen.shares(at((-60.0, -48.0)), 24.0).upstream == {"in": 0.0}
    assert seen.shares(at((0.0, 0.0)), 24.0).upstream == {"in": 0.222}


def test_places_lie_where_the_lane_does_whatever_length_its_net_states():
    found = []
    for length_m in (50, 100, 200):
        stated = lane("in", [(-100, 0, 0), (0, 0, 0)], "out", length_m=length_m)
        road = one_junction(
            name="stated", centre=(0, 0, 0), lanes=[stated, lane("out", [(0, 0, 0), (100, 0, 0)])],
            signal=signal("j", ("in", "out")), junction=[],
        )  # fmt: skip
        seen = LaneCoverage(road, around(road), upstream_m=100, downstream_m=100)
        found.append(seen.shares(at((0, 0)), 50.0))
    assert found[0] == found[1] == found[2]
    assert found[0].from_bar == {"in": 0.52}


def test_of_an_agent_that_sent_its_own_part_alone_no_other_place_is_known(sight):
    part = np.array([(-30.0, -50.0), (20.0, -50.0), (20.0, 50.0), (-30.0, 50.0)])
    all_of_it = sight.shares(at((0, 0)), 60.0)
    sent = sight.shares(SensorViews.of(np.zeros((1, 2)), [part]), 60.0)
    assert sent.upstream == sent.from_bar == {"in": 0.24}  # 6 of 25: up to 30 m, from 5 m on
    assert sent.downstream == {"out": 0.24}
    assert sight.shares(SensorViews.of(np.zeros((1, 2)), [np.zeros((0, 2))]), 60.0) == sight.shares(
        at(), 60.0
    )
    mixed = SensorViews.of(np.zeros((1, 2)), [part]).and_whole(np.zeros((1, 2)))
    assert sight.shares(mixed, 60.0) == all_of_it
