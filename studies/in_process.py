"""A whole lockstep run in one process: the same roles, the same messages, the same rows.

Without a network and without other processes to wait for, one core plays many times as fast as the
clock: what a study of many runs needs. SUMO keeps its state globally, so one run at a time.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from edge_server.role import EdgeRole
from infra_agent.role import InfraRole
from protocol.errors import BusError
from protocol.hub import Hub
from protocol.inbox import Inbox
from protocol.messages import Setup
from protocol.process import MAX_BATCH, Context, Role, hand_over
from protocol.topics import BusName
from protocol.wire import encode
from recorder.role import RecordRole
from signal_controller.role import SignalRole
from sim_host.role import SimRole
from sim_host.setup import build_setup
from vehicle_agent.role import VehicleRole

IDLE_S = 0.001  # what waits for the clock alone, as the recorder's end does
STALL_NS = 120_000_000_000
Builder = Callable[[Context], Role]


class _RoleSlot:
    """One role's place in the round."""

    def __init__(self, name: str, context: Context, build: Builder) -> None:
        self.name = name
        self._context = context
        self._role = build(context)
        self.has_left = False

    @property
    def is_done(self) -> bool:
        """Whether the role wants to leave."""
        return self._context.stop.is_set()

    def turn(self) -> bool:
        """Hands over all that came in and lets the role act; tells whether anything had come."""
        taken, inbox = 0, self._context.inbox
        while taken < MAX_BATCH and (item := inbox.get()) is not None:
            hand_over(self._role, inbox, item)
            taken += 1
        self._role.poll()
        return taken > 0

    def leave(self) -> None:
        """Ends the role and hangs up, once."""
        if not self.has_left:
            self.has_left = True
            self._role.close()
            self._context.v2x.close()
            self._context.world.close()


def run_in_process(scenario: dict[str, Any], run_dir: Path) -> None:
    """Plays a scenario to its end; the run folder is as `cpnet up --mode lockstep` leaves it.

    Args:
        scenario: of mode lockstep, with every key.
        run_dir: an empty folder.

    Raises:
        ConfigError: the scenario cannot be played.
        BusError: the roles wait for one another.
    """
    run_setup_in_process(build_setup(scenario, run_dir), run_dir)


def run_setup_in_process(setup: Setup, run_dir: Path) -> None:
    """Plays what a setup says, be it a tape.

    Raises:
        ConfigError: the scenario cannot be played.
        BusError: the roles wait for one another.
    """
    (run_dir / "setup.msgpack").write_bytes(encode(setup))
    table = _Buses(setup, run_dir)
    sim_builder, builders = _builders(setup.scenario)
    with ExitStack() as stack:

        def seat(name: str, build: Builder) -> _RoleSlot:
            taken = _RoleSlot(name, table.context(name), build)
            stack.callback(taken.leave)
            return taken

        sim = seat("sim", sim_builder)  # leaves last: with the world goes what others may ask
        _run_until_done(sim, [seat(name, build) for name, build in builders])


def _builders(scenario: dict[str, Any]) -> tuple[Builder, list[tuple[str, Builder]]]:
    """Returns what makes the world's role, and the others' by their ids."""
    world: Builder = SimRole.build
    infra: Builder = InfraRole
    vehicle: Builder = VehicleRole
    if scenario.get("replay"):
        from player.role import PlayerRole  # tapes need an extra
        from player.sim import sim_role

        world, infra, vehicle = sim_role, PlayerRole.build, PlayerRole.build
    return world, [
        ("record", RecordRole.build),
        ("edge", EdgeRole.build),
        ("signal", SignalRole.build),
        *((f"infra-{n}", infra) for n in range(len(scenario["roadside_mounts"]))),
        *((f"vehicle-{n}", vehicle) for n in range(scenario["processes"]["vehicle"])),
    ]


class _Buses:
    """Where all roles sit: the two buses."""

    def __init__(self, setup: Setup, run_dir: Path) -> None:
        self._setup = setup
        self._run_dir = run_dir
        self._hubs = {name: Hub(name) for name in BusName}

    def context(self, name: str) -> Context:
        """Returns what a role of this name is handed."""
        inbox = Inbox()
        v2x = self._hubs[BusName.V2X]
        return Context(
            name,
            self._setup,
            self._run_dir,
            self._hubs[BusName.WORLD].open(inbox),
            v2x.open(inbox),
            inbox,
            threading.Event(),
            lambda: v2x.open(inbox),
        )


def _run_until_done(sim: _RoleSlot, others: list[_RoleSlot]) -> None:
    """Gives everybody a turn, again and again, until the world is done and the recorder has left.

    Agents leave when they hear of the end; edge and signal stay as long as they are asked.
    """
    record = next(seat for seat in others if seat.name == "record")
    busy_ns = time.monotonic_ns()
    while not (sim.is_done and record.has_left):
        moved = False
        for seat in [sim, *others]:
            if seat.has_left or (seat is sim and sim.is_done):
                continue
            moved |= seat.turn()
            if seat is not sim and seat.is_done:
                seat.leave()
        if moved:
            busy_ns = time.monotonic_ns()
        elif time.monotonic_ns() - busy_ns > STALL_NS:
            raise BusError("nobody has said anything for two minutes: the roles wait for another")
        else:
            time.sleep(IDLE_S)
