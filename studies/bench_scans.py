"""Scans for `cpnet bench codec`: of a post and of CAVs in traffic at the built-in junction."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from protocol.geometry import SE3
from protocol.messages import Setup
from protocol.scans import Floats32, RangeScan
from sensing.config import LidarConfig, SceneConfig
from sensing.lidar import Lidar, return_probability
from sensing.mesh import TriangleMesh, VehicleShapes, merge
from sensing.noise import stream
from sensing.pose import pose_above
from sensing.reflectivity import MIN_RANGE_M
from sensing.scene import Scene, scene_of
from sim_host.setup import build_setup
from sim_host.world import TrafficState, sample_traffic

CAST_SEED = 1
_WARM_UP_STEPS = 600
_ROADSIDE_HEIGHT_M, ROOF_HEIGHT_M = 3.0, 2.4
CAV_DISTANCES_M = (20.0, 60.0, 120.0)  # from the junction's centre


@dataclass(frozen=True, slots=True, eq=False)
class Junction:
    """The built-in junction in traffic."""

    setup: Setup
    scene: Scene
    bodies: TrafficState

    @classmethod
    def in_traffic(cls) -> Junction:
        """Builds it; the same one every time."""
        with tempfile.TemporaryDirectory() as folder:
            setup = build_setup({}, Path(folder))
            scene = scene_of(setup, SceneConfig(), CAST_SEED)
            steps = [_WARM_UP_STEPS]
            bodies = sample_traffic(setup, Path(folder), scene.terrain, CAST_SEED, steps)[0]
        return cls(setup, scene, bodies)

    def car_at(self, away_m: float) -> int:
        """Returns the index of the body that is nearest to this distance from the centre."""
        centre = np.array(self.setup.road_map.centre[:2])
        found_m = np.linalg.norm(self.bodies.poses[:, :2] - centre, axis=1)
        return int(np.argmin(np.abs(found_m - away_m)))

    def mesh_without(self, own: int) -> TriangleMesh:
        """Returns scene and bodies as one mesh, without the body that carries the sensor."""
        shapes = VehicleShapes.from_setup(self.setup)
        looks, parts = shapes.bodies(self.bodies.types), [self.scene.mesh]
        for n, pose in enumerate(self.bodies.poses):
            if n != own:
                unit = shapes.meshes[looks.mesh[n]]
                placed = SE3.from_pose(pose).apply(unit.vertices * looks.size_m[n])
                parts.append(TriangleMesh.of(placed, unit.triangles))
        return merge(parts)


@dataclass(frozen=True, slots=True, eq=False)
class BenchScan:
    """A scan with its incompressible parts: range noise, and which beams were lost by chance.

    `noise_std_m` is that of the range noise; `loss_bits` the entropy of the losses, all beams'.
    """

    name: str
    scan: RangeScan
    noise_std_m: float
    loss_bits: float


def cast_scans(junction: Junction) -> list[BenchScan]:
    """Casts the scans; the same ones every time."""
    scene, bodies = junction.scene, junction.bodies
    config = LidarConfig()
    lidar = Lidar(config, scene, VehicleShapes.from_setup(junction.setup))
    centre = np.array(junction.setup.road_map.centre[:2])
    ground = scene.terrain.body_poses(centre[:1], centre[1:], np.zeros(1))[0]
    sensors: list[tuple[str, SE3, int | None]] = [
        ("roadside", pose_above(ground, _ROADSIDE_HEIGHT_M), None)
    ]
    for n, wanted_m in enumerate(CAV_DISTANCES_M):
        car = junction.car_at(wanted_m)
        sensors.append((f"cav {n}", pose_above(bodies.poses[car], ROOF_HEIGHT_M), car))
    result = []
    for name, map_SE3_sensor, own in sensors:
        view = (map_SE3_sensor, bodies.poses, bodies.types, own)
        scan = lidar.scan(*view, stream(CAST_SEED, "bench", name)).scan
        bits = loss_entropy_bits(lidar.view(*view).distance_m, config)
        result.append(BenchScan(name, scan, config.noise_stddev, bits))
    return result


def loss_entropy_bits(distance_m: Floats32, config: LidarConfig) -> float:
    """Returns the entropy of which beams are lost, their true distances being known."""
    seen = distance_m[(distance_m >= MIN_RANGE_M) & (distance_m < config.range)].astype(np.float64)
    kept = return_probability(seen, config)
    lost = 1.0 - kept
    terms = [share * np.log2(np.maximum(share, 1e-12)) for share in (kept, lost)]
    return float(-(terms[0] + terms[1]).sum())
