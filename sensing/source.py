"""Where an agent's scans come from."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

import numpy as np

from protocol.errors import ConfigError
from protocol.geometry import SE3
from protocol.messages import Setup, Tick
from sensing.carla.config import CarlaConfig
from sensing.config import LidarConfig, SceneConfig
from sensing.lidar import Lidar, Sensed
from sensing.noise import stream
from sensing.recording import Recording
from sensing.scene import scene_of
from sensing.shapes import VehicleShapes


class ScanSource(Protocol):
    """Serves all agents of one kind of a process."""

    def scan(self, agent: str, tick: Tick, map_SE3_sensor: SE3, own: int | None) -> Sensed:
        """Returns what an agent's sensor there sees; `own` is the body that carries it."""

    def close(self) -> None:
        """Lets go of what it holds."""


class Cast:
    """Scans of the LiDAR model."""

    def __init__(self, lidar: Lidar, seed: int) -> None:
        self._lidar = lidar
        self._seed = seed

    def scan(self, agent: str, tick: Tick, map_SE3_sensor: SE3, own: int | None) -> Sensed:
        """See `ScanSource.scan`; noise follows from seed, agent and frame."""
        rng = stream(self._seed, "scan", agent, tick.frame)
        return self._lidar.scan(map_SE3_sensor, tick.poses, tick.types, own, rng)

    def close(self) -> None:
        """Holds nothing."""


class Played:
    """Scans of a recording."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording

    def scan(self, agent: str, tick: Tick, map_SE3_sensor: SE3, own: int | None) -> Sensed:  # noqa: ARG002 - what the sensor saw there is recorded
        """See `ScanSource.scan`; the sensor was where the recording's tick has it."""
        return Sensed(self._recording.scan(agent, tick.frame), np.zeros(0, np.int64))

    def close(self) -> None:
        """Holds nothing."""


def check_recording(scenario: dict[str, Any]) -> None:
    """Finds before the start what would keep the roles from playing a scenario's recording.

    Raises:
        ConfigError: it cannot be read, or does not fit the scenario's LiDARs or mounts.
    """
    if not scenario.get("recording"):
        return
    mounts = [mount["id"] for mount in scenario["roadside_mounts"]]
    for kind in ["vehicle", "roadside"] if mounts else ["vehicle"]:
        recording = _recording(scenario, LidarConfig.model_validate(scenario["lidar"][kind]))
    if missing := [mount for mount in mounts if mount not in recording.agents]:
        raise ConfigError(
            f"recording {scenario['recording']}: has no scans of the roadside mount {missing[0]}; "
            f"it has {', '.join(recording.agents)}"
        )


def is_of_carla(scenario: dict[str, Any]) -> bool:
    """Whether a scenario's scans are cast by a CARLA server."""
    return bool(scenario["lidar"].get("source") == "carla")


def source_of(setup: Setup, config: LidarConfig) -> ScanSource:
    """Returns the source that a scenario asks for.

    Raises:
        ConfigError: its recording cannot be read, or its CARLA server cannot be used.
    """
    scenario: dict[str, Any] = setup.scenario
    if scenario.get("recording"):
        return Played(_recording(scenario, config))
    seed: int = scenario["seed"]
    if is_of_carla(scenario):
        from sensing.carla.source import Carla

        server = CarlaConfig.model_validate(scenario["carla"])
        return Carla(server, config, setup.vehicle_types, seed)
    scene = scene_of(setup, SceneConfig.model_validate(scenario["scene"]), seed)
    return Cast(Lidar(config, scene, VehicleShapes.from_setup(setup)), seed)


def _recording(scenario: dict[str, Any], config: LidarConfig) -> Recording:
    recording = Recording(Path(scenario["recording"]))
    if recording.pattern != config.pattern:
        raise ConfigError(
            f"recording {scenario['recording']}: its scans are of {recording.pattern}, the "
            f"scenario's LiDARs of {config.pattern}"
        )
    return recording
