"""Static map: voxels beside the road, learnt from scans of agents whose poses are right.

A scan is thinned to its structure: points off the road, one a voxel; objects on the road move, or
will. Voxels that were seen repeatedly are the map. Scans are registered to it by point-to-plane ICP
(`small_gicp`: Koide 2024, Journal of Open Source Software 9(100), 6948).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import small_gicp
from numba import njit

from perception.arrays import Floats, Floats32, Ints
from perception.roadway import Roadway
from protocol.geometry import SE3, euler_rotation

VOXEL_M = 1.0
NEAR_M, FAR_M = 3.0, 120.0  # of a sensor: nearer is its own vehicle, beyond beams lie far apart
MOST_POINTS = 1200  # of a scan's structure: are registered
SLOTS = 1 << 15  # for a scan's voxels; half of them are used at most
SEEN = 3  # scans: a voxel that was in so many stays
MOST_VOXELS = 200_000
LEAST_VOXELS = 300  # fewer are no map
GROWTH = 0.1  # of the voxels that stay, until the map is prepared anew
NEIGHBOURS = 12  # voxels that give one its normal
KNOWN_M = 1.5  # from a voxel: where the map knows what is there
FITS_M = 0.15  # from a voxel's plane: a point that fits
LEVEL = 0.9  # the upward part of a normal, from which on a plane is ground
# A point's error with all that points have in common, which their number does not make smaller.
ERROR_M = 1.0
TILT_STD_RAD = np.radians(0.3)  # of an agent's own roll and pitch
ITERATIONS = 15

_MAP_BITS = 21  # of a voxel's number along each axis
_SCAN_BITS = 13


def structure(points: Floats32, pose: Floats, roadway: Roadway) -> Floats32:
    """Returns the static structure beside the road in a scan, thinned.

    Args:
        points: (N, 3), sensor frame.
        pose: (6,) `map_SE3_sensor` as the agent estimates it.
        roadway: the road.

    Returns:
        Points (M, 3) along the map's axes from the sensor.
    """
    rotation = SE3.from_pose(pose).rotation.astype(np.float32)
    grid = np.array([*roadway.origin_m, 1 / roadway.cell_m])
    kept = np.empty((min(len(points), SLOTS // 2), 3), np.float32)
    table = np.full(SLOTS, -1, np.int64)
    count = _structure(points, rotation, pose[:2].copy(), grid, roadway.height_m, table, kept)
    return kept[:count]


@njit(
    "int64(float32[:,::1], float32[:,::1], float64[::1], float64[::1], float32[:,::1], int64[::1], "
    "float32[:,::1])",
    cache=True,
    nogil=True,
)
def _structure(
    points: Floats32,
    rotation: Floats32,
    origin: Floats,
    grid: Floats,
    height_m: Floats32,
    table: Ints,
    kept: Floats32,
) -> int:
    """Copies the first point of each voxel off the road; returns their number."""
    rows, columns = height_m.shape
    count, mask, half = 0, table.size - 1, 1 << (_SCAN_BITS - 1)
    for index in range(points.shape[0]):
        u, v, w = points[index, 0], points[index, 1], points[index, 2]
        square = u * u + v * v
        if not NEAR_M * NEAR_M <= square <= FAR_M * FAR_M or not abs(w) <= FAR_M:
            continue
        if count == kept.shape[0]:
            break
        x = rotation[0, 0] * u + rotation[0, 1] * v + rotation[0, 2] * w
        y = rotation[1, 0] * u + rotation[1, 1] * v + rotation[1, 2] * w
        z = rotation[2, 0] * u + rotation[2, 1] * v + rotation[2, 2] * w
        column, row = (x + origin[0] - grid[0]) * grid[2], (y + origin[1] - grid[1]) * grid[2]
        is_inside = 0 <= row < rows and 0 <= column < columns
        if is_inside and not np.isnan(height_m[int(row), int(column)]):
            continue
        i, j, k = np.floor(x / VOXEL_M), np.floor(y / VOXEL_M), np.floor(z / VOXEL_M)
        key = ((int(i) + half << _SCAN_BITS) + int(j) + half << _SCAN_BITS) + int(k) + half
        slot = (key * 0x9E3779B1 >> 7) & mask
        while table[slot] != -1 and table[slot] != key:
            slot = (slot + 1) & mask
        if table[slot] == -1:
            table[slot] = key
            kept[count, 0], kept[count, 1], kept[count, 2] = x, y, z
            count += 1
    return count


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A scan as it was registered to the map.

    `offset` (4,) is by how much the claimed pose of the sensor is off: x, y, z in m, yaw in rad;
    `covariance` (4, 4) is its own, large along what the structure does not tell. `known` points lie
    where the map knows what is there; the share `inliers` of them fits it.
    """

    offset: Floats
    covariance: Floats
    known: int
    inliers: float


