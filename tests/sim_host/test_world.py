"""The world that SUMO simulates, on the built-in junction."""

import gzip
from pathlib import Path

import numpy as np
import pytest

from protocol.errors import ConfigError
from protocol.messages import Equipment, Setup
from sim_host.setup import build_setup
from sim_host.world import Ground, TrafficState, World

MAIN, SIDE = "rrrrrGGGGGGGG", "GGGGGrrrrrrrr"


def play(setup: Setup, run_dir: Path, ground: Ground, seed: int, steps: int) -> TrafficState:
    world = World(setup, run_dir, ground)
    world.start(seed)
    try:
        world.set_signal("J", MAIN)
        for _ in range(steps):
            world.step()
        assert world.time_ns == steps * 100_000_000
        return world.bodies()
    finally:
        world.close()


def test_one_seed_gives_one_traffic(setup: Setup, run_dir: Path, flat: Ground) -> None:
    one, same, other = (play(setup, run_dir, flat, seed, 400) for seed in (1, 1, 2))
    assert len(one.ids) > 20
    assert (one.ids, one.lanes) == (same.ids, same.lanes)
    np.testing.assert_array_equal(one.poses, same.poses)
    np.testing.assert_array_equal(one.equipment, same.equipment)
    assert one.ids != other.ids
    assert one.ids == sorted(one.ids)
    assert set(one.equipment.tolist()) == set(Equipment)


def test_poses_are_of_footprint_centres_on_their_lanes(
    setup: Setup, run_dir: Path, flat: Ground
) -> None:
    bodies = play(setup, run_dir, flat, 1, 400)
    length_m = {kind.name: kind.length_m for kind in setup.vehicle_types}
    checked = 0
    for index, lane_id in enumerate(bodies.lanes):
        if lane_id.startswith("west_in"):  # straight, heading east, from -212 on
            x, y, *_, yaw = bodies.poses[index]
            front_m = bodies.lane_positions_m[index] + setup.road_map.by_id[lane_id].points[0, 0]
            assert x == pytest.approx(front_m - length_m[bodies.types[index]] / 2, abs=0.01)
            assert yaw == pytest.approx(0, abs=0.15)
            assert abs(y - setup.road_map.by_id[lane_id].points[0, 1]) < 3.6
            checked += 1
    assert checked > 3


def test_journeys_end_with_their_time_loss(setup: Setup, run_dir: Path, flat: Ground) -> None:
    world = World(setup, run_dir, flat)
    world.start(1)
    try:
        trips, seen = [], set()
        for step in range(1200):
            world.set_signal("J", MAIN if step < 600 else SIDE)
            world.step()
            seen |= set(world.bodies().ids)
            trips += world.take_trips()
        assert len(trips) == world.counts.finished > 40
        assert {trip.vehicle for trip in trips} <= seen
        assert world.counts.inserted == len(trips) + len(world.unfinished_trips())
        assert world.counts.teleported == 0
        assert all(trip.arrive_s and 0 <= trip.depart_s < trip.arrive_s for trip in trips)
        waited = [t.time_loss_s for t in trips if t.vehicle.startswith("north")]
        passed = [t.time_loss_s for t in trips if not t.vehicle.startswith("north")]
        assert np.mean(waited) > np.mean(passed) + 5
        assert all(trip.arrive_s is None for trip in world.unfinished_trips())
        assert np.mean([trip.stops > 0 for trip in trips if trip.time_loss_s > 10]) > 0.5
        assert {trip.stops for trip in trips if trip.time_loss_s < 4} == {0}
        assert all(10 < trip.co2_g < 2000 for trip in trips)
    finally:
        world.close()


def test_nobody_passes_a_red_light(setup: Setup, run_dir: Path, flat: Ground) -> None:
    bodies = play(setup, run_dir, flat, 3, 600)
    assert [lane for lane in bodies.lanes if lane.startswith("north_in")]
    assert not [lane for lane in bodies.lanes if lane.startswith((":J_0", ":J_1"))]


def test_a_world_whose_files_are_elsewhere_says_so(
    setup: Setup, tmp_path: Path, flat: Ground
) -> None:
    with pytest.raises(ConfigError, match=r"world\.sumocfg is missing"):
        World(setup, tmp_path, flat).start(1)


def user_files(run_dir: Path, folder: Path, vehicles: str) -> dict[str, object]:
    """Writes a sumocfg with a demand of its own over the built-in net."""
    (folder / "own.rou.xml").write_text(f"<routes>{vehicles}</routes>")
    net = run_dir / "sumo" / "t_junction.net.xml"
    (folder / "own.sumocfg").write_text(
        f'<configuration><input><net-file value="{net}"/>'
        '<route-files value="own.rou.xml"/></input><time><begin value="100"/></time>'
        "</configuration>"
    )
    return {"traffic": {"sumocfg": str(folder / "own.sumocfg"), "cav_rate": 1.0}}


