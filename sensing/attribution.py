"""Which body each return came from."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from protocol.codec import ScanPattern
from protocol.geometry import SE3, Floats, euler_rotation

_SLACK_M = 0.02  # single precision at the range's end


def owners(
    distance_m: npt.NDArray[np.float32],
    bare_m: npt.NDArray[np.float32],
    pattern: ScanPattern,
    map_SE3_sensor: SE3,
    bodies: tuple[Floats, Floats],
) -> npt.NDArray[np.int64]:
    """Returns for each beam (channels, columns) the index of the body that it ends on, or -1.

    A beam ends on a body if that is nearer than the static scene; the body is the one whose box
    the beam's clean end lies in.

    Args:
        distance_m: clean distances, of the scene with its bodies.
        bare_m: the same, of the scene alone.
        pattern: the beams.
        map_SE3_sensor: where the sensor truly is.
        bodies: poses (N, 6) of footprints' centres, and sizes (N, 3) in m.
    """
    result = np.full(distance_m.shape, -1, np.int64)
    hit = distance_m < bare_m
    ends = map_SE3_sensor.apply(pattern.directions[hit] * distance_m[hit][:, None].astype(float))
    found = np.full(len(ends), -1, np.int64)
    x, y = np.ascontiguousarray(ends[:, :2].T)
    for index, (pose, size_m) in enumerate(zip(*bodies, strict=True)):
        reach_m = float(np.linalg.norm(size_m)) + _SLACK_M
        beside = (np.abs(x - pose[0]) < reach_m) & (np.abs(y - pose[1]) < reach_m)
        near = np.flatnonzero(beside)
        local = (ends[near] - pose[:3]) @ euler_rotation(*pose[3:])
        local[:, 2] -= size_m[2] / 2
        inside = (np.abs(local) <= size_m / 2 + _SLACK_M).all(axis=1)
        found[near[inside]] = index
    result[hit] = found
    return result


def counts(
    owner: npt.NDArray[np.int64], range_m: npt.NDArray[np.float32], bodies: int
) -> npt.NDArray[np.int64]:
    """Counts by body (bodies,) the beams that end on it and return."""
    return np.bincount(owner[(owner >= 0) & (range_m > 0)], minlength=bodies)
