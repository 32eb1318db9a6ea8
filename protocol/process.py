"""The life of a role's process: arguments, buses, log, signals, one loop.

    python -m edge_server --id edge --setup RUN/setup.msgpack --run RUN
                          --v2x listen:tcp/127.0.0.1:7447 --world connect:tcp/127.0.0.1:7448

A process ends when its role sets `stop`, on SIGINT or SIGTERM, or when its standard input
closes: a supervisor that dies takes its processes with it.
"""

from __future__ import annotations

import argparse
import gc
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from protocol.access import Keys, members_of
from protocol.bus import Bus, Endpoint, ZenohBus, open_bus, with_send_buffer
from protocol.clock import ClockWatch, time_reply
from protocol.errors import CpnetError, ProtocolError
from protocol.inbox import Envelope, Inbox, Presence
from protocol.limits import MAX_BATCH
from protocol.logs import LogStyle, configure
from protocol.messages import Setup
from protocol.topics import BusName
from protocol.wire import decode

POLL_S = 0.02
_NEW_OBJECTS = 50_000  # before Python collects cycles, 700 by default
WORLD_ID = "sim"  # serves setup and time, and has the reference clock
_NOWHERE = Endpoint("", listen=False)  # for a role that is built without a network
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class Context:
    """The environment of a role: its buses, inbox and setup.

    `open_v2x` opens one more V2X session, with a connection of its own to `uplink`: the edge's
    router, or a relay before it.
    """

    id: str
    setup: Setup
    run_dir: Path
    world: Bus
    v2x: Bus
    inbox: Inbox
    stop: threading.Event
    open_v2x: Callable[[], Bus]
    v2x_endpoint: Endpoint = _NOWHERE
    uplink: Endpoint = _NOWHERE

    def announce(self, role: str) -> None:
        """Announces on both buses that this process is ready."""
        self.world.announce(role, self.id)
        self.v2x.announce(role, self.id)


class Role(Protocol):
    """A pure class behind a process: it knows messages, not transports."""

    def on(self, item: Envelope | Presence) -> None:
        """Handles a received message or a change of presence."""

    def poll(self) -> None:
        """Acts; called when all received items were handled, and at least every 20 ms."""

    def close(self) -> None:
        """Writes pending data and releases resources."""


def run(role_name: str, build: Callable[[Context], Role]) -> None:
    """Runs a role until it is stopped; exits 0, or 1 with the reason in the log."""
    arguments = _parse(role_name, sys.argv[1:])
    configure(arguments.id, arguments.log)
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    if arguments.supervised:
        threading.Thread(target=_stop_at_end_of_input, args=(stop,), daemon=True).start()
    try:
        _live(arguments, build, stop)
    except CpnetError as error:
        _log.error("%s", error)
        sys.exit(1)


def read_setup(path: Path) -> Setup:
    """Reads the setup file that the supervisor wrote."""
    return decode(path.read_bytes(), Setup)


def _live(
    arguments: argparse.Namespace, build: Callable[[Context], Role], stop: threading.Event
) -> None:
    inbox = Inbox()
    setup = read_setup(arguments.setup)
    members = members_of(setup.scenario) if arguments.keys else None
    world = open_bus(BusName.WORLD, arguments.world, inbox, members=members)
    is_world = arguments.id == WORLD_ID
    if is_world:
        world.serve("setup", setup)  # before all else: the V2X bus's host may wait for it
        world.answer("time", time_reply())
    v2x = open_bus(BusName.V2X, arguments.v2x, inbox, members=members)
    clock = None if is_world else ClockWatch(arguments.id, world)
    if clock is not None:
        clock.start()
    uplink = arguments.uplink or replace(arguments.v2x, listen=False)
    context = Context(
        arguments.id,
        setup,
        arguments.run,
        world,
        v2x,
        inbox,
        stop,
        lambda: open_bus(BusName.V2X, with_send_buffer(uplink), inbox),
        arguments.v2x,
        uplink,
    )
    try:
        role = build(context)
        collect_seldom()
        try:
            loop(role, inbox, stop)
        finally:
            role.close()
    finally:
        if clock is not None:
            clock.stop()
        _close(v2x, world)


def collect_seldom() -> None:
    """Makes Python's garbage collector run less often: messages hold no cycles."""
    gc.freeze()
    gc.set_threshold(_NEW_OBJECTS)


def loop(role: Role, inbox: Inbox, stop: threading.Event) -> None:
    """Delivers all received items to the role, then lets it act, until `stop` is set.

    A message that a role fails on is counted: no message may end a process.
    """
    while not stop.is_set():
        item = inbox.get(POLL_S)
        taken = 0
        while item is not None:
            deliver(role, inbox, item)
            taken += 1
            item = inbox.get() if taken < MAX_BATCH else None
        role.poll()


def deliver(role: Role, inbox: Inbox, item: Envelope | Presence) -> None:
    """Delivers an item to a role; one that it fails on is counted."""
    topic = item.topic if isinstance(item, Envelope) else "alive"
    try:
        role.on(item)
    except ProtocolError as error:
        inbox.refuse(topic, error)
    except (ValueError, LookupError, TypeError) as error:
        inbox.fail(topic, error)


def _close(*buses: ZenohBus) -> None:
    for bus in buses:
        bus.close()


def _stop_at_end_of_input(stop: threading.Event) -> None:
    while os.read(0, 1):
        pass
    stop.set()


def _parse(role_name: str, words: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog=f"python -m {role_name}", description=__doc__)
    parser.add_argument("--id", required=True, help="the process's own name, such as vehicle-0")
    parser.add_argument("--setup", required=True, type=Path, help="setup file of the run")
    parser.add_argument("--run", required=True, type=Path, help="run folder")
    parser.add_argument("--world", required=True, type=Endpoint.parse, help="listen:… or connect:…")
    parser.add_argument("--v2x", required=True, type=Endpoint.parse, help="listen:… or connect:…")
    parser.add_argument("--uplink", type=Endpoint.parse, help="agents: another way to the V2X bus")
    parser.add_argument("--keys", type=Path, help="folder of `cpnet keys`, for locators of tls/")
    parser.add_argument("--log", type=LogStyle, default=LogStyle.TEXT, help="text or json")
    parser.add_argument("--supervised", action="store_true", help="stop when standard input closes")
    arguments = parser.parse_args(words)
    if arguments.keys:
        keys = Keys.of(arguments.keys, arguments.id)
        for way in ("world", "v2x", "uplink"):
            if endpoint := getattr(arguments, way):
                setattr(arguments, way, replace(endpoint, keys=keys))
    return arguments
