"""Recorded traffic to measure uplinks on: a roadside LiDAR and CAVs at the built-in junction.

Ray casting is not part of later measurements, and every policy gets the same scans.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from protocol.codec import encode_scan
from protocol.errors import ConfigError
from protocol.geometry import SE3, Floats
from protocol.messages import AgentPose, Equipment, Scan, Setup, Truth
from protocol.roadmap import RoadMap
from protocol.scans import RangeScan
from sensing.config import LidarConfig, PoseErrorConfig, SceneConfig, UploadConfig
from sensing.lidar import Lidar
from sensing.mesh import VehicleShapes
from sensing.noise import stream
from sensing.pose import estimated_pose, pose_above
from sensing.recorded_scans import Recording, write_recording
from sensing.scene import scene_of
from sensing.terrain import Terrain
from sim_host.setup import build_setup
from sim_host.world import TrafficState, sample_traffic, truth_of
from studies.bench import FRAME_PERIOD_S
from studies.ecvpr import VISIBLE_POINTS

SEED = 1
RSU = "rsu-0"
VISIBLE_NAME = "visible.json"
_WARM_UP_STEPS = 600
_RSU_HEIGHT_M = 3.0
ROOF_HEIGHT_M = 2.4
_NEAR_M = 120.0  # from the junction's centre: where the agents drive


def record_traffic(folder: Path, agents: int, frames: int, seed: int = SEED) -> None:
    """Records `agents` scanning agents, one of them the post, over some frames of 0.1 s.

    Raises:
        ConfigError: too few vehicles stay near the junction for so long.
    """
    with tempfile.TemporaryDirectory() as scratch:
        setup = build_setup({}, Path(scratch))
        scene = scene_of(setup, SceneConfig(), seed)
        steps = range(_WARM_UP_STEPS, _WARM_UP_STEPS + frames)
        moments = sample_traffic(setup, Path(scratch), scene.terrain, seed, steps)
    centre = np.array(setup.road_map.centre[:2])
    cavs = _choose(moments, centre, agents - 1)
    config = LidarConfig()
    shapes = VehicleShapes.from_setup(setup)
    lidar = Lidar(config, scene, shapes)
    post = rsu_pose(setup.road_map, scene.terrain)
    scans: dict[str, list[RangeScan]] = {name: [] for name in [RSU, *cavs]}
    visible = []
    for frame, bodies in enumerate(moments):
        hits = np.zeros(len(bodies.ids), np.int64)
        for name in scans:
            own = bodies.ids.index(name) if name in bodies.ids else None
            sensor = post if own is None else pose_above(bodies.poses[own], ROOF_HEIGHT_M)
            rng = stream(seed, "scan", name, frame)
            seen = lidar.scan(sensor, bodies.poses, bodies.types, own, rng)
            hits += seen.points_on
            scans[name].append(seen.scan)
        clear = [n for n, hit in zip(bodies.ids, hits, strict=True) if hit >= VISIBLE_POINTS]
        visible.append(sorted(set(clear) - set(cavs)))
    truths = [
        truth_of(frame, round(frame * FRAME_PERIOD_S * 1e9), _equipped(bodies, cavs))
        for frame, bodies in enumerate(moments)
    ]
    write_recording(folder, FRAME_PERIOD_S, truths, scans)
    (folder / VISIBLE_NAME).write_text(json.dumps(visible) + "\n", "utf-8")


def rsu_pose(road_map: RoadMap, terrain: Terrain) -> SE3:
    """Returns where the roadside LiDAR stands: at the junction's centre."""
    centre = np.array(road_map.centre[:2])
    base = terrain.body_poses(centre[:1], centre[1:], np.zeros(1))[0]
    return pose_above(base, _RSU_HEIGHT_M)


def estimated_sensor(agent: str, truth: Truth, post: SE3) -> SE3:
    """Returns `map_SE3_sensor` of a recorded agent by its own estimate; the post's is exact."""
    return post if agent == RSU else pose_above(_estimated(agent, truth), ROOF_HEIGHT_M)


def uploaded_scan(recording: Recording, agent: str, truth: Truth, post: SE3) -> Scan:
    """Returns the message that uploads an agent's whole scan of a frame."""
    payload = encode_scan(recording.scan(agent, truth.frame), UploadConfig().max_error_m)
    return Scan(
        frame=truth.frame,
        sim_time_ns=truth.sim_time_ns,
        agent=agent,
        chunk=0,
        chunks=1,
        points=0,
        sensor_pose=estimated_sensor(agent, truth, post).as_pose(),
        sense_start_ns=0,
        sense_end_ns=0,
        encode_end_ns=0,
        payload=np.frombuffer(payload, np.uint8),
    )


def agent_poses(agents: Iterable[str], truth: Truth, setup: Setup) -> list[AgentPose]:
    """Returns the poses that the CAVs among these agents report in a frame, sorted by agent."""
    types = {kind.name: kind for kind in setup.vehicle_types}
    poses = []
    for agent in sorted(set(agents) - {RSU}):
        kind = types[truth.types[truth.ids.index(agent)]]
        poses.append(
            AgentPose(
                frame=truth.frame,
                sim_time_ns=truth.sim_time_ns,
                agent=agent,
                equipment=Equipment.CAV,
                pose=_estimated(agent, truth),
                length_m=kind.length_m,
                width_m=kind.width_m,
                height_m=kind.height_m,
                position_std_m=PoseErrorConfig().position_std_m,
            )
        )
    return poses


def _estimated(agent: str, truth: Truth) -> Floats:
    rng = stream(SEED, "pose", agent, truth.frame)
    pose = truth.poses[truth.ids.index(agent)]
    return estimated_pose(pose, PoseErrorConfig(), Equipment.CAV, rng)


def visible_vehicles(folder: Path) -> list[set[str]]:
    """Returns by recorded frame the vehicles without a radio that the agents together see."""
    return [set(names) for names in json.loads((folder / VISIBLE_NAME).read_text("utf-8"))]


def _choose(moments: Sequence[TrafficState], centre: np.ndarray, count: int) -> list[str]:
    """Returns vehicles that stay near the junction all the while, evenly by their distance."""
    always = set(moments[0].ids)
    for bodies in moments:
        away_m = np.linalg.norm(bodies.poses[:, :2] - centre, axis=1)
        always &= {name for name, m in zip(bodies.ids, away_m, strict=True) if m <= _NEAR_M}
    middle = moments[len(moments) // 2]
    away_m = np.linalg.norm(middle.poses[:, :2] - centre, axis=1)
    order = [middle.ids[i] for i in np.argsort(away_m, kind="stable") if middle.ids[i] in always]
    if len(order) < count:
        raise ConfigError(
            f"{len(order)} vehicles stay within {_NEAR_M:g} m of the junction for "
            f"{len(moments)} frames, {count} are asked for: take fewer agents or frames"
        )
    picks = np.linspace(0, len(order) - 1, count).round().astype(int)
    return [order[i] for i in picks]


def _equipped(bodies: TrafficState, cavs: Sequence[str]) -> TrafficState:
    kinds = [Equipment.CAV if name in cavs else Equipment.NONE for name in bodies.ids]
    return replace(bodies, equipment=np.array(kinds, np.uint8))
