"""Scans to measure codecs on: a roadside sensor and CAVs in traffic, at the built-in junction."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from protocol.geometry import SE3
from protocol.scans import Floats32, RangeScan
from sensing.config import LidarConfig, SceneConfig
from sensing.lidar import MIN_RANGE_M, Lidar, return_probability
from sensing.mesh import VehicleShapes
from sensing.noise import stream
from sensing.pose import pose_above
from sensing.scene import scene_of
from sim_host.setup import build_setup
from sim_host.world import sample_traffic

SEED = 1
_WARM_UP_STEPS = 600
_ROADSIDE_HEIGHT_M, _ROOF_HEIGHT_M = 3.0, 2.4
_CAV_DISTANCES_M = (20.0, 60.0, 120.0)  # from the junction's centre


@dataclass(frozen=True, slots=True, eq=False)
class BenchScan:
    """A scan, and what no codec can save on it: range noise, and which beams were lost by chance.

    `noise_std_m` is that of the range noise; `loss_bits` the entropy of the losses, all beams'.
    """

    name: str
    scan: RangeScan
    noise_std_m: float
    loss_bits: float


def cast_scans() -> list[BenchScan]:
    """Casts the scans; the same ones every time."""
    with tempfile.TemporaryDirectory() as folder:
        setup = build_setup({}, Path(folder))
        scene = scene_of(setup, SceneConfig(), SEED)
        bodies = sample_traffic(setup, Path(folder), scene.terrain, SEED, [_WARM_UP_STEPS])[0]
    config = LidarConfig()
    lidar = Lidar(config, scene, VehicleShapes.from_setup(setup))
    centre = np.array(setup.road_map.centre[:2])
    ground = scene.terrain.body_poses(centre[:1], centre[1:], np.zeros(1))[0]
    sensors: list[tuple[str, SE3, int | None]] = [
        ("roadside", pose_above(ground, _ROADSIDE_HEIGHT_M), None)
    ]
    away_m = np.linalg.norm(bodies.poses[:, :2] - centre, axis=1)
    for n, wanted_m in enumerate(_CAV_DISTANCES_M):
        car = int(np.argmin(np.abs(away_m - wanted_m)))
        sensors.append((f"cav {n}", pose_above(bodies.poses[car], _ROOF_HEIGHT_M), car))
    result = []
    for name, map_SE3_sensor, own in sensors:
        view = (map_SE3_sensor, bodies.poses, bodies.types, own)
        scan = lidar.scan(*view, stream(SEED, "bench", name)).scan
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