class StaticMap:
    """Voxels by their number, each with the sum of its points and in how many scans it was."""

    def __init__(self) -> None:
        self._keys: Ints = np.zeros(0, np.int64)
        self._sums: Floats = np.zeros((0, 3))
        self._seen: Ints = np.zeros(0, np.int64)
        self._origin: Floats = np.zeros(3)
        self._target: _Target | None = None

    @property
    def is_ready(self) -> bool:
        """Whether there is a map to register scans to."""
        return self._target is not None

    def add(self, points: Floats) -> None:
        """Adds a scan's structure (M, 3), map frame."""
        if not len(points):
            return
        if not len(self._keys):
            self._origin = np.floor(points.mean(axis=0))
        points = points - self._origin
        keys, first = np.unique(_numbers(points), return_index=True)
        points = points[first]
        at = np.searchsorted(self._keys, keys)
        is_known = np.zeros(len(keys), np.bool_)
        inside = at < len(self._keys)
        is_known[inside] = self._keys[at[inside]] == keys[inside]
        self._sums[at[is_known]] += points[is_known]
        self._seen[at[is_known]] += 1
        if len(self._keys) < MOST_VOXELS:
            at, new = at[~is_known], ~is_known
            self._keys = np.insert(self._keys, at, keys[new])
            self._sums = np.insert(self._sums, at, points[new], axis=0)
            self._seen = np.insert(self._seen, at, 1)
        self._prepare()

    def fit(self, points: Floats32, sensor_m: Floats, guess: Floats, reach_m: float) -> Fit:
        """Registers a scan to the map, which must be ready.

        Args:
            points: (M, 3), as `structure` returns them; some of them are used if they are many.
            sensor_m: (3,) where the agent takes its sensor to be, map frame.
            guess: (4,) the offset to begin with.
            reach_m: how far from the map a point may be to be matched; 0 does not move the scan.
        """
        if self._target is None:
            raise RuntimeError("there is no map yet to register a scan to")
        points = points[:: max(-(-len(points) // MOST_POINTS), 1)]
        at_m = sensor_m - self._origin
        motion, information = np.eye(4), np.zeros((6, 6))
        motion[:3, :3] = euler_rotation(0.0, 0.0, -guess[3])
        motion[:3, 3] = at_m - guess[:3]
        if reach_m > 0:
            motion, information = self._target.register(points, motion, reach_m)
        off_m = self._target.off_m(points @ motion[:3, :3].T + motion[:3, 3])
        yaw_rad = -float(np.arctan2(motion[1, 0], motion[0, 0]))
        return Fit(
            offset=np.array([*(at_m - motion[:3, 3]), yaw_rad]),
            covariance=_covariance(information),
            known=len(off_m),
            inliers=float((off_m < FITS_M).mean()) if len(off_m) else 0.0,
        )

    def _prepare(self) -> None:
        """Prepares the voxels that stay for registration, if they have grown by enough."""
        stays = self._seen >= SEEN
        size, before = int(stays.sum()), self._target.size if self._target else 0
        if size >= max(LEAST_VOXELS, before * (1 + GROWTH)):
            self._target = _Target(self._sums[stays] / self._seen[stays][:, None])


class _Target:
    """Points with normals and a tree, which small_gicp registers to."""

    def __init__(self, points: Floats) -> None:
        self.size = len(points)
        self._cloud = small_gicp.PointCloud(points)
        self._tree = small_gicp.KdTree(self._cloud)
        small_gicp.estimate_normals(self._cloud, self._tree, NEIGHBOURS)
        self._points = points
        self._normals: Floats = np.array(self._cloud.normals())[:, :3]

    def register(self, points: Floats32, start: Floats, reach_m: float) -> tuple[Floats, Floats]:
        """Returns the motion (4, 4) of points and its information (6, 6): rotation, translation."""
        found = small_gicp.align(
            self._cloud,
            small_gicp.PointCloud(points.astype(np.float64)),
            self._tree,
            start,
            registration_type="PLANE_ICP",
            max_correspondence_distance=reach_m,
            num_threads=1,
            max_iterations=ITERATIONS,
        )
        return np.array(found.T_target_source), np.array(found.H)

    def off_m(self, points: Floats) -> Floats:
        """Returns how far the points (M, 3) near the map lie from the planes of it (K,).

        Those on level ground are left out: they fit wherever a scan is put.
        """
        nearest, squares = map(np.asarray, self._tree.batch_nearest_neighbor_search(points))
        near = squares < KNOWN_M**2
        normals = self._normals[nearest[near]]
        gaps = points[near] - self._points[nearest[near]]
        off_m = np.abs((normals * gaps).sum(axis=1))
        is_ground = (np.abs(normals[:, 2]) > LEVEL) & (off_m < FITS_M)
        return np.asarray(off_m[~is_ground])


def _numbers(points: Floats) -> Ints:
    """Returns the numbers of the voxels that points (M, 3) lie in."""
    i, j, k = (np.floor(points / VOXEL_M).astype(np.int64) + (1 << (_MAP_BITS - 1))).T
    return np.asarray(((i << _MAP_BITS) + j << _MAP_BITS) + k)


def _covariance(information: Floats) -> Floats:
    """Returns the covariance (4, 4) of x, y, z and yaw, whatever the tilt.

    Very large in directions in which the information (6, 6) of a registration is zero.
    """
    prior = np.diag([TILT_STD_RAD**-2, TILT_STD_RAD**-2, 1e-2, 1e-4, 1e-4, 1e-4])
    order = [3, 4, 5, 2]
    return np.asarray(np.linalg.inv(information / ERROR_M**2 + prior)[np.ix_(order, order)])
