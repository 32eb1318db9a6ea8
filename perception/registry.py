"""The detectors by their names. What a detector needs is imported once it is asked for.

The entry point of a plug-in (group `cpnet.detectors`) names a `perception.detector.DetectorMaker`:
a callable that is given the configuration, with the plug-in's settings in `plugin`, and the road,
and returns a `perception.detector.Detector`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from perception.config import DETECTORS, LEARNED, DetectionConfig
from protocol.errors import ConfigError

if TYPE_CHECKING:
    from perception.detector import Detector
    from perception.roadway import Roadway


def detector_of(config: DetectionConfig, roadway: Roadway) -> Detector:
    """Builds the detector that a configuration names, for a road.

    Raises:
        ConfigError: what it needs is not installed, or its weights cannot be used.
    """
    match config.detector:
        case "fast":
            from perception.fast import FastDetector

            return FastDetector(config, roadway)
        case "reference":
            from perception.reference import ReferenceDetector

            return ReferenceDetector.of(config)
        case name if name in LEARNED:
            with _torch_needed(name):
                from perception.pillars.detector import pillars_detector
            return pillars_detector(name, config.pillars, roadway, unmapped=config.solid_only)
        case name:
            from perception.detector import PluginDetector

            return PluginDetector.of(DETECTORS.load(name), config, roadway)


def check(config: DetectionConfig) -> None:
    """Checks before the start that a learned detector or a plug-in can be built.

    Raises:
        ConfigError: PyTorch is not installed, the weights cannot be used, or the plug-in cannot be
            imported.
    """
    if config.detector not in DETECTORS.builtin:
        DETECTORS.load(config.detector)
    if config.detector not in LEARNED:
        return
    with _torch_needed(config.detector):
        from perception.pillars.weights import network_of
    network_of(config.detector, config.pillars)


@contextmanager
def _torch_needed(detector: str) -> Iterator[None]:
    try:
        yield
    except ImportError as error:
        raise ConfigError(
            f"the detector {detector} needs PyTorch (extra `learn`): {error}"
        ) from None
