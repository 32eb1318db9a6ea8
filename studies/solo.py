"""A whole lockstep run in one process: the same roles, the same messages, the same rows.

Without a network and without other processes to wait for, one core plays many times as fast as the
clock: what a study of many runs needs. SUMO keeps its state globally, so one run at a time.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
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
STUCK_NS = 120_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class _Seat:
    """One role's place in the round."""

    role: Role
    inbox: Inbox
    stop: threading.Event

    def turn(self) -> bool:
        """Hands over all that came in and lets the role act; tells whether anything had come."""
        taken = 0
        while taken < MAX_BATCH and (item := self.inbox.get()) is not None:
            hand_over(self.role, self.inbox, item)
            taken += 1
        self.role.poll()
        return taken > 0


def play(scenario: dict[str, Any], run_dir: Path) -> None:
    """Plays a scenario to its end; the run folder is as `cpnet up --mode lockstep` leaves it.

    Args:
        scenario: of mode lockstep, with every key.
        run_dir: an empty folder.

    Raises:
        ConfigError: the scenario cannot be played.
        BusError: the roles wait for one another.
    """
    setup = build_setup(scenario, run_dir)
    (run_dir / "setup.msgpack").write_bytes(encode(setup))
    table = _Table(setup, run_dir)
    builders: list[tuple[str, Callable[[Context], Role]]] = [
        ("record", RecordRole.build),
        ("edge", EdgeRole.build),
        ("signal", SignalRole.build),
        *((f"infra-{n}", InfraRole) for n in range(len(scenario["roadside_mounts"]))),
        *((f"vehicle-{n}", VehicleRole) for n in range(scenario["processes"]["vehicle"])),
    ]
    with ExitStack() as stack:
        # The world ends last: with it goes what others may still ask.
        sim = stack.enter_context(table.seat("sim", SimRole.build))
        others = [stack.enter_context(table.seat(name, build)) for name, build in builders]
        _go_round([sim, *others])


class _Table:
    """Where all roles sit: the two buses."""

    def __init__(self, setup: Setup, run_dir: Path) -> None:
        self._setup = setup
        self._run_dir = run_dir
        self._hubs = {name: Hub(name) for name in BusName}

    @contextmanager
    def seat(self, name: str, build: Callable[[Context], Role]) -> Iterator[_Seat]:
        """Builds a role and gives it its seat until the end."""
        inbox, stop = Inbox(), threading.Event()
        world, v2x = (self._hubs[bus].open(inbox) for bus in (BusName.WORLD, BusName.V2X))
        context = Context(
            name, self._setup, self._run_dir, world, v2x, inbox, stop,
            lambda: self._hubs[BusName.V2X].open(inbox),
        )  # fmt: skip
        role = build(context)
        try:
            yield _Seat(role, inbox, stop)
        finally:
            role.close()
            v2x.close()
            world.close()


def _go_round(seats: list[_Seat]) -> None:
    """Gives everybody a turn, again and again, until the world and the recorder are done."""
    busy_ns = time.monotonic_ns()
    while not all(seat.stop.is_set() for seat in seats[:2]):
        moved = [seat.turn() for seat in seats]
        if any(moved):
            busy_ns = time.monotonic_ns()
            continue
        if time.monotonic_ns() - busy_ns > STUCK_NS:
            raise BusError("nobody has said anything for two minutes: the roles wait for another")
        time.sleep(IDLE_S)
