"""`cpnet up`: from options to a run that ends well, or that says what went wrong."""

from __future__ import annotations

import json
import shutil
import signal
import threading
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from cpnet import netns
from cpnet import scenario as scenarios
from cpnet.display import Display
from cpnet.endpoints import Endpoints, connecting, resolve
from cpnet.processes import choose_roles, processes_of, relays_of
from cpnet.supervisor import Death, Supervisor
from cpnet.watch import Watch
from perception.registry import check
from protocol.bus import Endpoint, fetch
from protocol.errors import BusError, ConfigError, MessageError
from protocol.messages import Setup
from protocol.topics import BusName
from protocol.wire import encode
from sensing.radio import AgentKind
from sensing.source import check_recording
from sensing.upload.registry import POLICIES

POLL_S = 0.1
OVERTAKEN_S = 2.0
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
OTHERS_LEAVE_S = 5.0
PLAYERS = {"sim", "vehicle", "infra"}  # who plays a recording, if there is one


@dataclass(frozen=True, slots=True)
class Options:
    """What the user asked `cpnet up` for."""

    scenario: str
    overrides: dict[str, Any]
    only: str | None
    listen: list[str]
    connect: list[str]
    out: Path | None


def up(options: Options, console: Console) -> tuple[int, Path]:
    """Runs the roles of this machine to the end; returns the exit status and the run folder.

    Raises:
        ConfigError: the options or the scenario cannot be.
        MessageError: the roads are too large for a message.
        BusError: the other side cannot be reached.
    """
    roles = choose_roles(options.only)
    names = [row.role for row in roles]
    endpoints = resolve(options.listen, options.connect, {r.hosts for r in roles if r.hosts})
    asked = None
    if "sim" in names:
        asked = scenarios.load(options.scenario, options.overrides)
    elif options.overrides:
        raise ConfigError(
            f"{', '.join(options.overrides)}: the scenario is decided where the role sim runs"
        )
    run_dir = _make_run_dir(options.out, asked.name if asked else "-".join(names))
    try:
        setup, scenario = _setup(asked, endpoints, run_dir)
        if PLAYERS.intersection(names):
            check_recording(setup.scenario)
        if _detects(names, scenario):
            check(scenario.edge)
        packed = encode(setup)
        relays = relays_of(roles, scenario)
        netns.prepare(scenario, relays, console)
    except (ConfigError, MessageError):
        shutil.rmtree(run_dir, ignore_errors=True)
        raise
    (run_dir / "setup.msgpack").write_bytes(packed)
    (run_dir / "scenario.json").write_text(json.dumps(setup.scenario, indent=2) + "\n", "utf-8")
    console.print(f"{scenario.name}: {', '.join(names)} → {run_dir}", markup=False, soft_wrap=True)
    with (
        Interruption() as interruption,
        netns.cleaned_up(scenario, relays),
        Supervisor(run_dir, endpoints) as supervisor,
    ):
        supervisor.start(relays + processes_of(roles, scenario))
        status = _attend(supervisor, endpoints, scenario, interruption, console)
    return status, run_dir


