"""CARLA as a scan source: coordinates, and calls to a fake server."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cpnet_carla.source import ATTRIBUTES, CarlaSource, carla_pose, load_carla, scan_of
from hypothesis import given
from hypothesis import strategies as st

from cpnet import scenario as scenarios
from protocol.errors import BusError, ConfigError
from protocol.geometry import SE3
from protocol.messages import Setup, VehicleType
from protocol.scans import ScanPattern
from protocol.wire import decode
from recording.run import Run
from recording.tables import UploadRow
from sensing.config import LidarConfig
from sensing.source import check_source
from sensing.world_view import WorldView
from studies.in_process import run_in_process
from tests.carla_package.fake_carla import Location, Package, Rotation, Transform
from tests.example_plugins import EXAMPLES, install

GOLDEN = Path(__file__).parents[1] / "protocol" / "golden" / "Setup.bin"
LIDAR = LidarConfig(channels=256, points_per_second=256 * 2048 * 10, upper_fov=40, lower_fov=-40)
PATTERN = ScanPattern(16, 90, 10, -20)
OFFSET_M = (503.02, 423.76)  # Town04's, in the net that comes with CARLA
TYPES = [
    VehicleType(name=name, mesh=mesh, length_m=4.5, width_m=1.8, height_m=1.5)
    for name, mesh in [("sedan", "car"), ("van", "microcargo")]
]
MIRROR = np.diag([1.0, -1.0, 1.0])
metres = st.floats(-1e4, 1e4)
angles = st.floats(-np.pi, np.pi)
poses = st.tuples(metres, metres, metres, angles, st.floats(-1.5, 1.5), angles)


def transform(pose: np.ndarray) -> Transform:
    x, y, z, roll, pitch, yaw = pose
    return Transform(Location(x, y, z), Rotation(pitch=pitch, yaw=yaw, roll=roll))


@given(poses)
def test_a_pose_is_the_mirror_image_by_carlas_own_matrix(pose) -> None:
    matrix = np.array(transform(carla_pose(pose, OFFSET_M)).get_matrix())
    ours = SE3.from_pose(pose)
    np.testing.assert_allclose(matrix[:3, :3], MIRROR @ ours.rotation @ MIRROR, atol=1e-9)
    want = MIRROR @ (ours.translation - [*OFFSET_M, 0])
    np.testing.assert_allclose(matrix[:3, 3], want, atol=1e-8)


@given(poses)
def test_mirrored_twice_a_pose_is_what_it_was(pose) -> None:
    once = carla_pose(pose, (0, 0))
    twice = carla_pose([*once[:3], *np.radians(once[3:])], (0, 0))
    np.testing.assert_allclose(twice, [*pose[:3], *np.degrees(pose[3:])], atol=1e-9)


@pytest.mark.parametrize(
    ("pose", "want"),
    [
        ((0, 0, 0, 0, 0, 0), (0, 0, 0, 0, 0, 0)),
        ((10, 20, 3, 0, 0, 0), (10, -20, 3, 0, 0, 0)),  # north is CARLA's -y
        ((0, 0, 0, 0, 0, np.pi / 2), (0, 0, 0, 0, 0, -90)),  # to the north: a left turn from east
        ((0, 0, 0, 0, np.radians(5), 0), (0, 0, 0, 0, -5, 0)),  # the nose down
        ((0, 0, 0, np.radians(5), 0, 0), (0, 0, 0, 5, 0, 0)),  # to the right
    ],
)
def test_known_poses(pose, want) -> None:
    np.testing.assert_allclose(carla_pose(pose, (0, 0)), want, atol=1e-12)


def test_the_nets_offset_is_where_carlas_origin_lies() -> None:
    np.testing.assert_allclose(carla_pose([503.02, 423.76, 0, 0, 0, 0], OFFSET_M), 0, atol=1e-12)
    # Signal 1368 of Town04: in CARLA's town that is 385 m west of the origin, 12 m south of it.
    centre = carla_pose([117.92, 412.14, 0, 0, 0, 0], OFFSET_M)
    np.testing.assert_allclose(centre[:2], [-385.1, 11.62], atol=1e-9)


@given(st.integers(0, 2**32 - 1), st.sampled_from([PATTERN, ScanPattern(1, 4, 0, 0)]))
def test_every_beam_comes_back_to_its_place(seed, pattern) -> None:
    rng = np.random.default_rng(seed)
    shape = (pattern.channels, pattern.columns)
    range_m = rng.uniform(0.5, 200, shape).astype(np.float32) * (rng.random(shape) < 0.7)
    hit = range_m > 0
    points = (pattern.directions[hit] * range_m[hit][:, None]) @ MIRROR
    intensity = rng.random(hit.sum()).astype(np.float32)
    measured = np.column_stack([points, intensity]).astype(np.float32)
    scan = scan_of(rng.permutation(measured), pattern)
    np.testing.assert_allclose(scan.range_m, range_m, rtol=1e-5)
    np.testing.assert_array_equal(scan.intensity[hit], intensity)


def test_left_is_left() -> None:
    scan = scan_of(np.array([[0, -10, 0, 1]], np.float32), ScanPattern(1, 4, 0, 0))
    assert scan.range_m.tolist() == [[0, 10, 0, 0]]  # column 1 looks to the left
    np.testing.assert_allclose(scan.cloud().points, [[0, 10, 0]], atol=1e-6)


def test_odd_points_are_left_out_and_of_several_the_nearest_counts() -> None:
    up, near, far = (0, 0, 9, 1), (5, 0, 0, 0.2), (7, 0, 0, 0.9)
    odd = [(0, 0, 0, 1), (np.nan, 1, 1, 1), up, near, far]
    scan = scan_of(np.array(odd, np.float32), ScanPattern(3, 4, 10, -10))
    assert scan.range_m.tolist() == [[0] * 4, [5, 0, 0, 0], [0] * 4]
    assert scan.intensity[1, 0] == np.float32(0.2)
    assert not scan_of(np.zeros((0, 4), np.float32), PATTERN).range_m.any()


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return install(tmp_path_factory.mktemp("packages"), EXAMPLES / "carla_package")


@pytest.fixture
def installed(packages: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(packages)


@pytest.fixture
def carla(monkeypatch: pytest.MonkeyPatch) -> Package:
    package = Package()
    monkeypatch.setitem(sys.modules, "carla", package)
    return package


def source(**config: Any) -> CarlaSource:
    keys = {"net_offset_m": OFFSET_M, "timeout_s": 1} | config
    setup = decode(GOLDEN.read_bytes(), Setup).model_copy(
        update={"vehicle_types": TYPES, "scenario": {"seed": 7}}
    )
    return CarlaSource(setup, LIDAR, keys)


def tick(frame: int, **bodies: tuple[float, ...]) -> WorldView:
    count = len(bodies)
    return WorldView(
        frame=frame,
        sim_time_ns=frame * 10**8,
        ids=list(bodies),
        types=["van" if name == "van" else "sedan" for name in bodies],
        poses=np.array([*bodies.values()], np.float64).reshape(-1, 6),
        speeds_mps=np.zeros(count, np.float32),
        hosted={},
    )


def seen(taken: Any, map_SE3_sensor: SE3) -> list[tuple[float, float, float]]:
    """Returns where the points of a scan lie in the map, to 20 cm."""
    places = map_SE3_sensor.apply(taken.scan.cloud().points)
    return sorted((float(x), float(y), float(z)) for x, y, z in np.round(places * 5) / 5)


POST = SE3.from_pose([120, 410, 4, 0, 0, np.radians(30)])


def test_bodies_are_seen_where_they_are_in_the_map(carla) -> None:
    bodies = {"a": (130, 415, 0.2, 0, 0, 1), "van": (110, 400.2, 0, 0, 0, 2)}
    tilted = SE3.from_pose([122, 409, 3, 0.05, -0.1, 2.5])
    made = source()
    for sensor in (POST, tilted):
        taken = made.scan("rsu-0", tick(0, **bodies), sensor, None)
        assert seen(taken, sensor) == [(110, 400.2, 1), (130, 415, 1.2)]
    assert [v.type_id for v in carla.vehicles] == ["vehicle.tesla.model3", "vehicle.volkswagen.t2"]
    assert not any(vehicle.has_physics for vehicle in carla.vehicles)


def test_who_carries_the_sensor_is_not_seen_and_moves_with_all_others(carla) -> None:
    made = source()
    for frame in range(3):
        bodies = {"a": (130 + frame, 415, 0, 0, 0, 0), "b": (110, 400 + frame, 0, 0, 0, 0)}
        now = tick(frame, **bodies)
        assert seen(made.scan("a", now, POST, 0), POST) == [(110, 400 + frame, 1)]
        assert seen(made.scan("b", now, POST, 1), POST) == [(130 + frame, 415, 1)]
    assert len(carla.vehicles) == 2


def test_who_leaves_is_taken_away_and_at_the_end_everything_is(carla) -> None:
    made = source()
    made.scan("r", tick(0, a=(130, 415, 0, 0, 0, 0), b=(131, 420, 0, 0, 0, 0)), POST, None)
    taken = made.scan("r", tick(1, b=(131, 420, 0, 0, 0, 0)), POST, None)
    assert seen(taken, POST) == [(131, 420, 1)]
    assert len(carla.vehicles) == 1
    made.close()
    assert carla.world.actors == {}


def test_processes_that_share_a_server_do_not_see_each_others_bodies(carla) -> None:
    one, other = source(), source()
    bodies = {f"car{n}": (130 + 3.0 * n, 415, 0, 0, 0, 0) for n in range(4)}
    for frame in range(2):
        for each in (one, other):
            assert len(seen(each.scan("r", tick(frame, **bodies), POST, None), POST)) == 4
    assert len(carla.vehicles) == 8
    assert other._measured.empty()
    one.close()
    assert len(seen(other.scan("r", tick(2, **bodies), POST, None), POST)) == 4


def test_the_server_waits_for_ticks_and_the_sensor_turns_once_a_tick(carla) -> None:
    source()
    assert carla.world.settings.synchronous_mode
    assert carla.world.settings.fixed_delta_seconds == 0.1
    (sensor,) = carla.world.actors.values()
    for name, value in LIDAR.model_dump(include=ATTRIBUTES).items():
        assert float(sensor.attributes[name]) == value
    assert sensor.attributes["horizontal_fov"] == "360.0"


def test_a_town_is_loaded_unless_it_is_there(carla) -> None:
    source(town="Town04")
    assert carla.loaded == []
    source(town="Town05")
    assert carla.loaded == ["Town05"]


def test_what_a_dead_process_left_is_taken_away(carla) -> None:
    for role in ("cpnet-999999999", "hero"):
        blueprint = carla.world.get_blueprint_library().find("vehicle.tesla.model3")
        blueprint.set_attribute("role_name", role)
        carla.world.spawn_actor(blueprint, Transform(Location(len(role), 0, 0), Rotation()))
    source()
    assert [vehicle.attributes["role_name"] for vehicle in carla.vehicles] == ["hero"]


@pytest.mark.parametrize(
    ("config", "error_text"),
    [
        ({"port": 2010}, r"CARLA at 127\.0\.0\.1:2010 .*time-out"),
        ({"town": "Nowhere"}, r"CARLA at 127\.0\.0\.1:2000 .*map not found"),
    ],
)
def test_a_server_that_cannot_be_used_is_named(carla, config, error_text) -> None:
    with pytest.raises(ConfigError, match=error_text):
        source(**config)


def test_a_server_of_another_version_is_refused(carla) -> None:
    carla.version = "0.9.13"
    with pytest.raises(ConfigError, match=r"is version 0\.9\.13, the package 0\.9\.15"):
        source()


def test_looks_can_be_chosen_and_must_exist(carla) -> None:
    body = {"a": (130.0, 415.0, 0.0, 0.0, 0.0, 0.0)}
    source(blueprints={"sedan": "vehicle.audi.a2"}).scan("r", tick(0, **body), POST, None)
    assert [vehicle.type_id for vehicle in carla.vehicles] == ["vehicle.audi.a2"]
    with pytest.raises(ConfigError, match=r"has no blueprint 'vehicle\.nothing'"):
        source(blueprints={"sedan": "vehicle.nothing"}).scan("r", tick(0, **body), POST, None)


def test_a_server_that_goes_away_is_said_to_be_lost(carla, monkeypatch) -> None:
    made = source()

    def lost(seconds: float) -> int:
        raise RuntimeError("time-out while waiting for the simulator")

    monkeypatch.setattr(carla.world, "tick", lost)
    with pytest.raises(BusError, match=r"CARLA at 127\.0\.0\.1:2000 is lost: time-out"):
        made.scan("r", tick(0), POST, None)


def test_without_the_package_the_extra_is_named(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "carla", None)
    with pytest.raises(ConfigError, match="pip install carla"):
        load_carla()


@pytest.mark.parametrize(
    ("settings", "error_text"),
    [
        ({}, "terrain_amplitude_m 0 "),
        ({"recording": "somewhere", "traffic.warmup_s": 0}, "recording plays some"),
        ({"lidar.vehicle.rotation_frequency": 20}, "the same rotation_frequency"),
        ({"lidar.roadside.points_per_second": 64 * 1801 * 10}, r"even number .*roadside: 1801"),
    ],
)
def test_a_scenario_that_carla_cannot_serve_is_refused(
    carla, installed, settings, error_text
) -> None:
    scenario = scenarios.load("t_junction", {"lidar.source": "carla"} | settings)
    with pytest.raises(ConfigError, match=error_text):
        check_source(scenario.model_dump(mode="json"))


def test_a_run_takes_its_scans_from_carla(carla, installed, tmp_path) -> None:
    keys = {
        "lidar.source": "carla",
        "scene.terrain_amplitude_m": 0,
        "processes.vehicle": 1,
        "frame_period_s": 1,
        "duration_s": 3,
        "traffic.warmup_s": 30,
        "traffic.cav_rate": 0.1,
    }
    run_in_process(scenarios.load("t_junction", keys).model_dump(mode="json"), tmp_path)
    with Run(tmp_path) as run:
        uploads = list(run.rows(UploadRow))
    assert {upload.frame for upload in uploads} == {0, 1, 2}
    assert sum(upload.points or 0 for upload in uploads) > 0
    assert carla.world.actors == {}
