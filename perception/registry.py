"""The detectors by their names. What a detector needs is imported once it is asked for."""

from __future__ import annotations

from collections.abc import Callable

from perception.clustering import Clustering
from perception.config import DetectionConfig
from perception.detector import Detector
from perception.roadway import Roadway
from protocol.errors import ConfigError

DetectorMaker = Callable[[DetectionConfig, Roadway], Detector]


def detector_of(config: DetectionConfig, roadway: Roadway) -> Detector:
    """Builds the detector that a configuration names, for a road.

    Raises:
        ConfigError: what it needs is not installed.
    """
    match config.detector:
        case "fast":
            return Clustering(config, roadway)
        case "reference":
            from perception.reference import Reference

            return Reference.of(config)
        case name:
            try:
                from perception.pillars.detector import pillars_detector
            except ImportError as error:
                raise ConfigError(
                    f"the detector {name} needs PyTorch (extra `learn`): {error}"
                ) from None
            return pillars_detector(name, config.pillars, roadway)
