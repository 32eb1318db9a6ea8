"""Phases beside those of a plan: signal groups that do not conflict."""

from __future__ import annotations

import itertools
import re
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.roadmap import Link, RoadMap, Signal
from signal_controller.config import SignalConfig
from signal_controller.policies import policy_of
from sim_host.compatible_phases import (
    MAX_PHASES,
    compatible_phases,
    wants_compatible_phases,
)
from sim_host.junctions import write_net
from sim_host.netfile import read_net
from sim_host.road_map import road_map as road_map_of
from sim_host.sumo import sumo_home
from tests.roads import lane, no_road, one_junction, signal
from tests.signal_controller.crossing import PHASES, SITE, seen, vehicles

NS, NS_LEFT, EW, EW_LEFT, *ONE_SIDE = PHASES


def of_crossing(*greens: str) -> Signal:
    """The crossing with a plan of these greens alone."""
    plan = [(10, green) for green in greens]
    return SITE.signal.model_copy(update={"plan": signal("j", plan=plan).plan})


def test_a_plan_of_four_phases_gets_those_of_a_dual_ring() -> None:
    found = compatible_phases(of_crossing(NS, NS_LEFT, EW, EW_LEFT), SITE.road_map)
    assert sorted(found) == sorted(ONE_SIDE)


def test_what_the_plan_shows_is_not_added_again() -> None:
    assert compatible_phases(SITE.signal, SITE.road_map) == []


def test_lanes_with_several_turns_get_no_green_for_some_of_them() -> None:
    # Of lane a_1 some go to x, some to y; a_0 and a_1 both lead to x, so all of a is one group.
    links = [("a_0", "x_0"), ("a_1", "x_1"), ("a_1", "y_0"), ("b_0", "y_0"), ("c_0", "z_0")]
    plan = [(10, "GGgGr"), (10, "rrrrG")]
    one = signal("j", *links, conflicts=[(2, 3)], plan=plan)
    names = {name for link in links for name in link}
    roads = one_junction("shared", [lane(name, [(0, 0, 0), (9, 0, 0)]) for name in names], one)
    assert compatible_phases(one, roads) == ["GGGrG", "rrrGG"]


def test_where_people_walk_by_the_plan_nothing_is_added(road_map: RoadMap) -> None:
    [one] = road_map.intersections
    plan = signal("J", plan=[(9, state + "G") for state in one.signal.greens]).plan
    walking = one.signal.model_copy(update={"plan": plan})
    assert compatible_phases(walking, road_map) == []


def test_a_group_that_the_plan_never_opens_stays_closed() -> None:
    one = signal("j", ("a_0", "x_0"), ("b_0", "y_0"), ("c_0", "z_0"), plan=[(9, "Grr"), (9, "rGr")])
    assert compatible_phases(one, no_road()) == ["GGr"]


def free(pairs: int, *conflicts: tuple[int, int]) -> Signal:
    """Links of lanes of their own; an even one conflicts with the next, up to so many pairs."""
    size = 2 * pairs
    links = [(f"in{n}_0", f"out{n}_0") for n in range(size)]
    plan = [(9, "".join("G" if n % 8 == one else "r" for n in range(size))) for one in range(8)]
    both = [(n, n + 1) for n in range(0, size, 2)]
    return signal("j", *links, conflicts=[*both, *conflicts], plan=plan)


def test_of_very_many_phases_those_that_open_most_links_are_kept() -> None:
    one = free(5, (7, 8), (7, 9))
    found = compatible_phases(one, no_road())
    assert len(one.planned_greens) + len(found) == MAX_PHASES
    assert {green.count("G") for green in found} == {5}


def test_however_many_groups_there_are_no_start_waits_for_them() -> None:
    # Without a bound and a pivot, 2**20 sets and more would be made: the test would not end.
    assert len(compatible_phases(free(20), no_road())) == MAX_PHASES - 8
    alone = free(20).model_copy(update={"conflicts": []})
    assert compatible_phases(alone, no_road()) == ["G" * 40]


def test_a_link_that_yields_to_nobody_known_goes_on_yielding() -> None:
    one = signal(
        "j",
        *(("a_0", "x_0"), ("b_0", "y_0"), ("c_0", "z_0")),
        conflicts=[(0, 2)],
        plan=[(9, "Ggr"), (9, "rgG")],
    )
    assert compatible_phases(one, no_road()) == []
    apart = signal("j", *(("a_0", "x_0"), ("b_0", "y_0")), plan=[(9, "Gr"), (9, "rg")])
    assert compatible_phases(apart, no_road()) == ["Gg"]


def test_a_signal_whose_stop_bars_follow_one_another_keeps_to_its_plan() -> None:
    links = [("a_0", "m_0"), ("m_0", "x_0"), ("b_0", "y_0")]
    one = signal("j", *links, plan=[(9, "GGr"), (9, "rrG")])
    assert compatible_phases(one, no_road()) == []


