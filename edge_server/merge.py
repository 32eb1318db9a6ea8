"""Merge: where each agent's sensor stands in the map."""

from __future__ import annotations

from edge_server.config import MergeMethod
from perception.arrays import Floats
from protocol.geometry import SE3, euler_rotation


def sensor_in_map(sensor_pose: Floats, *, method: MergeMethod, reference_pose: Floats) -> SE3:
    """Returns `map_SE3_sensor`: exact, or with `euler` by way of a reference sensor's pose (6,)."""
    if method == "se3":
        return SE3.from_pose(sensor_pose)
    return by_angle_differences(sensor_pose, reference_pose)


def by_angle_differences(sensor_pose: Floats, reference_pose: Floats) -> SE3:
    """Returns `map_SE3_sensor` by way of a reference sensor, as Chen et al. 2022, eq. 1 and 2.

    The rotation between the two is built from the differences of their Euler angles, and the
    translation holds the difference of their mounting heights. Exact while both stand level; on a
    slope it is off by centimetres, which is why `se3` is the default.
    """
    map_SE3_reference = SE3.from_pose(reference_pose)
    roll, pitch, yaw = sensor_pose[3:] - reference_pose[3:]
    offset = map_SE3_reference.rotation.T @ (sensor_pose[:3] - reference_pose[:3])
    return map_SE3_reference @ SE3(euler_rotation(roll, pitch, yaw), offset)
