"""A lockstep run in one process: the same roles, messages and rows as with a process per role.

Without a network and other processes to wait for, one core runs much faster than real time, which
studies of many runs need. SUMO's state is global, so one run at a time.

`perceived_frames` pauses each frame between perception and control, for programs that observe or
control.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from edge_server.role import EdgeRole
from infra_agent.role import InfraRole
from protocol.bus import Bus
from protocol.errors import BusError, ConfigError
from protocol.in_process import InProcessRouter
from protocol.inbox import Inbox
from protocol.instances import ROUTER, instances_of, role_of
from protocol.limits import MAX_BATCH
from protocol.messages import Setup
from protocol.process import Context, Role, deliver
from protocol.topics import BusName
from protocol.wire import encode
from recording.role import RecordRole
from signal_controller.role import SignalRole
from sim_host.role import SimRole
from sim_host.setup import build_setup
from studies.simulated_frame import FrameCollector, SimulatedFrame
from v2x_router.role import RouterRole
from vehicle_agent.role import VehicleRole

IDLE_S = 0.001  # between polls when no message is waiting, as at the recorder's end
STALL_NS = 120_000_000_000
_RUNS = threading.Lock()
Builder = Callable[[Context], Role]


class _RoleSlot:
    """A role with its context, polled in turn."""

    def __init__(self, name: str, context: Context, build: Builder) -> None:
        self.name = name
        self._context = context
        self._role = build(context)
        self.is_closed = False

    @property
    def is_done(self) -> bool:
        """Whether the role has asked to stop."""
        return self._context.stop.is_set()

    def turn(self) -> bool:
        """Delivers waiting messages and polls the role; returns whether there were any."""
        delivered, inbox = 0, self._context.inbox
        while delivered < MAX_BATCH and (item := inbox.get()) is not None:
            deliver(self._role, inbox, item)
            delivered += 1
        self._role.poll()
        return delivered > 0

    def wait(self) -> None:
        """Waits for a message, such as from threads of the role, or for `IDLE_S`."""
        if (item := self._context.inbox.get(IDLE_S)) is not None:
            deliver(self._role, self._context.inbox, item)

    def close(self) -> None:
        """Closes the role and its buses, once."""
        if not self.is_closed:
            self.is_closed = True
            self._role.close()
            self._context.v2x.close()
            self._context.world.close()


def run_in_process(scenario: dict[str, Any], run_dir: Path) -> None:
    """Runs a scenario to its end; the run folder is as `cpnet up --mode lockstep` leaves it.

    Args:
        scenario: of mode lockstep, with every key.
        run_dir: an empty folder.

    Raises:
        ConfigError: the scenario cannot be run.
        BusError: the roles wait for each other.
    """
    run_setup_in_process(build_setup(scenario, run_dir), run_dir)


def run_setup_in_process(setup: Setup, run_dir: Path) -> None:
    """Runs a setup, also a replay.

    Raises:
        ConfigError: the scenario cannot be run.
        BusError: the roles wait for each other.
    """
    for _ in _frames(setup, run_dir, None):
        pass


def perceived_frames(setup: Setup, run_dir: Path) -> Iterator[SimulatedFrame]:
    """Runs a setup; yields each frame after perception, before signals decide.

    A policy of this program decides only after that. When the iterator is closed, the run ends.

    Raises:
        ConfigError: the scenario cannot be run.
        BusError: the roles wait for each other.
    """
    return _frames(setup, run_dir, FrameCollector(setup))


def _frames(
    setup: Setup, run_dir: Path, collector: FrameCollector | None
) -> Iterator[SimulatedFrame]:
    (run_dir / "setup.msgpack").write_bytes(encode(setup))
    buses = _Buses(setup, run_dir)
    sim_builder, builders = _role_builders(setup.scenario)
    with ExitStack() as stack:
        stack.enter_context(_the_only_run())

        def slot(name: str, build: Builder) -> _RoleSlot:
            made = _RoleSlot(name, buses.context(name), build)
            stack.callback(made.close)
            return made

        if collector is not None:
            for bus in BusName:
                collector.subscribe(buses.bus(bus, collector.inbox), bus)
        sim = slot("sim", sim_builder)  # closed last: others may still query it
        yield from _run_until_done(sim, [slot(name, build) for name, build in builders], collector)


@contextmanager
def _the_only_run() -> Iterator[None]:
    """Context manager that guards SUMO's state, of which a process has one.

    Raises:
        ConfigError: another run of this process has not ended.
    """
    if not _RUNS.acquire(blocking=False):
        raise ConfigError(
            "another run of this process has not ended, and SUMO takes one at a time: close its "
            "frames or environment first"
        )
    try:
        yield
    finally:
        _RUNS.release()


def _role_builders(scenario: dict[str, Any]) -> tuple[Builder, list[tuple[str, Builder]]]:
    """Returns the builders of the world's role, and of the others by their ids."""
    world: Builder = SimRole.build
    infra: Builder = InfraRole
    vehicle: Builder = VehicleRole
    if scenario.get("replay"):
        from recording.playback.role import PlayerRole  # MCAP recordings need an extra
        from recording.playback.world import sim_role

        world, infra, vehicle = sim_role, PlayerRole.build, PlayerRole.build
    builders: dict[str, Builder] = {
        ROUTER: RouterRole.build,
        "record": RecordRole.build,
        "edge": EdgeRole.build,
        "signal": SignalRole.build,
        "infra": infra,
        "vehicle": vehicle,
    }
    others = [one for one in instances_of(scenario) if one.role in builders]
    return world, [(one.id, builders[one.role]) for one in others]


