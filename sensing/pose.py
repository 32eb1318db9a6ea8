"""Poses of sensors on masts and roofs, and errors of an agent's own pose estimate.

A CAV's error is the sum of a bias that stays, a drift and the noise of each frame. The drift is a
first-order Gauss-Markov process: its correlation falls as exp(-t / drift_time_s). It is drawn as a
sum of waves whose frequencies have that process's spectrum, so that its value at a time follows
from seed and agent alone, whichever process computes it, and from which frame on.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from protocol.geometry import SE3, Floats, wrap_angle
from protocol.messages import Equipment
from protocol.roadmap import RoadMap
from sensing.config import Mount, PoseErrorConfig
from sensing.noise import stream
from sensing.terrain import Terrain

_WAVES = 64


def mount_place(mount: Mount, road_map: RoadMap) -> tuple[float, float]:
    """Returns x and y of a mount; without a junction named, of the map's only one."""
    at = road_map.intersections[0] if mount.tls is None else road_map.by_tls[mount.tls]
    return at.centre[0] + mount.x_m, at.centre[1] + mount.y_m


def mount_pose(mount: Mount, road_map: RoadMap, terrain: Terrain) -> SE3:
    """Returns `map_SE3_sensor` of a mount: upright, its height above the ground at its place."""
    x_m, y_m = mount_place(mount, road_map)
    at = road_map.intersections[0] if mount.tls is None else road_map.by_tls[mount.tls]
    ground_m = float(terrain.height_m(np.array([[x_m, y_m]]), at.centre[2])[0])
    yaw_rad = float(np.radians(mount.yaw_deg))
    return SE3.from_pose([x_m, y_m, ground_m + mount.height_m, 0, 0, yaw_rad])


def pose_above(pose: Floats, height_m: float) -> SE3:
    """Returns `map_SE3_sensor` of a sensor over what stands at a pose (6,), tilted with it."""
    return SE3.from_pose(pose) @ SE3(np.eye(3), np.array([0.0, 0.0, height_m]))


def driven(poses: Floats, ahead_m: Floats) -> Floats:
    """Returns poses (N, 6) so much (N,) farther along their heading."""
    pitch, yaw = poses[:, 4], poses[:, 5]
    result = poses.copy()
    result[:, 0] += ahead_m * np.cos(yaw) * np.cos(pitch)
    result[:, 1] += ahead_m * np.sin(yaw) * np.cos(pitch)
    result[:, 2] -= ahead_m * np.sin(pitch)
    return result


def estimated_pose(
    true_pose: npt.ArrayLike,
    config: PoseErrorConfig,
    equipment: Equipment,
    rng: np.random.Generator,
) -> Floats:
    """Returns the pose (6,) with errors drawn from normal distributions.

    A CAV localises itself against its LiDAR's map; a CV has satellite positioning alone and
    knows nothing of its tilt.

    Raises:
        ValueError: the equipment is `NONE`: such a vehicle has no pose to report.
    """
    if equipment == Equipment.NONE:
        raise ValueError("a vehicle without equipment reports no pose")
    pose = np.array(true_pose, np.float64)
    draw = rng.standard_normal(6)
    if equipment == Equipment.CV:
        xy, z, yaw = config.cv_position_std_m, config.cv_height_std_m, config.cv_heading_std_deg
        tilt = 0.0
        pose[3:5] = 0.0
    else:
        xy, z, yaw = config.position_std_m, config.height_std_m, config.heading_std_deg
        tilt = config.tilt_std_deg
    tilt_rad, yaw_rad = np.radians(tilt), np.radians(yaw)
    pose += draw * np.array([xy, xy, z, tilt_rad, tilt_rad, yaw_rad])
    pose[5] = wrap_angle(pose[5])
    return pose


