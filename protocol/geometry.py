"""Rigid transforms. Frames: x forward, y left, z up; angles in radians; `dst_SE3_src`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class SE3:
    """A rigid transform `dst_SE3_src`: rotation (3, 3) and translation (3,) in metres."""

    rotation: Floats
    translation: Floats

    def __post_init__(self) -> None:
        for name, shape in (("rotation", (3, 3)), ("translation", (3,))):
            array = np.array(getattr(self, name), np.float64)
            if array.shape != shape:
                raise ValueError(f"SE3 {name} has shape {array.shape}, needs {shape}")
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    @classmethod
    def from_pose(cls, pose: npt.ArrayLike) -> SE3:
        """Builds the transform of a pose (6,): x, y, z in m; roll, pitch, yaw in rad.

        R = Rz(yaw) Ry(pitch) Rx(roll), as Chen et al. 2022, eq. 2.
        """
        x, y, z, roll, pitch, yaw = np.asarray(pose, np.float64)
        return cls(euler_rotation(roll, pitch, yaw), np.array([x, y, z]))

    @classmethod
    def identity(cls) -> SE3:
        """Returns the transform that changes nothing."""
        return cls(np.eye(3), np.zeros(3))

    def inverse(self) -> SE3:
        """Returns `src_SE3_dst`."""
        return SE3(self.rotation.T, -self.rotation.T @ self.translation)

    def __matmul__(self, other: SE3) -> SE3:
        """Composes: `a_SE3_b @ b_SE3_c` is `a_SE3_c`."""
        return SE3(
            self.rotation @ other.rotation, self.rotation @ other.translation + self.translation
        )

    def apply(self, points: npt.NDArray[np.floating]) -> Floats:
        """Moves points (N, 3) from the source frame to the destination frame."""
        return np.asarray(points @ self.rotation.T + self.translation)

    def as_pose(self) -> Floats:
        """Returns the pose (6,) that `from_pose` takes; pitch lies within ±pi/2."""
        r = self.rotation
        pitch = np.arcsin(np.clip(-r[2, 0], -1.0, 1.0))
        roll = np.arctan2(r[2, 1], r[2, 2])
        yaw = np.arctan2(r[1, 0], r[0, 0])
        return np.array([*self.translation, roll, pitch, yaw])


def euler_rotation(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Floats:
    """Returns Rz(yaw) Ry(pitch) Rx(roll), shape (3, 3)."""
    cr, sr = np.cos(roll_rad), np.sin(roll_rad)
    cp, sp = np.cos(pitch_rad), np.sin(pitch_rad)
    cy, sy = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def wrap_angle(angle_rad: npt.ArrayLike) -> Floats:
    """Wraps angles to [-pi, pi)."""
    return np.asarray((np.asarray(angle_rad) + np.pi) % (2 * np.pi) - np.pi)
