"""What surfaces send back: materials, paints, angles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from protocol.geometry import SE3
from protocol.messages import Material, VehicleType
from sensing.config import LidarConfig
from sensing.embree import Caster
from sensing.lidar import Lidar
from sensing.mesh import TriangleMesh, VehicleShapes, merge
from sensing.reflectivity import paint_of, paints_of
from sensing.scene import Scene
from tests.sensing.solids import unit_box
from tests.sensing.test_lidar_scan import on_roof

CONFIG = LidarConfig(channels=32, points_per_second=32 * 720 * 10, range_at_10_percent_m=50)
Traffic = tuple[np.ndarray, list[str]]


def test_a_paint_follows_from_the_seed_and_the_vehicle() -> None:
    names = [f"v{n}" for n in range(3000)]
    paints = paints_of(1, names)
    assert paints.tolist() == [np.float32(paint_of(1, name)) for name in names]
    assert (paints != paints_of(2, names)).mean() > 0.99
    assert paints.min() >= 0.03
    assert paints.max() <= 0.85
    assert np.mean(paints < 0.15) == pytest.approx(0.34, abs=0.04)
    assert np.mean(paints > 0.4) == pytest.approx(0.52, abs=0.05)


def test_power_is_reflectivity_times_the_cosine_of_incidence(
    scene: Scene, shapes: VehicleShapes, traffic: Traffic
) -> None:
    """Against the triangles of everything at once, placed in the map."""
    sensor, poses = on_roof(traffic[0][0]), traffic[0][1:]
    types, paint = traffic[1][1:], np.linspace(0.05, 0.8, 69).astype(np.float32)
    view = Lidar(CONFIG, scene, shapes).view(sensor, poses, types, None, paint)
    looks = shapes.bodies(types)
    meshes = [
        TriangleMesh(
            SE3.from_pose(pose).apply(shapes.meshes[kind].vertices * size),
            shapes.meshes[kind].triangles,
        )
        for pose, kind, size in zip(poses, looks.mesh, looks.size_m, strict=True)
    ]
    owner = np.repeat(np.arange(69), [len(mesh.triangles) for mesh in meshes])
    directions = CONFIG.pattern.directions.reshape(-1, 3) @ sensor.rotation.T
    rays = np.ascontiguousarray(directions.T, np.float32)
    limits, faces = (
        np.full(rays.shape[1], CONFIG.range, np.float32),
        np.empty(rays.shape[1], np.int32),
    )
    everything = merge(meshes)
    Caster(everything).cast(
        sensor.translation.astype(np.float32).reshape(3, 1), rays, limits, faces
    )
    body = view.body.reshape(-1)
    seen = (body >= 0) & (np.abs(limits - view.distance_m.reshape(-1)) < 1e-3)
    seen &= np.append(owner, -1)[np.where(limits < CONFIG.range, faces, -1)] == body
    assert np.count_nonzero(seen) > 500
    a, b, c = everything.corners[faces[seen]].astype(np.float64).transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    expected = paint[body[seen]] * np.abs((normals * directions[seen]).sum(axis=1))
    found = view.strength.reshape(-1)[seen]
    assert np.quantile(np.abs(found - expected), 0.99) < 1e-3


def test_the_road_sends_back_as_much_at_any_angle(scene: Scene, shapes: VehicleShapes) -> None:
    nothing = merge([])
    bare = replace(scene, kerbs=nothing, buildings=nothing, poles=nothing, trees=nothing)
    sensor = SE3(np.eye(3), np.array([0.0, 0.0, float(scene.terrain.height_m([[0, 0]])[0]) + 3]))
    view = Lidar(CONFIG, bare, shapes).view(sensor, np.empty((0, 6)), [], None)
    hit = view.distance_m < CONFIG.range
    assert np.ptp(view.distance_m[hit]) > 30
    assert set(np.unique(view.strength[hit]).tolist()) == {np.float32(0.15)}
    assert not view.strength[~hit].any()


def test_rays_pass_through_windows(scene: Scene) -> None:
    box = unit_box()
    glass = TriangleMesh(
        box.vertices, box.triangles, np.full(len(box.triangles), Material.GLASS, np.uint8)
    )
    kind = VehicleType(name="car", mesh="box", length_m=4.6, width_m=1.8, height_m=1.5)
    pose = np.array([[8.0, -1.75, float(scene.terrain.height_m([[8, -1.75]])[0]), 0, 0, 0]])
    sensor = SE3(np.eye(3), pose[0, :3] + [-8, 0, 1.0])

    def on_it(mesh: TriangleMesh, config: LidarConfig) -> int:
        lidar = Lidar(config, scene, VehicleShapes([kind], {"box": mesh}))
        return int((lidar.view(sensor, pose, ["car"], None).body >= 0).sum())

    assert on_it(box, CONFIG) > 100
    assert on_it(glass, CONFIG) == 0
    alike = CONFIG.model_copy(update={"range_at_10_percent_m": None})
    assert on_it(glass, alike) == on_it(box, alike) > 100


def test_nothing_comes_back_from_behind_a_window(scene: Scene) -> None:
    box = unit_box()
    rear = box.corners[:, :, 0].max(axis=1) < 0  # the side turned to the sensor
    materials = np.where(rear, Material.GLASS, Material.PAINT).astype(np.uint8)
    mesh = TriangleMesh(box.vertices, box.triangles, materials)
    kind = VehicleType(name="car", mesh="box", length_m=4.6, width_m=1.8, height_m=1.5)
    pose = np.array([[8.0, -1.75, float(scene.terrain.height_m([[8, -1.75]])[0]), 0, 0, 0]])
    sensor = SE3(np.eye(3), pose[0, :3] + [-8, 0, 1.0])
    lidar = Lidar(CONFIG, scene, VehicleShapes([kind], {"box": mesh}))
    view = lidar.view(sensor, pose, ["car"], None, np.array([0.8], np.float32))
    inside = (view.body == 0) & (view.distance_m > 9.0)
    assert np.count_nonzero(inside) > 50
    assert not view.strength[inside].any()
