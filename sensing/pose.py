"""What an agent believes about its own pose."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from protocol.geometry import Floats, wrap_angle
from protocol.messages import Equipment
from sensing.config import PoseErrorConfig


def believed_pose(
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