def test_a_users_own_sumocfg_runs_with_its_types(
    setup: Setup, run_dir: Path, tmp_path: Path, flat: Ground
) -> None:
    assert setup.road_map.intersections[0].signal.tls == "J"
    vehicles = """
        <vType id="line5" vClass="bus"/><vType id="bike" vClass="bicycle"/>
        <vehicle id="b/1" type="line5" depart="100"><route edges="west_in east_out"/></vehicle>
        <vehicle id="c" type="bike" depart="100"><route edges="east_in west_out"/></vehicle>
        <vehicle id="d" depart="100"><route edges="north_in west_out"/></vehicle>"""
    own = build_setup(user_files(run_dir, tmp_path, vehicles), tmp_path / "run")
    world = World(own, tmp_path / "run", flat)
    world.start(1)
    try:
        assert world.time_ns == 100_000_000_000
        for _ in range(20):
            world.step()
        bodies = world.bodies()
    finally:
        world.close()
    assert [name.split("~")[0] for name in bodies.ids] == ["b_1", "c", "d"]
    assert bodies.types == ["line5", "bike", "DEFAULT_VEHTYPE"]
    assert bodies.equipment.tolist() == [Equipment.CAV, Equipment.NONE, Equipment.CAV]


def test_routes_alone_run_on_a_net_and_begin_with_their_first_vehicle(
    setup: Setup, run_dir: Path, tmp_path: Path, flat: Ground
) -> None:
    assert setup.road_map.intersections[0].signal.tls == "J"
    routes = tmp_path / "own.rou.xml"
    routes.write_text(
        '<routes><vType id="line5" vClass="bus"/>'
        '<vehicle id="b" type="line5" depart="25200.50"><route edges="west_in east_out"/></vehicle>'
        '<flow id="f" begin="25201" end="25300" number="9" from="east_in" to="west_out"/></routes>'
    )
    net = run_dir / "sumo" / "t_junction.net.xml"
    own = build_setup({"traffic": {"net": str(net), "routes": str(routes)}}, tmp_path / "run")
    world = World(own, tmp_path / "run", flat)
    world.start(1)
    try:
        assert world.time_ns == 25_200_000_000_000
        for _ in range(20):
            world.step()
        types = world.bodies().types
    finally:
        world.close()
    assert sorted(set(types)) == ["DEFAULT_VEHTYPE", "line5"]


@pytest.mark.parametrize(
    ("text", "error_text"),
    [
        ("<routes>", "cannot be read as XML"),
        ('<routes><trip id="a" depart="noon"/></routes>', "times must be in seconds"),
    ],
)
def test_routes_that_cannot_be_read_are_named(
    run_dir: Path, tmp_path: Path, text: str, error_text: str
) -> None:
    (tmp_path / "own.rou.xml").write_text(text)
    traffic = {
        "net": str(run_dir / "sumo" / "t_junction.net.xml"),
        "routes": str(tmp_path / "own.rou.xml"),
    }
    with pytest.raises(ConfigError, match=rf"own\.rou\.xml.* {error_text}"):
        build_setup({"traffic": traffic}, tmp_path / "run")


def test_a_demand_that_sumo_refuses_is_a_configuration_error(
    setup: Setup, run_dir: Path, tmp_path: Path, flat: Ground
) -> None:
    assert setup.road_map.intersections[0].signal.tls == "J"
    vehicles = '<vehicle id="a" depart="100"><route edges="west_in nowhere"/></vehicle>'
    own = build_setup(user_files(run_dir, tmp_path, vehicles), tmp_path / "run")
    world = World(own, tmp_path / "run", flat)
    try:
        with pytest.raises(ConfigError, match="SUMO refuses"):
            world.start(1)
    finally:
        world.close()


@pytest.mark.parametrize(
    ("traffic", "error_text"),
    [
        ({"net": "none.net.xml"}, r"none\.net\.xml does not exist"),
        ({"sumocfg": "none.sumocfg"}, r"none\.sumocfg does not exist"),
        ({"cav_rate": 2}, "traffic.cav_rate"),
    ],
)
def test_a_users_mistake_is_a_configuration_error(
    tmp_path: Path, traffic: dict[str, object], error_text: str
) -> None:
    with pytest.raises(ConfigError, match=error_text):
        build_setup({"traffic": traffic}, tmp_path)


def test_a_signal_that_the_net_lacks_is_a_configuration_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no signal 'K'"):
        build_setup({"junctions": ["K"]}, tmp_path)


def test_a_packed_sumocfg_that_breaks_off_is_a_configuration_error(tmp_path: Path) -> None:
    cut = tmp_path / "cut.sumocfg.gz"
    cut.write_bytes(gzip.compress(b"<configuration/>" * 50)[:-9])
    with pytest.raises(ConfigError, match=r"cut\.sumocfg\.gz cannot be read as XML"):
        build_setup({"traffic": {"sumocfg": str(cut)}}, tmp_path)
