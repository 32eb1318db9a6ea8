"""The paper's clustering detector: ground off, DBSCAN, a box per cluster (Chen et al. 2022)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perception.boxes import fit_boxes
from perception.cluster import cluster
from perception.config import DetectionConfig
from perception.detector import Cloud, Stage, untimed
from perception.ground import remove_ground
from perception.roadway import Roadway, merge
from perception.split import split
from perception.vehicles import Vehicles


@dataclass(frozen=True, slots=True, eq=False)
class Clustering:
    """The stages with their parameters, on a road."""

    config: DetectionConfig
    roadway: Roadway

    def detect(self, cloud: Cloud, rng: np.random.Generator, stage: Stage = untimed) -> Vehicles:
        """See `perception.detector.Detector.detect`."""
        with stage("ground"):
            above, ground_m = remove_ground(cloud.near, config=self.config.ground, rng=rng)
            if cloud.bare:
                bare, road_m = merge(cloud.bare)
                above = np.concatenate([above, bare])
                ground_m = np.concatenate([ground_m, road_m])
        with stage("detect"):
            labels = cluster(above, config=self.config.cluster)
            longest_m = float(
                np.hypot(self.config.boxes.max_length_m, self.config.boxes.max_width_m)
            )
            labels = split(above, labels, config=self.config.cluster, longest_m=longest_m)
            return fit_boxes(
                above,
                ground_m,
                labels,
                roadway=self.roadway,
                sensors=cloud.sensors,
                config=self.config.boxes,
            )
