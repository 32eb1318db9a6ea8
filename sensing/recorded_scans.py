"""Recorded scans: a folder with recorded traffic and scans that replace the simulated ones.

`recording.json` names agents, scan pattern and frame period; `truth.bin` holds a `Truth` message a
frame, each behind its length (u32); `ranges.npy` the scans (frames, agents, channels, columns) in
steps of 2 mm, 0 for no return. It is played forwards, then backwards, so that nothing jumps.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import Field, ValidationError, field_validator

from protocol.config import Section
from protocol.errors import ConfigError, ProtocolError
from protocol.messages import Truth
from protocol.messages.fields import Id
from protocol.scans import RangeScan, ScanPattern
from protocol.wire import decode, encode
from sensing.config import LidarConfig

STEP_M = 0.002
_ABOUT, _TRUTH, _RANGES = "recording.json", "truth.bin", "ranges.npy"
_FORMAT = b"\x93NUMPY\x01\x00"

# The last two come out of numpy's reader of headers.
_UNREADABLE = (OSError, ValueError, ArithmeticError, SyntaxError, TokenError)


class _About(Section):
    agents: list[Id] = Field(min_length=1)
    frame_period_s: float = Field(gt=0, le=60)
    pattern: ScanPattern

    @field_validator("agents")
    @classmethod
    def _each_once(cls, agents: list[str]) -> list[str]:
        if len(set(agents)) < len(agents):
            raise ValueError("each may stand once")
        return agents


class Recording:
    """Reads recorded traffic and scans; scans stay on disk until they are needed."""

    def __init__(self, folder: Path) -> None:
        """Opens a recording.

        Raises:
            ConfigError: the folder holds none, or a damaged one.
        """
        try:
            about = _About.model_validate_json((folder / _ABOUT).read_bytes())
            self.agents, self.pattern = about.agents, about.pattern
            self.frame_period_s = about.frame_period_s
            self._steps = _open_array(folder / _RANGES)
            self._truth_bytes = (folder / _TRUTH).read_bytes()
            shape = (
                len(self.truths),
                len(self.agents),
                self.pattern.channels,
                self.pattern.columns,
            )
        except ValidationError as error:
            raise ConfigError(f"recording {folder}: {_ABOUT}: {_first(error)}") from None
        except (*_UNREADABLE, ProtocolError) as error:
            raise ConfigError(f"recording {folder}: {error}") from None
        if self._steps.shape != shape or self._steps.dtype != np.uint16 or not shape[0]:
            raise ConfigError(
                f"recording {folder}: {_RANGES} is {self._steps.dtype} {self._steps.shape}, "
                f"needs uint16 {shape} and a frame at least"
            )
        scanning = {vehicle for truth in self.truths for vehicle in truth.cavs}
        if missing := sorted(scanning - set(self.agents)):
            raise ConfigError(f"recording {folder}: the CAV {missing[0]} has no scans")

    @cached_property
    def truths(self) -> list[Truth]:
        """The ground truth of the recorded frames, in order."""
        truths, at = [], 0
        while at < len(self._truth_bytes):
            end = at + 4 + int.from_bytes(self._truth_bytes[at : at + 4], "little")
            truths.append(decode(self._truth_bytes[at + 4 : end], Truth))
            at = end
        return truths

    def place(self, frame: int) -> int:
        """Returns the index of the recorded frame to play: forwards and backwards in turn."""
        turn = max(2 * len(self.truths) - 2, 1)
        return min(frame % turn, turn - frame % turn) if turn > 1 else 0

    def scan(self, agent: str, frame: int) -> RangeScan:
        """Returns an agent's scan in a frame; intensities are 0.

        Raises:
            ConfigError: the recording has no such agent.
        """
        if agent not in self.agents:
            raise ConfigError(
                f"the recording has no agent {agent}; it has {', '.join(self.agents)}"
            )
        steps = self._steps[self.place(frame), self.agents.index(agent)]
        range_m = steps.astype(np.float32) * np.float32(STEP_M)
        return RangeScan(self.pattern, range_m, np.zeros_like(range_m))


def write_recording(
    folder: Path,
    frame_period_s: float,
    truths: Sequence[Truth],
    scans: Mapping[str, Sequence[RangeScan]],
) -> None:
    """Writes a recording; every agent has a scan for every truth."""
    agents = sorted(scans)
    pattern = scans[agents[0]][0].pattern
    steps: npt.NDArray[np.uint16] = np.stack(
        [np.stack([_steps(scans[agent][n]) for agent in agents]) for n in range(len(truths))]
    )
    np.save(folder / _RANGES, steps)
    messages = [encode(truth) for truth in truths]
    (folder / _TRUTH).write_bytes(b"".join(len(m).to_bytes(4, "little") + m for m in messages))
    about = {
        "agents": agents,
        "frame_period_s": frame_period_s,
        "pattern": {
            "channels": pattern.channels,
            "columns": pattern.columns,
            "upper_fov_deg": pattern.upper_fov_deg,
            "lower_fov_deg": pattern.lower_fov_deg,
            "elevations_deg": pattern.elevations_deg,
        },
    }
    (folder / _ABOUT).write_text(json.dumps(about, indent=2) + "\n", "utf-8")


def _open_array(path: Path) -> npt.NDArray[np.uint16]:
    """Maps an array into memory, with a bounded header: later formats allow one of 4 GB."""
    with path.open("rb") as file:
        if file.read(len(_FORMAT)) != _FORMAT:
            raise ValueError(f"{path.name} begins with no magic string of numpy's format 1.0")
    return np.lib.format.open_memmap(path, mode="r")


def _first(error: ValidationError) -> str:
    first = error.errors(include_url=False)[0]
    return ": ".join([*map(str, first["loc"]), first["msg"].removeprefix("Value error, ")])


def _steps(scan: RangeScan) -> npt.NDArray[np.uint16]:
    steps: npt.NDArray[np.float32] = np.rint(scan.range_m / np.float32(STEP_M))
    return np.minimum(steps, np.float32(np.iinfo(np.uint16).max)).astype(np.uint16)


def check_recording(scenario: dict[str, Any]) -> None:
    """Checks before the start that the roles can play a scenario's recorded scans.

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
