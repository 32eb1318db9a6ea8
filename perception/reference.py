"""The paper's detector to the letter (Chen et al. 2022), by Open3D: RANSAC, DBSCAN, bare boxes.

Planes go through the whole cloud, boxes hold a cluster's points and no more. Of the configuration
only the paper's own parameters are read. Open3D comes with the extra `reference`.

Its DBSCAN lists all neighbours of all points. Where that would not fit into memory, `fast`'s takes
its place: the same clusters, but for border points of two, which are noise to neither.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from itertools import pairwise
from types import ModuleType
from typing import Any

import numpy as np

from perception.arrays import Bools, Floats, Floats32, Ints32
from perception.boxes import certainty
from perception.cells import Cells
from perception.cluster import cluster
from perception.config import BoxConfig, DetectionConfig, GroundConfig
from perception.detector import Cloud, Stage, Vehicles, untimed
from perception.roadway import merge
from protocol.errors import ConfigError

PACKAGES = ("libusb-1.0-0", "libgl1", "libgomp1")
MOST_PAIRS = 200_000_000  # of neighbours: Open3D keeps a list of them all, 4 bytes each
BALL = 4 / 3 * np.pi  # cubes in a ball with their side as its radius
AT_ONCE = 1 << 16  # points that are turned; bounds the memory that a cluster takes
TURNS_RAD = np.radians(np.arange(90.0))  # a rectangle comes back to itself after 90 degrees


def load_open3d() -> ModuleType:
    """Imports Open3D.

    Raises:
        ConfigError: it is not installed, or a system library that it needs is not.
    """
    try:
        import open3d
    except ImportError as error:
        missing = error.name == "open3d" and isinstance(error, ModuleNotFoundError)
        advice = f"{sys.executable} -m pip install open3d" if missing else str(error)
        raise ConfigError(
            f"the detector `reference` needs Open3D: {advice}. It comes with the extra `reference` "
            f"and links to system libraries: apt-get install {' '.join(PACKAGES)}"
        ) from None
    module: ModuleType = open3d
    return module


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceDetector:
    """Open3D and the paper's parameters."""

    config: DetectionConfig
    open3d: Any

    @classmethod
    def of(cls, config: DetectionConfig) -> ReferenceDetector:
        """Loads Open3D.

        Raises:
            ConfigError: it cannot be loaded.
        """
        return cls(config, load_open3d())

    def detect(self, cloud: Cloud, rng: np.random.Generator, stage: Stage = untimed) -> Vehicles:
        """See `perception.detector.Detector.detect`."""
        # Open3D has one generator for the whole process: what else draws from it in the same
        # process gets another sequence from here on.
        self.open3d.utility.random.seed(int(rng.integers(2**31)))
        with stage("ground"):
            above = self._without_planes(merge(cloud.near)[0], self.config.ground)
            above = np.concatenate([above, merge(cloud.bare)[0]])
        with stage("detect"):
            return self._boxes(above, self._clusters(above))

    def _without_planes(self, points: Floats32, config: GroundConfig) -> Floats32:
        """Removes the planes with most points, one after the other."""
        left = self._cloud(points)
        for _ in range(config.runs):
            if len(left.points) < 3:
                break
            _, on_plane = left.segment_plane(
                distance_threshold=config.distance_m,
                ransac_n=3,
                num_iterations=config.max_iterations,
            )
            left = left.select_by_index(on_plane, invert=True)
        return np.asarray(left.points).astype(np.float32).reshape(-1, 3)

    def _clusters(self, points: Floats32) -> Ints32:
        """Returns the cluster of each point (N,); -1 is noise."""
        if len(points) == 0:
            return np.zeros(0, np.int32)
        config = self.config.cluster
        if _pairs(points, config.eps_m) > MOST_PAIRS:
            return cluster(points, config=config)
        found = self._cloud(points).cluster_dbscan(eps=config.eps_m, min_points=config.min_points)
        return np.asarray(found, np.int32)

    def _cloud(self, points: Floats32) -> Any:  # noqa: ANN401 - Open3D is untyped
        vector = self.open3d.utility.Vector3dVector(np.ascontiguousarray(points, np.float64))
        return self.open3d.geometry.PointCloud(vector)

    def _boxes(self, points: Floats32, labels: Ints32) -> Vehicles:
        """Returns a box for each cluster that is as large as a vehicle may be.

        The paper gives clusters no score; here those with more points come first.
        """
        order = np.argsort(labels, kind="stable")
        ends = np.searchsorted(labels[order], np.arange(labels.max(initial=-1) + 2))
        clusters = [points[order[a:b]] for a, b in pairwise(ends)]
        boxes = np.array([smallest_box(members) for members in clusters]).reshape(-1, 7)
        scores = certainty(np.array([len(members) for members in clusters]))
        found = Vehicles.from_lidar(boxes, scores)
        return found.take(_fits(boxes[:, 3:6], self.config.boxes))


def _fits(sizes_m: Floats, config: BoxConfig) -> Bools:
    """The size filter, on what was measured (C, 3): length, width and height."""
    sides = zip(("length", "width", "height"), sizes_m.T, strict=True)
    fits = [
        (size_m >= getattr(config, f"min_{side}_m")) & (size_m <= getattr(config, f"max_{side}_m"))
        for side, size_m in sides
    ]
    return np.asarray(np.logical_and.reduce(fits))


def _pairs(points: Floats32, eps_m: float) -> float:
    """Returns about how many pairs of neighbours there are in points spread evenly over cells."""
    together = np.diff(Cells.of(points, eps_m).starts).astype(np.float64)
    return float((together**2).sum()) * BALL


def smallest_box(points: Floats32) -> Floats:
    """Returns the upright box (7,) of least area around points (N, 3), to the degree."""
    middle = points.mean(axis=0, dtype=np.float64)
    local = points - middle
    cos, sin = np.cos(TURNS_RAD), np.sin(TURNS_RAD)
    low, high = np.full((2, len(TURNS_RAD)), np.inf), np.full((2, len(TURNS_RAD)), -np.inf)
    for first in range(0, len(local), AT_ONCE):
        x, y = local[first : first + AT_ONCE, :2].T
        along, across = np.outer(x, cos) + np.outer(y, sin), np.outer(y, cos) - np.outer(x, sin)
        low = np.minimum(low, [along.min(axis=0), across.min(axis=0)])
        high = np.maximum(high, [along.max(axis=0), across.max(axis=0)])
    best = int(np.argmin(np.prod(high - low, axis=0)))
    extents = [*zip(low[:, best], high[:, best], strict=True)]
    extents.append((local[:, 2].min(), local[:, 2].max()))
    (u, v, z), sizes = np.mean(extents, axis=1), np.ptp(extents, axis=1)
    x, y = cos[best] * u - sin[best] * v, sin[best] * u + cos[best] * v
    yaw = TURNS_RAD[best]
    if sizes[1] > sizes[0]:
        yaw, sizes = yaw + np.pi / 2, sizes[[1, 0, 2]]
    return np.array([*(middle + np.array([x, y, z])), *sizes, yaw])