class _Buses:
    """The two in-process buses, and the contexts of roles on them."""

    def __init__(self, setup: Setup, run_dir: Path) -> None:
        self._setup = setup
        self._run_dir = run_dir
        self._buses = {name: InProcessRouter(name) for name in BusName}

    def bus(self, name: BusName, inbox: Inbox) -> Bus:
        """Returns an access of its own to a bus."""
        return self._buses[name].bus(inbox)

    def context(self, name: str) -> Context:
        """Returns the context of the role of this name."""
        inbox = Inbox()
        v2x = self._buses[BusName.V2X]
        return Context(
            name,
            self._setup,
            self._run_dir,
            self._buses[BusName.WORLD].bus(inbox),
            v2x.bus(inbox),
            inbox,
            threading.Event(),
            lambda: v2x.bus(inbox),
        )


def _run_until_done(
    sim: _RoleSlot, roles: list[_RoleSlot], collector: FrameCollector | None
) -> Iterator[SimulatedFrame]:
    """Polls all roles in turn until the simulation is done and the recorder has stopped.

    Agents stop at the end of the run; edge and signal controller as soon as nothing is left to do.
    Signal controllers have no turn while a frame is perceived; then the frame is yielded.
    """
    record = next(slot for slot in roles if slot.name == "record")
    controllers = [slot for slot in roles if role_of(slot.name) == "signal"]
    decoding = [slot for slot in roles if role_of(slot.name) == "edge"]
    others = [slot for slot in (sim, *roles) if slot not in controllers]
    busy_ns = time.monotonic_ns()
    while not (sim.is_done and record.is_closed):
        moved = _take_turns([slot for slot in others if slot is not sim or not sim.is_done], sim)
        if collector is None:
            moved |= _take_turns(controllers, sim)
        else:
            frame = collector.take()
            if frame is not None:
                yield frame
            if not collector.is_waiting:
                moved |= _take_turns(controllers, sim)
            moved |= frame is not None
        if moved:
            busy_ns = time.monotonic_ns()
        elif time.monotonic_ns() - busy_ns > STALL_NS:
            raise BusError("no role received a message for two minutes: they wait for each other")
        else:
            next((slot for slot in decoding if not slot.is_closed), sim).wait()


def _take_turns(slots: list[_RoleSlot], sim: _RoleSlot) -> bool:
    """Gives each role a turn, closes those that are done; returns whether messages came."""
    moved = False
    for slot in slots:
        if slot.is_closed:
            continue
        moved |= slot.turn()
        if slot is not sim and slot.is_done:
            slot.close()
    return moved
