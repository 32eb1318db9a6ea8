"""Preparation of a run: scenario, setup, run folder, processes, from the user's options."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from cpnet import scenario as scenarios
from cpnet.compiling import compile_ahead
from cpnet.discovery import connected_to_world
from cpnet.endpoints import Endpoints, connecting
from cpnet.fork_server import LOG_NAME, preload
from cpnet.needs import check_detector, check_run
from cpnet.processes import (
    MCAP,
    ProcessEntry,
    RoleSelection,
    in_replay,
    parse_only,
    processes_of,
    processes_without_scenario,
    relays_of,
)
from cpnet.run_folder import RunFolder, written
from cpnet.security import check_keys, check_keys_of_roles, secured_endpoints
from cpnet.viewer_process import Viewing
from edge_server.config import check_fusion
from perception.registry import check
from protocol.bus import Endpoint
from protocol.errors import ConfigError
from protocol.geometry import Floats
from protocol.logs import LogStyle
from protocol.messages import Setup
from protocol.topics import BusName
from protocol.wire import encode
from sensing.link_budget import link_warnings
from sensing.radio import AgentKind
from sensing.recorded_scans import check_recording
from sensing.upload_policies import policy_of
from signal_controller.config import check_policy

SENSING = {"vehicle", "infra"}
PLAYERS = SENSING | {"sim"}  # roles that play a recording, if there is one


@dataclass(frozen=True, slots=True)
class Options:
    """Options of `cpnet up`."""

    scenario: str
    overrides: dict[str, Any]
    only: str | None
    listen: list[str]
    connect: list[str]
    out: Path | None
    restart: bool = False
    metrics: str | None = None
    log: LogStyle = LogStyle.TEXT
    keys: Path | None = None
    insecure: bool = False
    view: Viewing | None = None


@dataclass(frozen=True, slots=True)
class Replay:
    """A replay: the name of its run, and the function that makes its setup in the run folder.

    `sensor_poses` (N, 6) are those of the first agent's sensor by frame, of imported scans.
    """

    name: str
    setup: Callable[[Path], Setup]
    sensor_poses: Floats | None = None


@dataclass(frozen=True, slots=True)
class PreparedRun:
    """A run that is ready to start; `relays` start before the other processes."""

    scenario: scenarios.Scenario
    endpoints: Endpoints
    run_dir: Path
    relays: list[ProcessEntry]
    processes: list[ProcessEntry]


def prepare_run(options: Options, console: Console, played: Replay | None) -> PreparedRun:
    """Makes the run folder and its files before the first frame.

    The functions that runs need are compiled, once, after all early checks.

    Raises:
        ConfigError: the options or the scenario are invalid.
        MessageError: the roads are too large for a message.
        BusError: the other side cannot be reached.
    """
    choice = parse_only(options.only)
    if played is not None and "sim" not in choice.names:
        raise ConfigError(
            "--only: a replay is begun where the role sim runs, which plays the recording"
        )
    hosted = {row.hosts for row in choice.roles if row.hosts}
    endpoints = secured_endpoints(
        options.listen, options.connect, hosted, options.keys, options.insecure
    )
    check_keys(
        options.keys, processes_without_scenario(choice)
    )  # the others' once the scenario is known
    if "sim" not in choice.names:
        check_keys_of_roles(options.keys, choice)
    simulated = None
    if played is None and "sim" in choice.names:
        simulated = _simulated(options)
        check_run(choice, simulated, detects=_detects(choice.names, simulated))
    elif options.overrides:
        raise ConfigError(
            f"{', '.join(options.overrides)}: the scenario is decided where the role sim runs"
        )
    named = played or simulated
    folder = RunFolder.at(options.out, named.name if named else str(choice))
    rows = [row if played is None else in_replay(row) for row in choice.roles if row is not MCAP]
    modules = list(dict.fromkeys(f"{row.module}.role" for row in rows))
    try:
        run_dir = folder.make()
        compile_ahead(console)
        with written(run_dir):  # imports while the setup is being made
            preload(modules, run_dir / "logs" / LOG_NAME)
        if played is not None:
            setup = played.setup(run_dir)
            scenario = scenarios.validate(setup.scenario, "the replay")
        else:
            setup, scenario = _setup(simulated, endpoints, run_dir, options.restart, console)
        _check(choice, options, scenario)
        packed = encode(setup)
        processes, relays = processes_of(choice, scenario), relays_of(choice, scenario)
        if MCAP in (process.role for process in processes):
            import recording.mcap  # noqa: F401 - says what to install, if it must be
        check_keys(options.keys, relays + processes)
        _refuse_duplicates(endpoints[BusName.WORLD], processes, options.restart, console)
        with written(run_dir):
            (run_dir / "setup.msgpack").write_bytes(packed)
            shown = json.dumps(setup.scenario, indent=2) + "\n"
            (run_dir / "scenario.json").write_text(shown, "utf-8")
    except BaseException:  # Ctrl-C and SIGTERM too
        folder.take_back()
        raise
    started = [process.id if choice.ids else process.role.role for process in processes]
    here = ", ".join(dict.fromkeys(started))
    console.print(f"{scenario.name}: {here} → {run_dir}", markup=False, soft_wrap=True)
    for warning in link_warnings(setup.scenario) if "sim" in choice.names else ():
        console.print(f"warning: {warning}", style="yellow", markup=False, soft_wrap=True)
    return PreparedRun(scenario, endpoints, run_dir, relays, processes)


def _check(choice: RoleSelection, options: Options, scenario: scenarios.Scenario) -> None:
    """Checks before the start that the roles of this machine can run."""
    if scenario.replay is None:
        _check_scans(choice.names, scenario.model_dump(mode="json"))
    if _detects(choice.names, scenario):
        check_detector(scenario.edge.detector)
        check(scenario.edge)
    if "edge" in choice.names:
        check_fusion(scenario.edge.fusion)
    if "signal" in choice.names:
        check_policy(scenario.signal)
    _check_restart(options, scenario)


def _simulated(options: Options) -> scenarios.Scenario:
    scenario = scenarios.load(options.scenario, options.overrides)
    if scenario.replay is not None:
        raise ConfigError(f"replay: that is played by `cpnet replay {scenario.replay.recording}`")
    return scenario


def _check_scans(names: list[str], scenario: dict[str, Any]) -> None:
    """Checks that the scan sources of this machine's roles are available."""
    if PLAYERS.intersection(names):
        check_recording(scenario)
    if SENSING.intersection(names):
        from sensing.source import check_source  # imports the ray caster

        check_source(scenario)


