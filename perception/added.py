"""A detector that another package brings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perception.config import DetectionConfig
from perception.detector import Cloud, Detector, Stage, untimed
from perception.roadway import Roadway
from perception.vehicles import Vehicles
from protocol.plugins import Plugin


@dataclass(frozen=True, slots=True, eq=False)
class Added:
    """Holds a plug-in to what every detector promises, frame by frame."""

    plugin: Plugin
    detector: Detector

    @classmethod
    def of(cls, plugin: Plugin, config: DetectionConfig, roadway: Roadway) -> Added:
        """Makes the detector for a road.

        Raises:
            ConfigError: the plug-in refuses its settings or makes no detector.
        """
        return cls(plugin, plugin.make("detect", config, roadway))

    def detect(self, cloud: Cloud, rng: np.random.Generator, stage: Stage = untimed) -> Vehicles:
        """See `perception.detector.Detector.detect`.

        Raises:
            ConfigError: what the plug-in returned are no vehicles.
        """
        found = self.detector.detect(cloud, rng, stage)
        if not isinstance(found, Vehicles):
            raise self.plugin.wrong(f"found a {type(found).__name__}, must find Vehicles")
        count = len(found.boxes)
        shapes = [found.boxes.shape, found.scores.shape, found.position_std_m.shape]
        if shapes != [(count, 7), (count,), (count,)] or len(found.sources) != count:
            raise self.plugin.wrong(
                f"found boxes {shapes[0]}, scores {shapes[1]}, position_std_m {shapes[2]} and "
                f"{len(found.sources)} sources; must be (N, 7), (N,), (N,) and N"
            )
        if not (np.isfinite(found.boxes).all() and np.isfinite(found.scores).all()):
            raise self.plugin.wrong("found a box or a score that is no finite number")
        return found