def test_links_that_share_an_index_are_one_group() -> None:
    one = signal("j", ("a_0", "x_0"), ("b_0", "y_0"), ("c_0", "z_0"), plan=[(9, "Grr"), (9, "rGG")])
    links = [*one.links, Link(index=0, from_lane="b_0", to_lane="w_0")]
    assert compatible_phases(one.model_copy(update={"links": links}), no_road()) == []


def test_without_internal_lanes_conflicts_and_phases_are_the_same(tmp_path: Path) -> None:
    options = ["--grid", "--grid.number=2", "-L2", "--grid.attach-length=100"]
    options += ["--default-junction-type=traffic_light", "--tls.left-green.time=6"]
    found = []
    for more in ([], ["--no-internal-links"]):
        net = tmp_path / f"grid{len(found)}.net.xml"
        command = [sumo_home() / "bin" / "netgenerate", *options, *more, f"-o{net}"]
        subprocess.run(command, check=True, capture_output=True)
        roads = road_map_of(read_net(net), "all")
        crossings = [one.signal for one in roads.intersections if len(one.signal.greens) > 1]
        found.append([(one.conflicts, compatible_phases(one, roads)) for one in crossings])
    assert found[0] == found[1]
    assert len([conflicts for conflicts, added in found[0] if conflicts and added]) == 4


def test_links_of_which_a_net_says_nothing_open_only_with_those_of_the_plan(tmp_path: Path) -> None:
    net = tmp_path / "t_junction.net.xml"
    write_net(tmp_path)
    text = net.read_text("utf-8")
    net.write_text(re.sub(r'(intLanes|incLanes)="[^"]*"', r'\1=""', text), encoding="utf-8")
    roads = road_map_of(read_net(net), "all")
    assert compatible_phases(roads.intersections[0].signal, roads) == []


@st.composite
def junctions(draw: st.DrawFn) -> tuple[Signal, RoadMap]:
    """Up to 8 links between few lanes, any conflicts between lanes, one green for each lane."""
    names = st.integers(0, 4)
    pairs = draw(st.lists(st.tuples(names, names), min_size=1, max_size=8, unique=True))
    links = [(f"in{a // 2}_{a % 2}", f"out{b // 2}_{b % 2}") for a, b in pairs]
    apart = [
        (a, b)
        for a, b in itertools.combinations(range(len(links)), 2)
        if not {*links[a]} & {*links[b]}
    ]
    conflicts = draw(st.lists(st.sampled_from(apart), unique=True)) if apart else []
    lanes = sorted({a for a, _ in links})
    plan = [(9, "".join("G" if a == one else "r" for a, _ in links)) for one in lanes]
    one = signal("j", *links, conflicts=conflicts, plan=plan)
    return one, one_junction("any", [lane(a, [(0, 0, 0), (9, 0, 0)]) for a in lanes], one)


@given(junctions())
@settings(max_examples=200, deadline=None)
def test_added_phases_have_no_conflict_and_nothing_could_be_opened_besides(
    drawn: tuple[Signal, RoadMap],
) -> None:
    one, roads = drawn
    added = compatible_phases(one, roads)
    assert len(set(one.greens + added)) == len(one.greens) + len(added)
    for green in added:
        opened = {link for link, letter in enumerate(green) if letter == "G"}
        assert not any(a in opened and b in opened for a, b in one.conflicts)
        lanes = {one.links[link].from_lane for link in opened}
        assert opened == {link.index for link in one.links if link.from_lane in lanes}
    for a, b in itertools.combinations(added, 2):
        merged = "".join("G" if "G" in pair else "r" for pair in zip(a, b, strict=True))
        assert merged not in (a, b)


def requested(policy: str, phases: str, side: str) -> str:
    """What a policy asks for where vehicles wait on both lanes of the north or on two sides."""
    one = of_crossing(NS, NS_LEFT, EW, EW_LEFT)
    if wants_compatible_phases({"policy": policy, "phases": phases}):
        added = compatible_phases(one, SITE.road_map)
        one = one.model_copy(update={"further_greens": added})
    made = policy_of(SignalConfig(policy=policy, phases=phases), replace(SITE, signal=one))
    rows = [(name, 1.0 + 7 * place, 0.0) for name in ("n_0", side) for place in range(6)]
    observed = seen(100, EW, vehicles(*rows))
    waiting = observed.counts.model_copy(update={"upstream": {"n_0": 6, side: 6}})
    return made.decide(replace(observed, counts=waiting)).state


@pytest.mark.parametrize("policy", ["predictive", "max_pressure"])
def test_compatible_phases_are_requested_where_they_serve_more(policy: str) -> None:
    assert requested(policy, "compatible", "n_1") == ONE_SIDE[0]
    assert requested(policy, "compatible", "s_0") == NS


def test_of_itself_max_pressure_keeps_to_the_plan_and_predictive_control_does_not() -> None:
    assert requested("max_pressure", "auto", "n_1") == NS
    assert requested("max_pressure", "plan", "n_1") == NS
    assert requested("predictive", "auto", "n_1") == ONE_SIDE[0]
    assert requested("predictive", "plan", "n_1") == NS
