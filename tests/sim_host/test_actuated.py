"""SUMO's own actuated control in the place of requests."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest

from protocol.errors import ConfigError
from protocol.messages import Setup, SignalRequest
from protocol.roadmap import Link, PlanPhase, Signal
from sim_host.cabinet import ActuatedCabinet, loop_parameters, programme
from sim_host.config import CabinetConfig
from sim_host.world import Ground, World


def signal(*greens: str) -> Signal:
    links = [Link(index=i, from_lane=f"in_{i}", to_lane="out") for i in range(len(greens[0]))]
    plan = [PlanPhase(duration_s=30, state=green) for green in greens]
    return Signal(tls="J", links=links, conflicts=[], plan=plan)


def test_between_greens_lie_yellow_and_all_red_with_the_cabinets_times():
    config = CabinetConfig(min_green_s=6, max_green_s=40, yellow_s=3, all_red_s=2)
    found = [(i.state, i.least_s, i.most_s) for i in programme(signal("GGr", "rGG"), config)]
    assert found == [
        ("GGr", 6, 40), ("yGr", 3, 3), ("rGr", 2, 2), ("rGG", 6, 40), ("rGy", 3, 3), ("rGr", 2, 2)
    ]  # fmt: skip


def test_a_link_that_loses_its_right_of_way_is_stopped_and_one_that_gains_it_is_not():
    found = [i.state for i in programme(signal("Ggr", "grG"), CabinetConfig())]
    assert found == ["Ggr", "yyr", "rrr", "grG", "gry", "grr"]


def test_no_interval_lasts_no_time():
    assert len(programme(signal("Gr", "rG"), CabinetConfig(all_red_s=0))) == 4


def test_one_green_leaves_nothing_to_decide():
    with pytest.raises(ConfigError, match="one green only"):
        programme(signal("GG"), CabinetConfig())


def test_greens_cannot_end_before_they_may():
    with pytest.raises(ValueError, match="max_green_s 4 is less than min_green_s 5"):
        CabinetConfig(max_green_s=4)


def test_it_tells_what_sumo_shows_and_what_a_change_leads_to():
    shown = "Gr"
    cabinet = ActuatedCabinet(signal("Gr", "rG"), lambda: shown)
    wanted = SignalRequest(frame=1, sim_time_ns=1, tls="J", state="rG", policy="max_pressure")
    assert cabinet.request(wanted, 2) is None
    spats = []
    for state in ("Gr", "yr", "rr", "rG", "ry"):
        shown = state
        spat = cabinet.spat(1, 2)
        spats.append((spat.state, spat.stage, spat.green))
    assert spats == [
        ("Gr", "green", "Gr"), ("yr", "yellow", "rG"), ("rr", "all_red", "rG"),
        ("rG", "green", "rG"), ("ry", "yellow", "Gr"),
    ]  # fmt: skip


def test_before_the_first_green_it_tells_the_plans_second():
    cabinet = ActuatedCabinet(signal("Grr", "rGr", "rrG"), lambda: "rrr")
    spat = cabinet.spat(1, 2)
    assert (spat.stage, spat.green) == ("all_red", "rGr")
    assert cabinet.refusals == {}


@pytest.mark.parametrize("key", ["max_gap_s", "detector_gap_s"])
def test_a_short_gap_ends_greens_early(setup: Setup, run_dir: Path, flat: Ground, key: str) -> None:
    def changes(config: CabinetConfig) -> int:
        world = World(setup, run_dir, flat)
        world.start(1)
        try:
            junction = setup.road_map.intersections[0].signal
            world.run_actuated("J", programme(junction, config), loop_parameters(config))
            shown = []
            for _ in range(3000):
                world.step()
                shown.append(world.shown("J"))
        finally:
            world.close()
        return sum(one != other for one, other in pairwise(shown))

    short, long = (changes(CabinetConfig(**{key: gap_s})) for gap_s in (0.5, 6))
    assert short > long