def _check_restart(options: Options, scenario: scenarios.Scenario) -> None:
    if options.restart and scenario.mode != "realtime":
        raise ConfigError(
            "--restart needs the wall clock: give --mode realtime. In lockstep the world waits for "
            "every frame, and a run in which a process died could not be repeated"
        )


def _setup(
    simulated: scenarios.Scenario | None,
    endpoints: Endpoints,
    run_dir: Path,
    restart: bool,
    console: Console,
) -> tuple[Setup, scenarios.Scenario]:
    if simulated is not None:
        # SUMO is needed only where the world runs.
        from sim_host.setup import build_setup

        with written(run_dir):
            setup = build_setup(simulated.model_dump(mode="json"), run_dir)
        return setup, scenarios.validate(setup.scenario, "the scenario")
    place = connecting(endpoints[BusName.WORLD])
    with connected_to_world(place, console, wait_forever=restart) as world:
        setup = world.setup()
    return setup, scenarios.validate(setup.scenario, "the scenario of the other side")


def _refuse_duplicates(
    world: Endpoint, processes: list[ProcessEntry], restart: bool, console: Console
) -> None:
    if not world.listen:  # else no process can be there yet
        with connected_to_world(connecting(world), console, wait_forever=restart) as found:
            found.refuse_duplicates(process.id for process in processes)


def _detects(roles: list[str], scenario: scenarios.Scenario) -> bool:
    """Whether detectors run here: on the edge, or on agents that send boxes."""
    kinds: dict[str, AgentKind] = {"vehicle": "vehicle", "infra": "roadside"}
    policies = [scenario.upload.of(kinds[role]).policy for role in roles if role in kinds]
    return "edge" in roles or any(policy_of(policy).sends == "objects" for policy in policies)
