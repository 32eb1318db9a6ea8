"""`cpnet replay --scans`: clouds from elsewhere become a tape, and that is played."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from cpnet import scenario as scenarios
from cpnet.preparation import Played
from cpnet.replay import Pace
from player.scans.agents import Source, agents_of, check_clocks
from player.scans.extrinsics import write_extrinsics
from player.scans.ground import open_ground
from player.scans.taping import STEM, Imported, tape_scans
from protocol.errors import ConfigError
from protocol.messages import Setup
from protocol.roadmap import RoadMap
from protocol.version import own_version

_CASTING = ("lidar", "pose", "scene", "carla")
_ENCODING = ("upload.max_error_m", "upload.profile", "upload.intensity")
EXTRINSICS = "extrinsics.csv"
WIDTH_M = 60.0


@dataclass(frozen=True, slots=True)
class Scans:
    """What the user asked for: clouds, a scenario whose roads fit them, or an open ground.

    `height_m` is that of sensors over the ground, None to find it; `frames` None for each once;
    `width_m` that of the open ground, None for `WIDTH_M`.
    """

    source: Source
    scenario: str | None
    overrides: dict[str, Any]
    frames: int | None = None
    height_m: float | None = None
    width_m: float | None = None


def played_scans(asked: Scans, pace: Pace, console: Console) -> Played:
    """Returns the replay; the tape is made in its run folder, and clouds without points are told.

    Raises:
        ConfigError: files or the scenario cannot be used.
    """
    agents = agents_of(asked.source)
    if asked.scenario is None:
        origin_m = agents[0].pose(0)[:3]
        agents = [agent.moved(-origin_m) for agent in agents]
    imported = Imported.of(agents, asked.frames, asked.height_m)
    scenario = _scenario(asked, pace, imported.frames)
    check_clocks(agents, scenario.frame_period_s, asked.source.poses)

    def setup(run_dir: Path) -> Setup:
        tape = str(run_dir / f"{STEM}.mcap")
        changes = {"replay": {"tape": tape, "speed": pace.speed}}
        whole = scenario.model_dump(mode="json") | changes
        if asked.scenario is None:
            made = _plain_setup(
                whole, open_ground(imported.ways(), width_m=asked.width_m or WIDTH_M)
            )
        else:
            from sim_host.setup import build_setup  # SUMO is needed for its roads alone

            made = build_setup(whole, run_dir)
        if empty := tape_scans(imported, made, run_dir):
            clouds = imported.frames * len(agents)
            console.print(f"{empty} of {clouds} clouds hold no point", highlight=False)
        if asked.source.refine:
            write_extrinsics(run_dir / EXTRINSICS, agents[0].mounts)
        return made

    return Played(scenario.name, setup)


def _check_overrides(overrides: dict[str, Any]) -> None:
    """Refuses what would change nothing, because clouds are uploaded whole as they are."""
    for key in overrides:
        section = key.partition(".")[0]
        if section in _CASTING or (section == "upload" and key not in _ENCODING):
            raise ConfigError(
                f"--set {key}: with --scans clouds come from files and are uploaded whole, so that "
                f"this changes nothing; of upload.* they take {', '.join(_ENCODING)}"
            )


def _scenario(asked: Scans, pace: Pace, frames: int) -> scenarios.Scenario:
    _check_overrides(asked.overrides)
    base = scenarios.load(asked.scenario or "t_junction", asked.overrides)
    facts: dict[str, Any] = {
        "duration_s": frames * base.frame_period_s,
        "traffic.warmup_s": 0.0,
        "traffic.cav_rate": base.traffic.cav_rate or 1.0,  # so that the edge knows of LiDARs
        "traffic.step_s": base.frame_period_s if base.frame_period_s <= 1 else base.traffic.step_s,
        "roadside_mounts": [],
        "processes.vehicle": 1,
        "record.truth": False,
    }
    if "name" not in asked.overrides and asked.scenario is None:
        name = asked.source.scans.resolve().name
        facts["name"] = re.sub(r"[^A-Za-z0-9_-]", "_", name)[:80] or "scans"
    if pace.mode is not None:
        facts["mode"] = pace.mode
    if taken := sorted(facts.keys() & asked.overrides.keys() - {"traffic.cav_rate", "mode"}):
        raise ConfigError(
            f"--set {taken[0]}: with --scans that follows from the scans, and cannot be set"
        )
    data = base.model_dump(mode="json")
    return scenarios.changed(data, facts, asked.scenario or "the scenario")


def _plain_setup(scenario: dict[str, Any], roads: RoadMap) -> Setup:
    """Returns a setup without anything that a sensor could be cast at."""
    return Setup(
        scenario=scenario,
        road_map=roads,
        vehicle_types=[],
        meshes=[],
        mesh_vertices=np.zeros((0, 3), np.float32),
        mesh_triangles=np.zeros((0, 3), np.int32),
        version=own_version(),
    )
