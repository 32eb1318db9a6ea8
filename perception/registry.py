"""The detectors by their names."""

from __future__ import annotations

from perception.clustering import Clustering
from perception.config import DetectionConfig
from perception.detector import Detector
from perception.roadway import Roadway


def detector_of(config: DetectionConfig, roadway: Roadway) -> Detector:
    """Builds the detector that a configuration names, for a road."""
    return Clustering(config, roadway)
