"""The scan against one brute-force Embree scene that holds everything."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from protocol.errors import MessageError
from protocol.geometry import SE3
from sensing.config import LidarConfig
from sensing.embree import Caster
from sensing.lidar import Lidar
from sensing.mesh import TriangleMesh, VehicleShapes, merge
from sensing.noise import stream
from sensing.scene import Scene
from tests.sensing.solids import SEED

CONFIG = LidarConfig(channels=48, points_per_second=48 * 900 * 10)
CLEAN = LidarConfig(
    channels=16, points_per_second=16 * 360 * 10, upper_fov=10, lower_fov=-30,
    dropoff_general_rate=0, dropoff_zero_intensity=0, noise_stddev=0,
)  # fmt: skip
NOBODY = np.empty((0, 6))

Traffic = tuple[NDArray[np.float64], list[str]]


def on_roof(pose: NDArray[np.float64]) -> SE3:
    return SE3.from_pose(pose) @ SE3(np.eye(3), np.array([0.0, 0.0, 2.4]))


def bare(scene: Scene) -> Scene:
    nothing = merge([])
    return replace(scene, kerbs=nothing, buildings=nothing, poles=nothing, trees=nothing)


def brute_force(
    sensor: SE3, scene: Scene, shapes: VehicleShapes, traffic: Traffic, own: int | None
) -> NDArray[np.float32]:
    poses, types = traffic
    looks = shapes.bodies(types)
    meshes = [scene.mesh]
    for k, pose in enumerate(poses):
        if k != own:
            unit = shapes.meshes[looks.mesh[k]]
            placed = SE3.from_pose(pose).apply(unit.vertices * looks.size_m[k])
            meshes.append(TriangleMesh(placed, unit.triangles))
    directions = CONFIG.pattern.directions.reshape(-1, 3) @ sensor.rotation.T
    rays = np.ascontiguousarray(directions.T, np.float32)
    origin = sensor.translation.astype(np.float32).reshape(3, 1)
    limits = np.full(rays.shape[1], CONFIG.range, np.float32)
    Caster(merge(meshes)).cast(origin, rays, limits, np.empty(len(limits), np.int32))
    return limits.reshape(CONFIG.channels, CONFIG.columns)


@pytest.mark.parametrize("place", ["first car", "tilted", "roadside"])
def test_a_scan_equals_a_cast_into_everything_at_once(
    place: str, scene: Scene, shapes: VehicleShapes, traffic: Traffic
) -> None:
    sensor, own = on_roof(traffic[0][0]), 0
    if place == "tilted":
        sensor = sensor @ SE3.from_pose([0.1, 0.2, 0.3, 0.06, -0.08, 2.5])
    if place == "roadside":
        sensor, own = SE3.from_pose([0.0, 0.0, 3.1, 0.0, 0.0, 0.7]), None
    lidar = Lidar(CONFIG, scene, shapes)
    found = lidar.view(sensor, *traffic, own).distance_m
    expected = brute_force(sensor, scene, shapes, traffic, own)
    wrong = np.abs(found - expected) > 1e-3 + 1e-4 * expected
    # Rays that graze the very rim of a triangle may go either way in float32.
    assert np.count_nonzero(wrong) <= 3
    assert np.count_nonzero(expected < lidar.view(sensor, NOBODY, [], None).distance_m - 0.1) > 2000


def test_a_sensor_amid_a_body_that_is_not_its_own_sees_that_body_all_around(
    scene: Scene, shapes: VehicleShapes
) -> None:
    pose = scene.terrain.body_poses([-40.0], [-1.75], [0.0])
    sensor = SE3.from_pose([-40.0, -1.75, pose[0, 2] + 1.0, 0.0, 0.0, 0.0])
    lidar = Lidar(CONFIG, scene, shapes)
    found = lidar.view(sensor, pose, ["bus"], None).distance_m
    assert found.max() < 15


def test_a_vehicle_does_not_see_itself(scene: Scene, shapes: VehicleShapes) -> None:
    pose = scene.terrain.body_poses([-40.0], [-1.75], [0.3])
    lidar = Lidar(CONFIG, scene, shapes)
    alone = lidar.view(on_roof(pose[0]), NOBODY, [], None).distance_m
    assert np.array_equal(lidar.view(on_roof(pose[0]), pose, ["bus"], 0).distance_m, alone)
    assert not np.array_equal(lidar.view(on_roof(pose[0]), pose, ["bus"], None).distance_m, alone)


def test_a_scan_does_not_depend_on_what_was_scanned_before(
    scene: Scene, shapes: VehicleShapes, traffic: Traffic
) -> None:
    sensor = on_roof(traffic[0][0])
    used, fresh = Lidar(CONFIG, scene, shapes), Lidar(CONFIG, scene, shapes)
    for k in range(40):
        used.scan(on_roof(traffic[0][k]), *traffic, k, stream(SEED, k))
    used.scan(sensor, *traffic, 0, stream(SEED, "again"))
    one = used.scan(sensor, *traffic, 0, stream(SEED, "cav", 1)).scan
    other = fresh.scan(sensor, *traffic, 0, stream(SEED, "cav", 1)).scan
    assert np.array_equal(one.range_m, other.range_m)
    assert np.array_equal(one.intensity, other.intensity)


def test_bodies_may_come_in_any_order(
    scene: Scene, shapes: VehicleShapes, traffic: Traffic
) -> None:
    poses, types = traffic
    order = np.random.default_rng(1).permutation(len(poses))
    lidar = Lidar(CONFIG, scene, shapes)
    sensor = on_roof(poses[0])
    one = lidar.view(sensor, poses, types, None).distance_m
    other = lidar.view(sensor, poses[order], [types[k] for k in order], None).distance_m
    assert np.array_equal(one, other)


def test_points_lie_where_the_ground_is(scene: Scene, shapes: VehicleShapes) -> None:
    sensor = on_roof(scene.terrain.body_poses([-60.0], [-1.75], [1.0])[0])
    scan = Lidar(CLEAN, bare(scene), shapes).scan(sensor, NOBODY, [], None, stream(SEED)).scan
    points = sensor.apply(scan.cloud().points)
    assert len(points) > 3000
    near = np.hypot(*(points[:, :2] - sensor.translation[:2]).T) < 25
    error_m = points[near, 2] - scene.terrain.height_m(points[near, :2])
    assert np.abs(error_m).max() < 0.03


def test_beyond_the_world_nothing_returns(scene: Scene, shapes: VehicleShapes) -> None:
    lidar = Lidar(CLEAN, scene, shapes)
    far = SE3.from_pose([5000.0, 0.0, 3.0, 0.0, 0.0, 0.0])
    scan = lidar.scan(far, NOBODY, [], None, stream(SEED)).scan
    assert not scan.range_m.any()
    assert not scan.intensity.any()


def test_a_body_of_an_unknown_type_is_refused(
    scene: Scene, shapes: VehicleShapes, traffic: Traffic
) -> None:
    lidar = Lidar(CLEAN, scene, shapes)
    with pytest.raises(MessageError, match="'tank' is not in the set-up"):
        lidar.scan(SE3.identity(), traffic[0][:1], ["tank"], None, stream(SEED))


def test_with_a_rolling_shutter_each_body_is_where_the_beam_met_it(
    scene: Scene, shapes: VehicleShapes, traffic: Traffic
) -> None:
    """Clockwise from behind: what is on the left is met before, on the right after the middle."""
    rolling = CLEAN.model_copy(update={"rolling_shutter": True})
    sensor = SE3.from_pose([0, 0, 3, 0, 0, 0])
    kind = traffic[1][:1]
    for azimuth_rad, after_s in ((0.0, 0.0), (np.pi / 2, -0.025), (-np.pi / 2, 0.025)):
        pose = np.array([[8 * np.cos(azimuth_rad), 8 * np.sin(azimuth_rad), 0, 0, 0, 0]])
        met = pose + np.array([20 * after_s, 0, 0, 0, 0, 0])
        lidars = Lidar(rolling, bare(scene), shapes), Lidar(CLEAN, bare(scene), shapes)
        speeds_mps = np.array([20], np.float32)
        moving = lidars[0].scan(sensor, pose, kind, None, stream(1), speeds_mps=speeds_mps)
        still = lidars[1].scan(sensor, met, kind, None, stream(1))
        assert moving.points_on[0] > 20
        assert np.allclose(moving.scan.range_m, still.scan.range_m, atol=1e-4)
        unmoved = lidars[1].scan(sensor, pose, kind, None, stream(1), speeds_mps=speeds_mps)
        assert np.array_equal(unmoved.scan.range_m, moving.scan.range_m) == (after_s == 0)