class PoseEstimator:
    """Pose estimates of one CAV or CV, with their errors."""

    def __init__(
        self, config: PoseErrorConfig, seed: int, agent: str, equipment: Equipment
    ) -> None:
        self._config = config
        self._seed = seed
        self._agent = agent
        self._equipment = equipment
        self._bias, self._waves = np.zeros(6), np.zeros((0, 3, 6))
        if equipment == Equipment.CAV:
            self._draw_slow_errors(config)

    def _draw_slow_errors(self, config: PoseErrorConfig) -> None:
        """Draws the bias, and the drift's waves: rates in rad/s, phases and amplitudes (6,)."""
        yaw_rad = math.radians(config.bias_heading_std_deg)
        xy_m, z_m = config.bias_position_std_m, config.bias_height_std_m
        bias = stream(self._seed, "pose bias", self._agent).standard_normal(6)
        self._bias = bias * np.array([xy_m, xy_m, z_m, 0.0, 0.0, yaw_rad])
        yaw_rad = math.radians(config.drift_heading_std_deg)
        xy_m, z_m = config.drift_position_std_m, config.drift_height_std_m
        std = np.array([xy_m, xy_m, z_m, 0.0, 0.0, yaw_rad])
        if not std.any():
            return
        rng = stream(self._seed, "pose drift", self._agent)
        # The process's spectrum is a Cauchy distribution of rates; each wave has an equal share.
        share = (np.arange(_WAVES)[:, None] + rng.random((_WAVES, 6))) / _WAVES
        rates = np.tan(np.pi * (share - 0.5)) / config.drift_time_s
        phases = rng.uniform(0.0, 2 * np.pi, (_WAVES, 6))
        amplitudes = np.broadcast_to(std * math.sqrt(2 / _WAVES), (_WAVES, 6))
        self._waves = np.stack([rates, phases, amplitudes], axis=1)

    def slow_error(self, sim_time_ns: int) -> Floats:
        """Returns bias and drift (6,) at a time, in m and rad."""
        rates, phases, amplitudes = self._waves.transpose(1, 0, 2)
        drift = (amplitudes * np.cos(rates * (sim_time_ns / 1e9) + phases)).sum(axis=0)
        return np.asarray(self._bias + drift)

    def estimate(self, true_pose: npt.ArrayLike, frame: int, sim_time_ns: int) -> Floats:
        """Returns the agent's estimate of its pose (6,) in a frame.

        Raises:
            ValueError: as `estimated_pose`.
        """
        rng = stream(self._seed, "pose", self._agent, frame)
        pose = estimated_pose(true_pose, self._config, self._equipment, rng)
        slow = self.slow_error(sim_time_ns)
        if slow.any():
            pose += slow
            pose[5] = wrap_angle(pose[5])
        return pose


def position_std_m(config: PoseErrorConfig, equipment: Equipment) -> float:
    """Returns the standard deviation along x and y that an agent reports with its pose."""
    if equipment == Equipment.CV:
        return config.cv_position_std_m
    return math.hypot(
        config.position_std_m, config.bias_position_std_m, config.drift_position_std_m
    )


def installed_pose(surveyed: SE3, config: PoseErrorConfig, seed: int, agent: str) -> SE3:
    """Returns `map_SE3_sensor` of a roadside unit as it is, off from where it was surveyed."""
    tilt_rad, yaw_rad = np.radians([config.mount_tilt_std_deg, config.mount_heading_std_deg])
    std = np.array([*(config.mount_position_std_m,) * 3, tilt_rad, tilt_rad, yaw_rad])
    if not std.any():
        return surveyed
    return SE3.from_pose(surveyed.as_pose() + std * stream(seed, "mount", agent).standard_normal(6))


def clock_error_s(config: PoseErrorConfig, seed: int, agent: str) -> float:
    """Returns an agent's constant clock error: how much later it scans than it states."""
    if not config.clock_std_s:
        return 0.0
    return config.clock_std_s * float(stream(seed, "clock", agent).standard_normal())
