"""A detector: wherever enough points stand over a square of the road, there is a vehicle."""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, Field

from perception.config import DetectionConfig
from perception.detector import Cloud, Stage, Vehicles, untimed
from perception.roadway import Roadway, merge

LENGTH_M, WIDTH_M, HEIGHT_M = 4.5, 1.8, 1.5


class Settings(BaseModel, extra="forbid"):
    """What may stand under `edge.plugin`."""

    square_m: float = Field(4.0, gt=0, description="side of a square")
    least_points: int = Field(5, ge=1, description="in a square that holds a vehicle")


class Grid:
    """Made once, for a road; called for every frame."""

    def __init__(self, config: DetectionConfig, roadway: Roadway) -> None:
        self._settings = Settings.model_validate(config.plugin)
        self._roadway = roadway

    def detect(self, cloud: Cloud, rng: np.random.Generator, stage: Stage = untimed) -> Vehicles:
        """Returns a vehicle of usual size, along the road, for each square with enough points."""
        with stage("ground"):
            points, road_m = merge([*cloud.near, *cloud.bare])
            over_m = points[:, 2] - road_m
            points = points[(over_m > 0.3) & (over_m < 2.5)]
        with stage("detect"):
            middles, scores = self._squares(points[:, :2].astype(np.float64))
            centre_z = self._roadway.height_at(middles) + HEIGHT_M / 2
            sizes = np.tile([LENGTH_M, WIDTH_M, HEIGHT_M], (len(middles), 1))
            yaw = self._roadway.yaw_at(middles)
            return Vehicles.from_lidar(np.column_stack([middles, centre_z, sizes, yaw]), scores)

    def _squares(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the mean place (N, 2) of the points in each full square, and a score (N,)."""
        squares = np.floor(places / self._settings.square_m)
        _, of, count = np.unique(squares, axis=0, return_inverse=True, return_counts=True)
        sums = np.stack([np.bincount(of.reshape(-1), axis, len(count)) for axis in places.T], -1)
        full = count >= self._settings.least_points
        return sums[full] / count[full, None], 1 - 1 / count[full]
