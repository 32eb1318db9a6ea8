"""An open ground: a road map for places of which there is none, so that all else works there."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from protocol.geometry import SE3, Floats
from protocol.roadmap import Lane, PlanPhase, RoadMap, Signal
from protocol.scans import PointCloud

NAME = "open-ground"
BEYOND_M = 100.0
_NEAR_M, _FAR_M = 2.5, 15.0  # around a vehicle: beyond its own body, where most beams hit ground
_LOW_M, _HIGH_M, _BIN_M = -8.0, 0.0, 0.05
_STEP_M = 2.0  # between the points of a ground's middle
_FASTEST_MPS = 60.0
_GREEN = "G"  # the one state of a signal that nobody minds


def height_over_ground_m(cloud: PointCloud, map_SE3_sensor: SE3) -> float:
    """Returns how high a sensor is over the ground, which most of what is near it belongs to.

    0 where it sees nothing below it.
    """
    level = cloud.points @ map_SE3_sensor.rotation.T
    away_m = np.hypot(level[:, 0], level[:, 1])
    near = level[(away_m > _NEAR_M) & (away_m < _FAR_M), 2]
    counts, edges = np.histogram(near, np.arange(_LOW_M, _HIGH_M + _BIN_M / 2, _BIN_M))
    if not counts.any():
        return 0.0
    around = np.convolve(counts, np.ones(3), "same")
    best = int(around.argmax())
    within = (near > edges[max(best - 1, 0)]) & (near < edges[min(best + 2, len(edges) - 1)])
    return -float(np.median(near[within]))


def open_ground(ways: Mapping[str, Floats], *, width_m: float) -> RoadMap:
    """Returns a map with one lane along each way, so broad that all that matters lies on it.

    Its height is that of the way, and so is its direction, which vehicles along it have as well.
    No lane leads to the signal, so that none is counted.

    Args:
        ways: poses (N, 6) on the ground by name, in the order in which they were passed.
        width_m: of the ground; before and behind a way it goes on for `BEYOND_M`.
    """
    lanes = [_lane(f"{NAME}-{name}", poses, width_m) for name, poses in ways.items()]
    centre = np.concatenate([poses[:, :3] for poses in ways.values()]).mean(axis=0)
    plan = [PlanPhase(duration_s=3600.0, state=_GREEN)]
    return RoadMap(
        name=NAME,
        centre=(float(centre[0]), float(centre[1]), float(centre[2])),
        lanes=lanes,
        signal=Signal(tls=NAME, links=[], conflicts=[], plan=plan),
        junction=[],
    )


def _lane(name: str, poses: Floats, width_m: float) -> Lane:
    middle = [poses[0, :3]]
    for place in poses[1:, :3]:
        if np.hypot(*(place - middle[-1])[:2]) >= _STEP_M:
            middle.append(place)
    line = np.stack([_beyond(poses[0], -BEYOND_M), *middle, _beyond(poses[-1], BEYOND_M)])
    return Lane(
        id=name,
        edge=name,
        width_m=width_m,
        speed_mps=_FASTEST_MPS,
        length_m=float(np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1).sum()),
        centreline=[(float(x), float(y), float(z)) for x, y, z in line],
    )


def _beyond(pose: Floats, ahead_m: float) -> Floats:
    """Returns a place (3,) ahead of a pose, at its height."""
    return pose[:3] + ahead_m * np.array([np.cos(pose[5]), np.sin(pose[5]), 0.0])