class Interruption:
    """Turns the signals that ask for an end into an event while a run goes on."""

    def __init__(self) -> None:
        self.event = threading.Event()
        self.number = 0

    def __enter__(self) -> Interruption:
        self._before = {n: signal.signal(n, self._take) for n in STOP_SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _take(self, number: int, _: object) -> None:
        self.number = number
        self.event.set()


def _setup(
    asked: scenarios.Scenario | None, endpoints: Endpoints, run_dir: Path
) -> tuple[Setup, scenarios.Scenario]:
    if asked is not None:
        # SUMO is needed only where the world runs.
        from sim_host.setup import build_setup

        try:
            return build_setup(asked.model_dump(mode="json"), run_dir), asked
        except OSError as error:
            raise ConfigError(f"run folder {run_dir} cannot be written: {error}") from None
    world = connecting(endpoints[BusName.WORLD])
    setup = fetch(BusName.WORLD, world, "setup", Setup)
    return setup, scenarios.validate(setup.scenario, "the scenario of the other side")


def _detects(roles: list[str], scenario: scenarios.Scenario) -> bool:
    """Whether vehicles are looked for here: by the edge, or by agents that send what they find."""
    kinds: dict[str, AgentKind] = {"vehicle": "vehicle", "infra": "roadside"}
    policies = [scenario.upload.of(kinds[role]).policy for role in roles if role in kinds]
    return "edge" in roles or any(POLICIES[policy].sends == "objects" for policy in policies)


def _make_run_dir(out: Path | None, name: str) -> Path:
    if out is None:
        stamp = datetime.now(UTC).strftime("%Y%m%d-%H%M%S-%f")[:-3]
        out = Path("runs") / f"{name}-{stamp}"
    if "," in str(out.absolute()):
        raise ConfigError(f"--out {out}: SUMO takes no path with a comma in it")
    try:
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise ConfigError(f"--out {out}: it exists and is not an empty folder")
        out.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise ConfigError(f"--out {out}: {error}") from None
    return out.resolve()


def _attend(
    supervisor: Supervisor,
    endpoints: Endpoints,
    scenario: scenarios.Scenario,
    interruption: Interruption,
    console: Console,
) -> int:
    death, reason = None, ""
    watch = _watch(supervisor, connecting(endpoints[BusName.WORLD]), interruption)
    if isinstance(watch, Death):
        death = watch
    elif watch is not None:
        with watch, Display(console, scenario) as display:
            death = _follow(supervisor, watch, display, interruption)
            reason = watch.end.reason if watch.end else ""
    if interruption.event.is_set():
        console.print(f"stopping ({signal.Signals(interruption.number).name})")
        return 128 + interruption.number
    if death is not None:
        console.print(f"[bold red]{escape(death.id)} {death.how}[/]; the last lines of its log:")
        console.print(death.tail, highlight=False, markup=False, soft_wrap=True)
        return 1
    if reason != "finished":
        console.print(
            f"the world ended before its time: {reason or 'nobody said why'}", markup=False
        )
        return 1
    return 0


def _watch(
    supervisor: Supervisor, world: Endpoint, interruption: Interruption
) -> Watch | Death | None:
    """Listens to the world as soon as its bus is there; a process may die before."""
    while not interruption.event.is_set():
        if death := supervisor.death(at_end=False):
            return death
        try:
            return Watch(world)
        except BusError:
            interruption.event.wait(POLL_S)
    return None


def _follow(
    supervisor: Supervisor, watch: Watch, display: Display, interruption: Interruption
) -> Death | None:
    ended_ns = 0
    while not interruption.event.is_set():
        if watch.update(POLL_S) and watch.progress:
            display.show(watch.progress)
        if supervisor.death(at_end=False) and watch.end is None:
            watch.await_end(OVERTAKEN_S)  # the end may still be on its way
        if death := supervisor.death(at_end=watch.end is not None):
            return death
        if watch.end is None and (elsewhere := _lost_elsewhere(supervisor, watch)):
            return elsewhere
        if watch.end is not None:
            ended_ns = ended_ns or time.monotonic_ns()
            late = time.monotonic_ns() - ended_ns > OTHERS_LEAVE_S * 1e9
            if not supervisor.running("sim", "record") and (late or not watch.here("record")):
                return None
    return None


def _lost_elsewhere(supervisor: Supervisor, watch: Watch) -> Death | None:
    """Returns a process of another machine that left before the run's end."""
    for role, process in watch.lost():
        if not supervisor.holds(role):
            watch.await_end(OVERTAKEN_S)  # the end may still be on its way
            if watch.end is None:
                return Death(process, "left another machine before the run ended", "(no log here)")
    return None
