"""The detector `fast` (Chen et al. 2022): ground removal, DBSCAN, a box per cluster.

Clusters too long for a car are split: in a dense cloud, a queue is one cluster. Parts of lorries
and buses are joined again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numba import njit

from perception.arrays import Bools, Floats32, Ints, Ints32
from perception.boxes import fit_boxes, main_sensors
from perception.cluster import NOISE, cluster, renumber
from perception.clusters import Clusters
from perception.config import ClusterConfig, DetectionConfig
from perception.detector import Cloud, Stage, Vehicles, untimed
from perception.ground import remove_ground
from perception.large_vehicles import join_parts
from perception.object_classes import LONGEST_VEHICLE_M, WIDEST_VEHICLE_M
from perception.roadway import Roadway, merge
from perception.solid import solid_of

LONGEST_M = float(np.hypot(6.0, 3.0))  # of a car or van: what is longer may be several vehicles
WIDEST_M = 2.9  # the same of the shorter side, along the axes: two cars abreast
CLOSEST = 0.6  # of `split_eps_m`: a lorry beside parked cars keeps half a metre


def split(points: Floats32, labels: Ints32, *, config: ClusterConfig) -> Ints32:
    """Splits clusters: larger than a car with `split_eps_m`, larger than any vehicle more finely.

    Takes and returns the clusters of points (N, 3) as labels (N,), numbered by their first points;
    -1 is noise.
    """
    if config.split_eps_m is None:
        return labels
    closer = config.model_copy(update={"eps_m": config.split_eps_m})
    closest = config.model_copy(update={"eps_m": config.split_eps_m * CLOSEST})

    def parted(points: Floats32) -> Ints32:
        vehicle_m = (LONGEST_VEHICLE_M, WIDEST_VEHICLE_M)
        labels = cluster(points, config=closer)
        return _parted(points, labels, vehicle_m, partial(cluster, config=closest))

    return _parted(points, labels, (LONGEST_M, WIDEST_M), parted)


def _parted(
    points: Floats32,
    labels: Ints32,
    most_m: tuple[float, float],
    clustered: Callable[[Floats32], Ints32],
) -> Ints32:
    """Clusters anew what is longer, or to both sides wider, than so many metres."""
    clusters = Clusters.of(labels)
    too_large = _too_large(points, clusters.runs, clusters.count, *most_m)
    if not too_large.any():
        return labels
    again = np.flatnonzero((labels != NOISE) & too_large[labels])
    parts = clustered(points[again])
    result = labels.copy()
    result[again] = np.where(parts >= 0, parts + clusters.count, NOISE)
    renumber(result)
    return result


@njit("boolean[::1](float32[:,::1], int64[:,::1], int64, float64, float64)", cache=True)
def _too_large(
    points: Floats32, runs: Ints, count: int, longest_m: float, widest_m: float
) -> Bools:
    """Marks which of so many clusters (C,) are longer, or to both sides wider, than allowed."""
    assert points.shape[1] == 3
    low = np.full((count, 2), np.float32(np.inf))
    high = np.full((count, 2), np.float32(-np.inf))
    for run in range(runs.shape[0]):
        label, first, end = runs[run, 0], runs[run, 1], runs[run, 2]
        low_x, low_y = low[label, 0], low[label, 1]
        high_x, high_y = high[label, 0], high[label, 1]
        for index in range(first, end):
            x, y = points[index, 0], points[index, 1]
            low_x, high_x = x if x < low_x else low_x, x if x > high_x else high_x
            low_y, high_y = y if y < low_y else low_y, y if y > high_y else high_y
        low[label, 0], low[label, 1] = low_x, low_y
        high[label, 0], high[label, 1] = high_x, high_y
    too_large = np.empty(count, np.bool_)
    for label in range(count):
        sides_m = high[label] - low[label]
        is_long = sides_m[0] ** 2 + sides_m[1] ** 2 > longest_m**2
        too_large[label] = is_long or min(sides_m[0], sides_m[1]) > widest_m
    return too_large


@dataclass(frozen=True, slots=True, eq=False)
class FastDetector:
    """The stages with their parameters, on a road."""

    config: DetectionConfig
    roadway: Roadway

    def detect(self, cloud: Cloud, rng: np.random.Generator, stage: Stage = untimed) -> Vehicles:
        """See `perception.detector.Detector.detect`."""
        with stage("ground"):
            above, ground_m, sizes = remove_ground(cloud.near, config=self.config.ground, rng=rng)
            if cloud.bare:
                bare, road_m = merge(cloud.bare)
                above = np.concatenate([above, bare])
                ground_m = np.concatenate([ground_m, road_m])
                sizes = np.append(sizes, [len(part.points) for part in cloud.bare])
        with stage("detect"):
            labels = cluster(above, config=self.config.cluster)
            parts = Clusters.of(split(above, labels, config=self.config.cluster))
            clusters = join_parts(above, ground_m, parts, roadway=self.roadway)
            sensors = main_sensors(clusters, sizes, cloud.sensors)
            found = fit_boxes(
                above,
                ground_m,
                clusters,
                roadway=self.roadway,
                sensors=sensors,
                completed=self.config.boxes.completed,
            )
            if not self.config.solid_only:
                return found
            return solid_of(found, cloud, self.roadway, unmapped=True)
