"""Detection on the agent: boxes go over the network in the place of points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from perception.config import DetectionConfig, GeofenceConfig
from perception.detector import Cloud, Detector, Vehicles
from perception.registry import detector_of
from perception.roadway import Roadway
from protocol.geometry import SE3
from protocol.roadmap import RoadMap
from protocol.scans import RangeScan


@dataclass(frozen=True, slots=True, eq=False)
class OnBoard:
    """The edge's detector, with its parameters, on one agent's scan alone."""

    roadway: Roadway
    geofence: GeofenceConfig
    detector: Detector

    @classmethod
    def of(cls, road_map: RoadMap, edge: dict[str, Any]) -> OnBoard:
        """Builds it from the scenario's section of the edge."""
        chosen = {name: edge[name] for name in DetectionConfig.model_fields}
        config = DetectionConfig.model_validate(chosen)
        roadway = Roadway.of(road_map, margin_m=config.geofence.margin_m)
        return cls(roadway, config.geofence, detector_of(config, roadway))

    def detect(
        self, scan: RangeScan, map_SE3_sensor: SE3, rng: np.random.Generator, *, ground_free: bool
    ) -> Vehicles:
        """Returns the vehicles in a scan, in the map frame; `ground_free` scans have no ground."""
        placed = self.roadway.place(
            scan.cloud().points,
            map_SE3_sensor,
            below_m=self.geofence.below_m,
            above_m=self.geofence.above_m,
        )
        near, bare = ([], [placed]) if ground_free else ([placed], [])
        return self.detector.detect(Cloud(near, bare, map_SE3_sensor.translation[None]), rng)
