"""`cpnet bench control`: baselines, and runs on SUMO alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from protocol.approaches import Approaches
from protocol.errors import ConfigError
from protocol.roadmap import RoadMap
from signal_controller.observation import CabinetTimes, LaneVehicles, Observation
from sim_host.cabinet import SignalCabinet, programme
from sim_host.config import CabinetConfig
from studies.bench_control import measure_control, run_case
from studies.control_baselines import COMPATIBLE, WeightedPressure, webster_signal
from studies.control_case import PROGRAM, ControlCase, roads_of
from studies.control_run import ControlRun, TruePositions
from tests.signal_controller.crossing import LANES, PHASES, SIGNAL, SITE, S, counts, green, vehicles

TIMES = CabinetTimes()


def greens_s(flows_vph: dict[str, float]) -> dict[str, float]:
    plan = webster_signal(SIGNAL, flows_vph, 1900, TIMES).plan
    return {phase.state: phase.duration_s for phase in plan if phase.is_green}


def test_websters_greens_are_in_the_ratio_of_the_critical_flows() -> None:
    found = greens_s({"n_0": 300, "s_0": 600, "e_0": 300, "w_0": 100})
    assert found[PHASES[0]] > found[PHASES[2]] >= TIMES.min_green_s
    assert min(found.values()) == TIMES.min_green_s


def test_websters_cycle_grows_with_the_load_up_to_its_bound() -> None:
    light, heavy = (
        sum(
            p.duration_s
            for p in webster_signal(SIGNAL, dict.fromkeys(LANES, vph), 1900, TIMES).plan
        )
        for vph in (50, 700)
    )
    assert light < heavy <= 130


def test_websters_plan_is_one_that_the_cabinet_can_show() -> None:
    SignalCabinet(webster_signal(SIGNAL, {}, 1900, TIMES), CabinetConfig())


@pytest.mark.parametrize("kind", ["position", "delay"])
def test_weighted_pressures_choose_where_the_nearest_or_longest_waiting_are(kind: str) -> None:
    policy = WeightedPressure(SITE, kind, 100)
    far = [("n_0", 180.0, 10.0), ("n_0", 190.0, 10.0)]
    found = vehicles(*far, ("e_0", 2.0, 0.0))
    for second in range(3):
        state = green(PHASES[0], second * S)
        decision = policy.decide(Observation(counts(second, second * S), state, found))
    assert decision.state in (PHASES[2], PHASES[6])


def test_a_net_that_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError, match="must be moving_peak, t_junction, .* town, a .sumocfg or a folder"
    ):
        run_case(ControlCase(str(tmp_path), "predictive"))


@pytest.mark.slow
def test_runs_repeat_exactly_and_count_every_vehicle() -> None:
    cases = [ControlCase("t_junction", policy, duration_s=90) for policy in ("predictive",) * 2]
    first, second = measure_control([*cases])
    stable = [name for name in first.as_json() if not name.startswith("decide")]
    assert [first.as_json()[n] for n in stable] == [second.as_json()[n] for n in stable]
    assert first.vehicles > first.arrived > 0
    assert 0 < first.delay_s < 60


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["plan", "webster", "actuated", "delay_based", "delay_pressure"])
def test_each_baseline_runs(policy: str) -> None:
    (row,) = measure_control([ControlCase("t_junction", policy, duration_s=90)])
    assert row.arrived > 20
    assert row.waited_s < 90


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["max_pressure", "max_wave"])
def test_pressures_may_choose_compatible_phases(policy: str, tmp_path: Path) -> None:
    case = ControlCase("t_junction", policy, duration_s=90, settings=COMPATIBLE)
    run = ControlRun(case, tmp_path)
    [one] = run._road_map.intersections
    shown = set()
    step = run._step
    run._step = lambda time_s: (
        shown.add(run._sumo.trafficlight.getRedYellowGreenState(one.tls)),
        step(time_s),
    )
    assert run.row().arrived > 20
    assert {*one.signal.further_greens} <= shown
    assert one.signal.further_greens


def test_only_predictive_control_has_compatible_phases_of_itself(tmp_path: Path) -> None:
    for policy, added in (("predictive", 1), ("max_pressure", 0), ("webster", 0)):
        _, roads = roads_of(ControlCase("t_junction", policy), tmp_path)
        assert len(roads.intersections[0].signal.further_greens) == added


class Lights:
    """The one signal of SUMO, which shows the states of a plan in turn."""

    def __init__(self, states: list[str]) -> None:
        self.states, self.chosen = iter(states), []

    def getRedYellowGreenState(self, tls: str) -> str:
        return next(self.states)

    def setProgram(self, tls: str, program: str) -> None:
        self.chosen.append(program)

    def setPhase(self, tls: str, phase: int) -> None:
        self.chosen.append(phase)

    def getAllProgramLogics(self, tls: str) -> list[SimpleNamespace]:
        phases = [SimpleNamespace(state=one.state) for one in programme(SIGNAL, CabinetConfig())]
        return [SimpleNamespace(programID=PROGRAM, phases=phases)]


def test_sumos_control_takes_over_from_a_green_and_goes_on_from_it(tmp_path: Path) -> None:
    run = ControlRun(ControlCase("t_junction", "actuated"), tmp_path)
    lights = Lights(["y" * len(PHASES[2]), PHASES[2]])
    run._sumo = SimpleNamespace(trafficlight=lights)
    assert not run._take_over(SIGNAL)
    assert lights.chosen == []
    assert run._take_over(SIGNAL)
    states = [one.state for one in programme(SIGNAL, CabinetConfig())]
    assert lights.chosen == [PROGRAM, states.index(PHASES[2])]


CORRIDOR = ControlCase("corridor", "position_pressure")


def link_of(roads: RoadMap) -> tuple[str, float, float]:
    """Returns a lane from A0 to B0, and the distances of its start to B0's and to A0's bar."""
    outgoing = roads.by_tls["A0"].outgoing
    link = next(name for name in outgoing if roads.by_id[name].tls == "B0")
    ahead, behind = (Approaches(roads, roads.by_tls[tls]) for tls in ("B0", "A0"))
    return link, ahead.upstream[link].start_m, behind.downstream[link].start_m


def test_a_vehicle_on_the_way_to_the_next_signal_weighs_less_the_farther_it_is(
    tmp_path: Path,
) -> None:
    _, roads = roads_of(CORRIDOR, tmp_path)
    site = replace(SITE, signal=roads.by_tls["A0"].signal, road_map=roads)
    link, to_bar_m, from_bar_m = link_of(roads)
    weights = []
    for behind_m in (40.0, 60.0, 90.0, 120.0):
        distance_m = to_bar_m - (behind_m + from_bar_m)
        policy = WeightedPressure(site, "position", 100)
        found = LaneVehicles([link], np.array([distance_m]), np.zeros(1), np.array([4.5]), ["a"])
        state = green(site.signal.greens[0], 0)
        pressures = policy.decide(Observation(counts(0, 0), state, found)).pressures
        weights.append(-min(pressures))
    assert weights == pytest.approx([weights[0] * part for part in (1, 2 / 3, 1 / 6, 0)])
    assert weights[0] > 0


def test_all_are_known_that_are_within_reach_of_either_signal(tmp_path: Path) -> None:
    _, roads = roads_of(CORRIDOR, tmp_path)
    link, to_bar_m, from_bar_m = link_of(roads)
    along_m = {"left A0": from_bar_m + 45, "between": from_bar_m + 60, "near B0": to_bar_m - 90}
    sumo = SimpleNamespace(
        getIDList=lambda: [*along_m],
        getLaneID=lambda _: link,
        getLanePosition=lambda name: along_m[name],
        getSpeed=lambda _: 5.0,
        getLength=lambda _: 4.5,
    )
    truth = TruePositions(roads, replace(CORRIDOR, upstream_m=100.0, downstream_m=50.0))
    truth.read(SimpleNamespace(vehicle=sumo))
    assert truth.vehicles.ids == ["left A0", "near B0"]
    assert truth.vehicles.distances_m == pytest.approx([to_bar_m - from_bar_m - 45, 90])
