"""Motion check: whether an agent can have moved to its claimed pose since it was last plausible."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np

from perception.arrays import Floats
from protocol.geometry import euler_rotation
from protocol.messages import AgentPose

FAST = 1.5  # times the highest speed that a lane allows
LEAST_FAST_MPS = 15.0
CERTAIN = 6.0  # standard deviations
MOST_STD_M = 3.0  # that an agent may claim to its own advantage
SENSOR_STD_M = 1.0  # of a vehicle's place, where its sensor's alone is known
LANE_M = 4.0  # SUMO's vehicles change lanes at once
TURN_RAD = math.radians(45.0)  # between two frames, whatever the noise
TURN_M = 3.0  # driven per radian, beyond that
RSU_M = 0.5  # a roadside unit may be surveyed anew, not moved
RSU_RAD = math.radians(3.0)
MOUNT_M = 0.5  # by how much a sensor may move on its vehicle
MOUNT_RAD = math.radians(3.0)
FORGET_NS = 3_000_000_000  # after so long an agent may have turned in any direction
STEADY_FRAMES = 20  # in a new place, before it is accepted


@dataclass(frozen=True, slots=True, eq=False)
class ClaimedPose:
    """Pose (6,) that an agent claims, of a roadside unit its sensor's, and its standard deviation.

    `mount` (6,) is by how much its sensor stands ahead, to the left, over and turned of its own
    place, in the vehicle's frame: pitching moves a sensor on the roof by decimetres in the map's.
    None where it sent no scan.
    """

    sim_time_ns: int
    pose: Floats
    std_m: float
    is_rsu: bool
    mount: Floats | None = None

    @classmethod
    def of_rsu(cls, sim_time_ns: int, sensor_pose: Floats) -> Self:
        """Returns the pose of a roadside unit."""
        return cls(sim_time_ns, sensor_pose, 0.0, is_rsu=True)

    @classmethod
    def of(
        cls, sim_time_ns: int, pose: AgentPose | None, sensor_pose: Floats | None
    ) -> Self | None:
        """Returns the pose of a vehicle that sent its own, its sensor's, or both; else None."""
        if pose is None:
            if sensor_pose is None:
                return None
            return cls(sim_time_ns, sensor_pose, SENSOR_STD_M, is_rsu=False)
        std_m = min(pose.position_std_m, MOST_STD_M)
        if sensor_pose is None:
            return cls(sim_time_ns, pose.pose, std_m, is_rsu=False)
        mount = np.array(sensor_pose - pose.pose)
        mount[:3] = euler_rotation(*pose.pose[3:]).T @ mount[:3]
        return cls(sim_time_ns, pose.pose, std_m, is_rsu=False, mount=mount)

    def leads_to(self, later: ClaimedPose, fast_mps: float) -> bool:
        """Whether a vehicle at this pose can be at the later one."""
        if self.is_rsu or later.is_rsu:
            return self.is_rsu and later.is_rsu and _is_near(self.pose, later.pose, RSU_M)
        took_ns = max(later.sim_time_ns - self.sim_time_ns, 0)
        may_go_m = fast_mps * took_ns / 1e9 + CERTAIN * math.hypot(self.std_m, later.std_m)
        return self._is_mounted_as(later) and self._reaches(later, may_go_m, took_ns)

    def _is_mounted_as(self, later: ClaimedPose) -> bool:
        before, after = self.mount, later.mount
        if before is None or after is None:
            return True
        return _is_near(before, after, MOUNT_M, MOUNT_RAD)

    def _reaches(self, later: ClaimedPose, may_go_m: float, took_ns: int) -> bool:
        x, y, _, _, _, turn_rad = (later.pose - self.pose).tolist()
        along_m, across_m = _turned(float(self.pose[5]), x, y)
        turns = took_ns > FORGET_NS or _wrapped(turn_rad) <= TURN_RAD + may_go_m / TURN_M
        return turns and abs(along_m) <= may_go_m and abs(across_m) <= may_go_m + LANE_M


class MotionCheck:
    """Motion check of one agent: keeps its last plausible pose, and what it claims since.

    An agent that jumps is implausible until it has been steady in its new place for long enough:
    it may have restarted or relocalised.
    """

    __slots__ = ("_last", "_steady", "_there")

    def __init__(self) -> None:
        self._last: ClaimedPose | None = None
        self._there: ClaimedPose | None = None
        self._steady = 0

    def score(self, claimed: ClaimedPose, fast_mps: float) -> float:
        """Returns 1 if an agent can be there, else 0."""
        if self._last is None or self._last.leads_to(claimed, fast_mps):
            self._last, self._there, self._steady = claimed, None, 0
            return 1.0
        goes_on = self._there is not None and self._there.leads_to(claimed, fast_mps)
        self._there, self._steady = claimed, self._steady + 1 if goes_on else 0
        if self._steady >= STEADY_FRAMES:
            self._last = claimed
        return 0.0


def fastest_mps(speeds_mps: list[float]) -> float:
    """Returns how fast a vehicle can be where lanes allow these speeds."""
    return FAST * max([*speeds_mps, LEAST_FAST_MPS / FAST])


def _turned(yaw_rad: float, x: float, y: float) -> tuple[float, float]:
    """Returns how far ahead and how far to the left x and y lead."""
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    return cos * x + sin * y, cos * y - sin * x


def _wrapped(turn_rad: float) -> float:
    """Returns how large a turn is, 0 to pi."""
    return abs(math.remainder(turn_rad, math.tau))


def _is_near(pose: Floats, other: Floats, far_m: float, far_rad: float = RSU_RAD) -> bool:
    x, y, z, *turns = (other - pose).tolist()
    near = math.hypot(x, y, z) <= far_m
    return near and all(_wrapped(turn_rad) <= far_rad for turn_rad in turns)
