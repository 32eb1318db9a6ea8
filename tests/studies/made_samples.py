"""Made-up scene samples and a scripted detector."""

from __future__ import annotations

from typing import Any

import numpy as np

from learning.dataset import SceneSample, SensorScan
from perception.detector import Cloud, Vehicles
from protocol.geometry import SE3
from tests.point_clouds import car_shell, ground_points


def car(x: float, y: float) -> list[float]:
    return [x, y, 0.75, 4.5, 1.8, 1.5, 0.0]


def scene_sample(
    boxes: list[list[float]], points_on: list[list[int]], own: int | None
) -> SceneSample:
    """Two sensors: at the junction's centre, and one at x = 40 that a vehicle may carry."""
    rng = np.random.default_rng(2)
    scans = []
    for agent, x, carrier in (("rsu-0", 0.0, None), ("cav", 40.0, own)):
        sensor = SE3(np.eye(3), np.array([x, 0.0, 3.0]))
        cars = [
            car_shell([*box[:2], 0, 0, 0, box[6]], (x, 0.0), rng)
            for n, box in enumerate(boxes)
            if n != carrier
        ]
        points = np.concatenate([ground_points(rng, count=8000), *cars])
        local = sensor.inverse().apply(points).astype(np.float32)
        scans.append(SensorScan(agent, local, sensor, carrier))
    classes = np.zeros(len(boxes), np.uint8)
    return SceneSample("made-up", 0, scans, np.array(boxes), classes, np.array(points_on))


class ScriptedDetector:
    """A detector that returns scripted boxes."""

    def __init__(self, boxes: list[list[float]]) -> None:
        self.boxes = np.array(boxes).reshape(-1, 7)

    def detect(self, cloud: Cloud, rng: Any, stage: Any = None) -> Vehicles:
        return Vehicles.from_lidar(self.boxes, np.linspace(1, 0.5, len(self.boxes)))
