"""`cpnet replay`: plays a recording, or imported scans, to live processes."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.console import Console

from cpnet import scenario as scenarios
from cpnet.preparation import Replay
from protocol.errors import ConfigError
from protocol.geometry import Floats
from protocol.messages import Setup
from protocol.roadmap import RoadMap
from protocol.version import own_version
from recording.foreign_scans.agents import Agent, Source, agents_of, check_clocks
from recording.foreign_scans.importer import (
    STEM,
    ImportedScans,
    ground_of,
    open_ground,
    record_scans,
    scans_along,
)
from recording.foreign_scans.mutual import misplaced
from recording.foreign_scans.poses import write_extrinsics
from recording.mcap.reader import McapReader
from recording.playback.frames import RecordingSummary
from sim_host.compatible_phases import with_phases

LIVE = ("edge", "signal", "cabinet", "link", "record")
"""Sections that a replay may change: those whose effects are not in the recording."""
LIVE_KEYS = ("name", "duration_s", "traffic.start_timeout_s")
_PACE = ("mode", "replay")
_FITS = {"lockstep": "virtual", "realtime": "emulated"}


@dataclass(frozen=True, slots=True)
class Pace:
    """Mode of a replay, None for that of the recording, and its speed in realtime."""

    mode: Literal["lockstep", "realtime"] | None = None
    speed: float = 1.0

    @classmethod
    def of(cls, speed: float | None, *, lockstep: bool) -> Pace:
        """Reads `--speed` and `--lockstep`.

        Raises:
            ConfigError: both were given.
        """
        if lockstep and speed is not None:
            raise ConfigError("--lockstep has no speed: give it or --speed, not both")
        if lockstep:
            return cls("lockstep")
        return cls() if speed is None else cls("realtime", speed)


def replay_of_recording(
    path: Path, overrides: dict[str, Any], pace: Pace, console: Console
) -> Replay:
    """Returns the replay of a recording, and prints how much of it is damaged; see `setup_of`."""
    setup = setup_of(path, overrides, pace)
    if damaged := setup.scenario["replay"]["damaged"]:
        frames = round(setup.scenario["duration_s"] / setup.scenario["frame_period_s"])
        parts = "1 part" if damaged == 1 else f"{damaged} parts"
        console.print(
            f"{path}: the recording is damaged or was cut off: {parts} cannot be read; "
            f"{frames} frames are played",
            markup=False, highlight=False, soft_wrap=True,
        )  # fmt: skip
    return Replay(setup.scenario["name"], lambda _: setup)


def setup_of(path: Path, overrides: dict[str, Any], pace: Pace) -> Setup:
    """Returns the setup of a replay.

    Raises:
        ConfigError: there is no recording, or an override is for data that is in it.
    """
    check_overrides(overrides)
    recording = McapReader(path)
    survey = RecordingSummary.of(recording)
    data = recording.setup.scenario
    most_s = survey.frames * float(data["frame_period_s"])
    facts: dict[str, Any] = {
        "replay": {
            "recording": str(path.resolve()),
            "speed": pace.speed,
            "damaged": _damaged(recording),
        },
        "duration_s": most_s,
        "processes.vehicle": max(survey.vehicles, 1),
        "record.mcap": False,
    }
    if pace.mode is not None:
        facts["mode"] = pace.mode
        if data["link"]["apply"] not in ("auto", "none", _FITS[pace.mode]):
            facts["link.apply"] = "auto"
    if not survey.has_truth:
        facts["record.truth"] = False
    if "phases" not in data["signal"]:  # as it was before there was a choice
        facts["signal.phases"] = "plan"
    scenario = scenarios.changed(data, {**facts, **overrides}, str(path))
    if scenario.duration_s > most_s:
        raise ConfigError(f"duration_s is {scenario.duration_s:g}, the recording has {most_s:g} s")
    _check_cabinet(scenario)
    changed: dict[str, Any] = {
        "scenario": scenario.model_dump(mode="json"),
        "version": own_version(),
    }
    if overrides.keys() & {"signal.policy", "signal.phases"}:
        changed["road_map"] = with_phases(recording.setup.road_map, changed["scenario"]["signal"])
    return recording.setup.model_copy(update=changed)


def _damaged(recording: McapReader) -> int:
    """Returns how many parts of a recording that was gone through cannot be read.

    A missing end is one: how much would have followed is unknown.
    """
    return recording.drops.total() or int(not recording.is_whole)


def check_overrides(overrides: dict[str, Any]) -> None:
    """Refuses overrides without effect, because their data is in the recording.

    Raises:
        ConfigError: there is such a key.
    """
    for key in overrides:
        section = key.partition(".")[0]
        if section in _PACE:
            raise ConfigError(f"{key}: a replay takes --lockstep or --speed N instead")
        if section not in LIVE and key not in LIVE_KEYS:
            raise ConfigError(
                f"{key}: it is part of the recording already, so a replay cannot change it. "
                f"Simulate the run anew with `cpnet up` and this key. A replay takes "
                f"{', '.join(f'{name}.*' for name in LIVE)}, {', '.join(LIVE_KEYS)}"
            )


def _check_cabinet(scenario: scenarios.Scenario) -> None:
    if scenario.cabinet.control == "actuated":
        raise ConfigError(
            "the signal of this run was SUMO's own actuated control, and a replay has no loop "
            "detectors: add --set cabinet.control=requests"
        )


_CASTING = ("realism", "lidar", "pose", "scene")
_ENCODING = ("upload.max_error_m", "upload.profile", "upload.intensity")
_FREE = {"traffic.cav_rate", "mode", "edge.solid_only"}
EXTRINSICS = "extrinsics.csv"
WIDTH_M = 100.0


@dataclass(frozen=True, slots=True)
class Scans:
    """Options of a replay of clouds: files, a scenario whose roads fit them, or an open ground.

    `height_m` is that of sensors over the ground, None to find it; `frames` None for each once;
    `width_m` that of the open ground, None for `WIDTH_M`; `align` moves agents whose scans
    contradict those of others.
    """

    source: Source
    scenario: str | None
    overrides: dict[str, Any]
    frames: int | None = None
    height_m: float | None = None
    width_m: float | None = None
    align: bool = False


def replay_of_scans(asked: Scans, pace: Pace, console: Console) -> Replay:
    """Writes the recording into a run folder and returns its replay; warns of empty clouds.

    Raises:
        ConfigError: files or the scenario cannot be used.
    """
    agents = agents_of(asked.source)
    if asked.scenario is None:
        origin_m = agents[0].pose(0)[:3]
        agents = [agent.moved(np.array([*-origin_m, 0.0])) for agent in agents]
    agents = _in_place(agents, asked, console)
    imported = ImportedScans.of(agents, asked.frames, asked.height_m)
    scenario = _scenario_of_scans(asked, pace, imported.frames)
    check_clocks(agents, scenario.frame_period_s, asked.source.poses)

    def setup(run_dir: Path) -> Setup:
        from sim_host.setup import build_setup, resolved

        recording = str(run_dir / f"{STEM}.mcap")
        changes = {"replay": {"recording": recording, "speed": pace.speed}}
        whole = scenario.model_dump(mode="json") | changes
        if asked.scenario is None:
            ways, width_m = imported.ways(), asked.width_m or WIDTH_M
            ground = ground_of(scans_along(agents, ways), ways, width_m=width_m)
            console.print(str(ground), highlight=False, soft_wrap=True)
            roads = open_ground(ways, ground, width_m=width_m)
            made = _plain_setup(resolved(whole, roads), roads)
        else:
            made = build_setup(whole, run_dir)
        if empty := record_scans(imported, made, run_dir):
            clouds = imported.frames * len(agents)
            console.print(f"{empty} of {clouds} clouds hold no point", highlight=False)
        if asked.source.refine:
            write_extrinsics(run_dir / EXTRINSICS, agents[0].mounts)
        return made

    return Replay(scenario.name, setup, imported.sensor_poses())


def _in_place(agents: list[Agent], asked: Scans, console: Console) -> list[Agent]:
    """Prints agents whose scans contradict those of others, and moves them on request."""
    offsets: dict[str, Floats] = {}
    for one in misplaced(agents) if len(agents) > 1 else []:
        offsets[one.agent] = one.offset
        done = "they are" if asked.align else f"--align does it; {asked.source.poses} is as it was"
        console.print(f"{one}: {done}", markup=False, highlight=False, soft_wrap=True)
    if not asked.align:
        return agents
    return [agent.moved(-offsets.get(agent.name, np.zeros(4))) for agent in agents]


def _check_scan_overrides(overrides: dict[str, Any]) -> None:
    """Refuses overrides without effect, because clouds are uploaded whole and unchanged."""
    for key in overrides:
        section = key.partition(".")[0]
        if section in _CASTING or (section == "upload" and key not in _ENCODING):
            raise ConfigError(
                f"--set {key}: with --scans clouds come from files and are uploaded whole, so that "
                f"this changes nothing; of upload.* they take {', '.join(_ENCODING)}"
            )


def _scenario_of_scans(asked: Scans, pace: Pace, frames: int) -> scenarios.Scenario:
    _check_scan_overrides(asked.overrides)
    base = scenarios.load(asked.scenario or "t_junction", asked.overrides)
    facts: dict[str, Any] = {
        "duration_s": frames * base.frame_period_s,
        "traffic.warmup_s": 0.0,
        "traffic.cav_rate": base.traffic.cav_rate or 1.0,  # so that the edge expects LiDARs
        "traffic.step_s": base.frame_period_s if base.frame_period_s <= 1 else base.traffic.step_s,
        "roadside_mounts": [],
        "processes.vehicle": 1,
        "record.truth": False,
    }
    if asked.scenario is None:
        facts["edge.solid_only"] = asked.overrides.get("edge.solid_only", True)
    if "name" not in asked.overrides and asked.scenario is None:
        name = asked.source.scans.resolve().name
        facts["name"] = re.sub(r"[^A-Za-z0-9_-]", "_", name)[:80] or "scans"
    if pace.mode is not None:
        facts["mode"] = pace.mode
    if taken := sorted(facts.keys() & asked.overrides.keys() - _FREE):
        raise ConfigError(
            f"--set {taken[0]}: with --scans that follows from the scans, and cannot be set"
        )
    data = base.model_dump(mode="json")
    return scenarios.changed(data, facts, asked.scenario or "the scenario")


def _plain_setup(scenario: dict[str, Any], roads: RoadMap) -> Setup:
    """Returns a setup without meshes for ray casting."""
    return Setup(
        scenario=scenario,
        road_map=roads,
        vehicle_types=[],
        meshes=[],
        mesh_vertices=np.zeros((0, 3), np.float32),
        mesh_triangles=np.zeros((0, 3), np.int32),
        version=own_version(),
    )
