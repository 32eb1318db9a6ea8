"""What a scenario says of where its scans come from; light to import, for whoever casts none."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from protocol.errors import ConfigError
from sensing.config import LidarConfig
from sensing.recording import Recording


def check_recording(scenario: dict[str, Any]) -> None:
    """Finds before the start what would keep the roles from playing a scenario's recording.

    Raises:
        ConfigError: it cannot be read, or does not fit the scenario's LiDARs or mounts.
    """
    if not scenario.get("recording"):
        return
    mounts = [mount["id"] for mount in scenario["roadside_mounts"]]
    for kind in ["vehicle", "roadside"] if mounts else ["vehicle"]:
        recording = recording_of(scenario, LidarConfig.model_validate(scenario["lidar"][kind]))
    if missing := [mount for mount in mounts if mount not in recording.agents]:
        raise ConfigError(
            f"recording {scenario['recording']}: has no scans of the roadside mount {missing[0]}; "
            f"it has {', '.join(recording.agents)}"
        )


def is_of_carla(scenario: dict[str, Any]) -> bool:
    """Whether a scenario's scans are cast by a CARLA server."""
    return bool(scenario["lidar"].get("source") == "carla")


def recording_of(scenario: dict[str, Any], config: LidarConfig) -> Recording:
    """Opens a scenario's recording.

    Raises:
        ConfigError: it cannot be read, or its scans are not of such a LiDAR.
    """
    recording = Recording(Path(scenario["recording"]))
    if recording.pattern != config.pattern:
        raise ConfigError(
            f"recording {scenario['recording']}: its scans are of {recording.pattern}, the "
            f"scenario's LiDARs of {config.pattern}"
        )
    return recording
