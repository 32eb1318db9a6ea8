"""Where sensors are: on posts, and on vehicles' roofs."""

from __future__ import annotations

import numpy as np

from protocol.geometry import SE3, Floats
from protocol.roadmap import RoadMap
from sensing.config import Mount
from sensing.terrain import Terrain


def mounted(mount: Mount, road_map: RoadMap, terrain: Terrain) -> SE3:
    """Returns `map_SE3_sensor` of a mount: upright, its height above the ground at its place."""
    x_m, y_m = road_map.centre[0] + mount.x_m, road_map.centre[1] + mount.y_m
    ground_m = float(terrain.height_m(np.array([[x_m, y_m]]))[0])
    yaw_rad = float(np.radians(mount.yaw_deg))
    return SE3.from_pose([x_m, y_m, ground_m + mount.height_m, 0, 0, yaw_rad])


def above(pose: Floats, height_m: float) -> SE3:
    """Returns `map_SE3_sensor` of a sensor over what stands at a pose (6,), tilted with it."""
    return SE3.from_pose(pose) @ SE3(np.eye(3), np.array([0.0, 0.0, height_m]))
