"""CARLA's coordinates and ours.

CARLA's world is left-handed: x east, y south, z up; a sensor's x forward, y right, z up. Its angles
are in degrees: yaw clockwise from above, pitch up, roll to the right. Ours is right-handed: x east,
y north; x forward, y left. Mirroring y leads from either to the other.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from perception.arrays import Floats, Floats32, Ints
from protocol.scans import RangeScan, ScanPattern


def carla_pose(map_pose: npt.ArrayLike, net_offset_m: tuple[float, float]) -> Floats:
    """Returns x, y, z in m and roll, pitch, yaw in deg (6,), as CARLA has them, of a map pose."""
    x, y, z, roll, pitch, yaw = np.asarray(map_pose, np.float64)
    angles_deg = np.degrees([roll, -pitch, -yaw])
    return np.array([x - net_offset_m[0], net_offset_m[1] - y, z, *angles_deg])


def scan_of(measured: Floats32, pattern: ScanPattern) -> RangeScan:
    """Returns the scan of points (N, 4): x, y, z in CARLA's sensor frame, intensity.

    Each point goes to the beam that its direction is nearest to, and of several the nearest counts;
    what lies more than half a ring beyond the pattern is left out.
    """
    points = measured[:, :3].astype(np.float64) * [1, -1, 1]
    range_m = np.linalg.norm(points, axis=1)
    known = np.isfinite(range_m) & (range_m > 0)
    points, range_m, intensity = points[known], range_m[known], measured[known, 3]
    rings, columns = _beams(points / range_m[:, None], pattern)
    within = np.flatnonzero((rings >= 0) & (rings < pattern.channels))
    order = within[np.argsort(-range_m[within], kind="stable")]  # the nearest is written last
    planes = np.zeros((2, pattern.channels, pattern.columns), np.float32)
    planes[0, rings[order], columns[order]] = range_m[order]
    planes[1, rings[order], columns[order]] = np.clip(intensity[order], 0, 1)
    return RangeScan(pattern, planes[0], planes[1])


def _beams(directions: Floats, pattern: ScanPattern) -> tuple[Ints, Ints]:
    """Returns ring and column (N,) of unit vectors (N, 3) in our sensor frame."""
    below_deg = pattern.upper_fov_deg - np.degrees(np.arcsin(np.clip(directions[:, 2], -1, 1)))
    span_deg = pattern.upper_fov_deg - pattern.lower_fov_deg
    step_deg = span_deg / (pattern.channels - 1) if pattern.channels > 1 and span_deg else 1.0
    turns = np.arctan2(directions[:, 1], directions[:, 0]) / (2 * np.pi)
    rings, columns = np.rint(below_deg / step_deg), np.rint(turns * pattern.columns)
    return rings.astype(np.int64), columns.astype(np.int64) % pattern.columns
