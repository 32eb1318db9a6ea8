"""People at crossings."""

from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from protocol.messages import PEDESTRIAN, ObjectClass, Setup, is_bystander
from sensing.road import RoadArea
from sim_host.crossings import Crossing, crossings_of
from sim_host.networks import write_grid
from sim_host.pedestrians import Pedestrians
from sim_host.setup import build_setup, traffic_config
from sim_host.world import Ground, TrafficState, World

STEPS = 1500


def busy(folder: Path, **traffic: Any) -> Setup:
    return build_setup({"traffic": {"pedestrians_per_hour": 300, **traffic}}, folder)


def play(folder: Path, ground: Ground, setup: Setup, steps: int = STEPS) -> list[TrafficState]:
    world = World(setup, folder, ground)
    world.start(1)
    try:
        states = []
        for _ in range(steps):
            world.step()
            states.append(world.bodies())
        return states
    finally:
        world.close()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("run")


@pytest.fixture(scope="module")
def crowd(folder: Path) -> Setup:
    return busy(folder)


@pytest.fixture(scope="module")
def states(folder: Path, crowd: Setup, flat: Ground) -> list[TrafficState]:
    return play(folder, flat, crowd)


def people(state: TrafficState) -> list[int]:
    return [n for n, name in enumerate(state.ids) if name.startswith(PEDESTRIAN)]


def test_each_arm_has_a_crossing_from_kerb_to_kerb(crowd: Setup, tmp_path: Path) -> None:
    def check(found: list[Crossing], area: RoadArea) -> None:
        for one in found:
            assert area.clearance_m(one.ends).min() > 0.4
            assert abs((one.ends[1] - one.ends[0]) @ one.outward) < 1e-6
            assert one.zones[0].begin_m == 0
            assert one.zones[-1].end_m == pytest.approx(one.length_m, abs=0.05)
            assert all(a.end_m == b.begin_m for a, b in pairwise(one.zones))

    found = crossings_of(crowd.road_map)
    assert len(found) == 3
    check(found, RoadArea(crowd.road_map))
    assert sorted(len(one.zones) for one in found)[-1] == 2
    net = write_grid(tmp_path, size=2)
    grid = build_setup({"traffic": {"net": str(net)}, "junctions": "all"}, tmp_path)
    found = crossings_of(grid.road_map)
    assert len(found) == 16
    check(found, RoadArea(grid.road_map))
    assert {
        conflict.is_turning for one in found for z in one.zones for conflict in z.conflicts
    } == {
        True,
        False,
    }


def test_people_are_no_vehicles_and_on_no_lane(crowd: Setup, states: list[TrafficState]) -> None:
    kinds = {kind.name: kind.object_class for kind in crowd.vehicle_types}
    assert max(len(people(state)) for state in states) > 8
    for state in states[::100]:
        for n, name in enumerate(state.ids):
            walks = kinds[state.types[n]] == ObjectClass.PEDESTRIAN
            assert walks == is_bystander(name) == (state.lanes[n] == "")


def test_nobody_walks_into_a_moving_vehicle(crowd: Setup, states: list[TrafficState]) -> None:
    sizes = {kind.name: (kind.length_m, kind.width_m) for kind in crowd.vehicle_types}
    for state in states:
        here = people(state)
        drives = [n for n in range(len(state.ids)) if n not in here and state.speeds_mps[n] > 0.3]
        if not here or not drives:
            continue
        offset = state.poses[here, None, :2] - state.poses[None, drives, :2]
        cos, sin = np.cos(state.poses[drives, 5]), np.sin(state.poses[drives, 5])
        half = np.array([sizes[state.types[n]] for n in drives]) / 2
        along_m = np.abs(offset[..., 0] * cos + offset[..., 1] * sin) - half[:, 0]
        aside_m = np.abs(offset[..., 1] * cos - offset[..., 0] * sin) - half[:, 1]
        assert not ((along_m < 0) & (aside_m < 0)).any()


def test_people_get_over_the_road_at_walking_speed(states: list[TrafficState]) -> None:
    crossed = 0
    ways: dict[str, list[np.ndarray]] = {}
    for state in states:
        for n in people(state):
            ways.setdefault(state.ids[n], []).append(state.poses[n, :2])
    for way in ways.values():
        places = np.array(way)
        step_m = np.hypot(*np.diff(places, axis=0).T)
        assert step_m.max(initial=0) < 0.21  # 2 m/s at most
        crossed += bool((places[:, 1] > 14).any() and (places[:, 1] < -14).any())
    assert crossed > 5


def test_the_seed_decides_on_everybody(
    folder: Path, crowd: Setup, states: list[TrafficState], flat: Ground
) -> None:
    again = play(folder, flat, crowd, 400)[-1]
    assert again.ids == states[399].ids
    np.testing.assert_array_equal(again.poses, states[399].poses)


def test_drivers_stop_for_people_and_go_on(states: list[TrafficState]) -> None:
    finished = {name for name in states[300].ids if not is_bystander(name)} - set(states[-1].ids)
    assert len(finished) > 30


PERSONS = """<routes><person id="walker" depart="0" departPos="10">
<walk edges="north_in" speed="1.0"/></person>
<person id="later" depart="1e6"><walk edges="north_in"/></person></routes>"""


def test_persons_of_a_users_own_demand_are_bodies(
    folder: Path, tmp_path: Path, flat: Ground
) -> None:
    (tmp_path / "own.rou.xml").write_text(PERSONS)
    net = folder / "sumo" / "t_junction.net.xml"
    (tmp_path / "own.sumocfg").write_text(
        f'<configuration><input><net-file value="{net}"/>'
        '<route-files value="own.rou.xml"/></input></configuration>'
    )
    setup = build_setup({"traffic": {"sumocfg": str(tmp_path / "own.sumocfg")}}, tmp_path)
    states = play(tmp_path, flat, setup, 50)
    assert states[-1].ids == ["pedestrian~sumo.walker"]
    assert states[-1].types == ["DEFAULT_PEDTYPE"]
    assert states[-1].poses[0, 1] < states[20].poses[0, 1]  # towards the junction
    assert states[-1].speeds_mps[0] == pytest.approx(1.0, abs=0.3)


def test_people_do_not_all_come_at_once_where_the_clock_begins_late(crowd: Setup) -> None:
    people = Pedestrians(crowd, traffic_config(crowd.scenario), 1, SimpleNamespace(vehicle=None))
    people.step(8 * 3600.0)
    assert people.people().ids == []
