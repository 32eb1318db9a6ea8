"""Scan sources: the LiDAR model, a recording, CARLA or a plug-in."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from protocol.errors import ConfigError
from protocol.geometry import SE3
from protocol.messages import Setup
from sensing.config import LIDAR_SOURCES, LidarConfig, SceneConfig
from sensing.lidar import Lidar, Sensed
from sensing.mesh import VehicleShapes
from sensing.noise import stream
from sensing.recorded_scans import Recording, recording_of
from sensing.reflectivity import paints_of
from sensing.scene import scene_of
from sensing.world_view import WorldView


class ScanSource(Protocol):
    """Source of scans for all agents of one kind of a process.

    A plug-in is a callable that takes the setup, the LiDAR and `lidar.plugin`. If it has a function
    `check`, that is called with the scenario before the run starts, where agents run; it raises
    ConfigError if there could be no scans.
    """

    def scan(self, agent: str, view: WorldView, map_SE3_sensor: SE3, own: int | None) -> Sensed:
        """Returns the scan of an agent's sensor; `own` is the index of the body that carries it."""

    def close(self) -> None:
        """Releases what it holds."""


class ModelSource:
    """Scans of the LiDAR model."""

    def __init__(self, lidar: Lidar, seed: int) -> None:
        self._lidar = lidar
        self._seed = seed

    def scan(self, agent: str, view: WorldView, map_SE3_sensor: SE3, own: int | None) -> Sensed:
        """See `ScanSource.scan`; noise follows from seed, agent and frame."""
        rng = stream(self._seed, "scan", agent, view.frame)
        paint = paints_of(self._seed, view.ids)
        bodies = view.poses, view.types
        return self._lidar.scan(map_SE3_sensor, *bodies, own, rng, paint, view.speeds_mps)

    def close(self) -> None:
        """Holds nothing."""


class RecordedSource:
    """Scans of a recording."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording

    def scan(self, agent: str, view: WorldView, map_SE3_sensor: SE3, own: int | None) -> Sensed:  # noqa: ARG002 - what the sensor saw there is recorded
        """See `ScanSource.scan`; the sensor was where the recording has it."""
        return Sensed(self._recording.scan(agent, view.frame), np.zeros(0, np.int64))

    def close(self) -> None:
        """Holds nothing."""


def source_of(setup: Setup, config: LidarConfig) -> ScanSource:
    """Returns the scan source of a scenario.

    Raises:
        ConfigError: its recording cannot be read, or a plug-in cannot be made.
    """
    scenario: dict[str, Any] = setup.scenario
    if scenario.get("recording"):
        return RecordedSource(recording_of(scenario, config))
    seed: int = scenario["seed"]
    if (name := _name_of(scenario)) not in LIDAR_SOURCES.builtin:
        settings = scenario["lidar"].get("plugin", {})
        source: ScanSource = LIDAR_SOURCES.load(name).make("scan", setup, config, settings)
        return source
    scene = scene_of(setup, SceneConfig.model_validate(scenario["scene"]), seed)
    return ModelSource(Lidar(config, scene, VehicleShapes.from_setup(setup)), seed)


def check_source(scenario: dict[str, Any]) -> None:
    """Checks before the start that a plug-in can produce scans.

    Raises:
        ConfigError: it cannot be loaded, or refuses the scenario.
    """
    name = _name_of(scenario)
    if name in LIDAR_SOURCES.builtin:
        return
    if scenario.get("recording"):
        raise ConfigError(f"lidar.source: {name} casts scans, and recording plays some: keep one")
    plugin = LIDAR_SOURCES.load(name)
    if (check := getattr(plugin.value, "check", None)) is not None:
        check(scenario)


def _name_of(scenario: dict[str, Any]) -> str:
    return str(scenario["lidar"].get("source", "cast"))
