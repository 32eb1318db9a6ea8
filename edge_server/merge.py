"""Merge: every agent's points, moved into the map frame."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numba import njit

from edge_server.arrays import Floats, Floats32
from edge_server.frame import Piece
from protocol.geometry import SE3, euler_rotation

Method = Literal["se3", "euler"]


def merge(
    pieces: list[Piece], *, method: Method = "se3", reference_pose: Floats | None = None
) -> Floats32:
    """Returns all points (N, 3) in the map frame, in the order of the pieces.

    With `euler`, points go through the frame of a reference sensor whose pose (6,) is given, by
    the paper's differences of Euler angles; without a reference, through that of the first piece.
    """
    points = np.empty((sum(len(piece.points) for piece in pieces), 3), np.float32)
    start = 0
    for piece in pieces:
        end = start + len(piece.points)
        if method == "se3":
            map_se3_sensor = SE3.from_pose(piece.sensor_pose)
        else:
            reference = pieces[0].sensor_pose if reference_pose is None else reference_pose
            map_se3_sensor = by_angle_differences(piece.sensor_pose, reference)
        _move(piece.points, map_se3_sensor.rotation, map_se3_sensor.translation, points[start:end])
        start = end
    return points


def by_angle_differences(sensor_pose: Floats, reference_pose: Floats) -> SE3:
    """Returns `map_SE3_sensor` by way of a reference sensor, as Chen et al. 2022, eq. 1 and 2.

    The rotation between the two is built from the differences of their Euler angles, and the
    translation holds the difference of their mounting heights. Exact while both stand level; on a
    slope it is off by centimetres, which is why `se3` is the default.
    """
    map_se3_reference = SE3.from_pose(reference_pose)
    roll, pitch, yaw = sensor_pose[3:] - reference_pose[3:]
    offset = map_se3_reference.rotation.T @ (sensor_pose[:3] - reference_pose[:3])
    return map_se3_reference @ SE3(euler_rotation(roll, pitch, yaw), offset)


@njit(
    "void(Array(float32, 2, 'C', readonly=True), Array(float64, 2, 'A', readonly=True), "
    "Array(float64, 1, 'C', readonly=True), float32[:,::1])",
    cache=True,
)
def _move(points: Floats32, rotation: Floats, translation: Floats, out: Floats32) -> None:
    for index in range(points.shape[0]):
        x, y, z = points[index, 0], points[index, 1], points[index, 2]
        for axis in range(3):
            out[index, axis] = (
                rotation[axis, 0] * x
                + rotation[axis, 1] * y
                + rotation[axis, 2] * z
                + translation[axis]
            )
