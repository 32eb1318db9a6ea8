"""Detection on the agent: boxes go over the network in the place of points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from perception.boxes import fit_boxes
from perception.cluster import cluster
from perception.config import BoxConfig, ClusterConfig, GeofenceConfig, GroundConfig
from perception.ground import remove_ground
from perception.roadway import Roadway
from perception.vehicles import Vehicles
from protocol.codec import RangeScan
from protocol.geometry import SE3
from protocol.roadmap import RoadMap


@dataclass(frozen=True, slots=True, eq=False)
class Detector:
    """The stages of the edge, with its parameters, on one agent's scan alone."""

    roadway: Roadway
    geofence: GeofenceConfig
    ground: GroundConfig
    cluster: ClusterConfig
    boxes: BoxConfig

    @classmethod
    def of(cls, road_map: RoadMap, edge: dict[str, Any]) -> Detector:
        """Builds it from the scenario's section of the edge."""
        geofence = GeofenceConfig.model_validate(edge["geofence"])
        return cls(
            Roadway.of(road_map, margin_m=geofence.margin_m),
            geofence,
            GroundConfig.model_validate(edge["ground"]),
            ClusterConfig.model_validate(edge["cluster"]),
            BoxConfig.model_validate(edge["boxes"]),
        )

    def detect(
        self, scan: RangeScan, map_SE3_sensor: SE3, rng: np.random.Generator, *, ground_free: bool
    ) -> Vehicles:
        """Returns the vehicles in a scan, in the map frame; `ground_free` scans have no ground."""
        near = self.roadway.place(
            scan.cloud().points,
            map_SE3_sensor,
            below_m=self.geofence.below_m,
            above_m=self.geofence.above_m,
        )
        above, ground_m = near.points, near.road_m
        if not ground_free:
            above, ground_m = remove_ground(above, ground_m, config=self.ground, rng=rng)
        return fit_boxes(
            above,
            ground_m,
            cluster(above, config=self.cluster),
            roadway=self.roadway,
            sensors=map_SE3_sensor.translation[None],
            config=self.boxes,
        )
