"""Poses of sensors on masts and roofs, and the pose that an agent believes to have."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from protocol.geometry import SE3, Floats, wrap_angle
from protocol.messages import Equipment
from protocol.roadmap import RoadMap
from sensing.config import Mount, PoseErrorConfig
from sensing.terrain import Terrain


def mount_place(mount: Mount, road_map: RoadMap) -> tuple[float, float]:
    """Returns x and y of a mount; without a junction named, of the map's only one."""
    at = road_map.intersections[0] if mount.tls is None else road_map.by_tls[mount.tls]
    return at.centre[0] + mount.x_m, at.centre[1] + mount.y_m


def mount_pose(mount: Mount, road_map: RoadMap, terrain: Terrain) -> SE3:
    """Returns `map_SE3_sensor` of a mount: upright, its height above the ground at its place."""
    x_m, y_m = mount_place(mount, road_map)
    ground_m = float(terrain.height_m(np.array([[x_m, y_m]]))[0])
    yaw_rad = float(np.radians(mount.yaw_deg))
    return SE3.from_pose([x_m, y_m, ground_m + mount.height_m, 0, 0, yaw_rad])


def pose_above(pose: Floats, height_m: float) -> SE3:
    """Returns `map_SE3_sensor` of a sensor over what stands at a pose (6,), tilted with it."""
    return SE3.from_pose(pose) @ SE3(np.eye(3), np.array([0.0, 0.0, height_m]))


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
        ValueError: the equipment is `NONE`: such a vehicle knows no pose to tell.
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


def position_std_m(config: PoseErrorConfig, equipment: Equipment) -> float:
    """Returns the standard deviation along x and y that an agent reports with its pose."""
    return config.cv_position_std_m if equipment == Equipment.CV else config.position_std_m
