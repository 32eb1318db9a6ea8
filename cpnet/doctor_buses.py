"""`cpnet doctor --connect`: checks of the buses of other machines."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass

from cpnet.endpoints import address_of
from cpnet.findings import Finding
from protocol.bus import Endpoint, ZenohBus, open_bus
from protocol.clock import BURST, Exchange, OffsetFilter, this_machine
from protocol.errors import BusError
from protocol.inbox import Inbox
from protocol.instances import ROUTER, WORLD_HOST
from protocol.messages import Setup, TimeReply
from protocol.topics import BusName
from protocol.version import PresentProcesses, own_version

TCP_S = 1.5
HOSTS = {BusName.V2X: ROUTER, BusName.WORLD: WORLD_HOST}


def reach(bus: BusName, locator: str) -> Finding:
    """Checks that a TCP connection can be made."""
    host, port = address_of(locator)
    what, check = f"the {bus.value} bus at {host}:{port}", f"{bus.value}_reached"
    began_ns = time.monotonic_ns()
    try:
        socket.create_connection((host, port), TCP_S).close()
    except (OSError, UnicodeError) as error:
        return Finding(check, what, ok=False, advice=_advise(bus, error))
    took_ms = (time.monotonic_ns() - began_ns) / 1e6
    told = f"{what} answers within {took_ms:.1f} ms"
    return Finding(check, told, ok=True, measured={"connect_ms": round(took_ms, 3)})


def _advise(bus: BusName, error: OSError | UnicodeError) -> str:
    if isinstance(error, ConnectionRefusedError):
        return (
            "the machine is there, but nobody listens at this port: is the role "
            f"{HOSTS[bus]} running there, with --listen, and on this port?"
        )
    if isinstance(error, TimeoutError):
        return "no answer: is the machine on, and does a firewall let this TCP port through?"
    if isinstance(error, socket.gaierror | UnicodeError):
        return "there is no such host: check its name, or give its address"
    return f"{error.strerror or error}: check the address and the way to it"


ZENOH_MS = 1_500
ANSWER_S = 0.5
CLOCK_S = 1.0
CLOSE_S = 0.5
_PLAIN = (
    "something listens there, but it does not speak Zenoh without keys: check the port, or give "
    "--keys DIR"
)
_WITH_KEYS = (
    "something listens there, but it does not speak Zenoh over TLS, or its certificate is of "
    "another authority or names other hosts (`cpnet keys --host`)"
)


@dataclass(frozen=True, slots=True)
class RemoteClock:
    """Offset of the world's clock, measured from here."""

    is_here: bool
    offset_ns: int
    error_ns: int
    round_trip_ns: int


def examine_bus(name: BusName, endpoint: Endpoint) -> Iterator[Finding]:
    """Checks a bus step by step, as far as the other side answers."""
    reached = reach(name, endpoint.locator)
    yield reached
    if not reached.ok:
        return
    try:
        # Opened as the world bus, whichever it should be: only the world's host serves the time.
        bus = open_bus(BusName.WORLD, endpoint, Inbox(), ZENOH_MS)
    except BusError:
        advice = _WITH_KEYS if endpoint.keys else _PLAIN
        yield Finding(f"{name.value}_zenoh", f"the {name.value} bus", ok=False, advice=advice)
        return
    try:
        yield from _ask(name, bus)
    finally:
        closing = threading.Thread(target=bus.close, daemon=True)
        closing.start()
        closing.join(CLOSE_S)


def _ask(name: BusName, bus: ZenohBus) -> Iterator[Finding]:
    roll = PresentProcesses.of(bus.list_present(ANSWER_S))
    present = roll.present
    clock = ask_clock(bus)
    if roll.other_versions:
        yield _of_another_version(name, roll)
    if clock is not None and name is BusName.V2X:
        yield _mistaken(name, BusName.WORLD, "below")
    elif clock is None and name is BusName.WORLD and present:
        yield _mistaken(name, BusName.V2X, "above")
    elif present:
        what = f"on the {name.value} bus: {', '.join(present)}"
        yield Finding(f"{name.value}_processes", what, ok=True, measured={"processes": present})
    elif not roll.other_versions:
        what, advice = f"on the {name.value} bus: nobody", "still starting, or not a bus of cpnet?"
        yield Finding(f"{name.value}_processes", what, ok=False, advice=advice)
    if clock is not None and name is BusName.WORLD:
        yield _clock(clock)
        yield from _version(bus)


def ask_clock(bus: ZenohBus) -> RemoteClock | None:
    """Returns the offset of the world's clock, None if no process there serves it.

    Raises:
        ProtocolError: the answer is none.
    """
    offsets, is_here = OffsetFilter(), False
    round_trips_ns: list[int] = []
    give_up_ns = time.monotonic_ns() + round(CLOCK_S * 1e9)
    while len(round_trips_ns) < BURST and time.monotonic_ns() < give_up_ns:
        asked_ns = time.monotonic_ns()
        reply = bus.ask("time", TimeReply, ANSWER_S)
        if reply is None:
            break
        exchange = Exchange(asked_ns, reply.received_ns, reply.replied_ns, time.monotonic_ns())
        offsets.add(exchange)
        round_trips_ns.append(2 * exchange.error_ns)
        is_here = reply.machine == this_machine()
    best = offsets.best(time.monotonic_ns())
    return RemoteClock(is_here, *best, min(round_trips_ns)) if best else None


def _clock(clock: RemoteClock) -> Finding:
    round_trip_ms = clock.round_trip_ns / 1e6
    offset_ms, error_ms = (0, 0) if clock.is_here else (clock.offset_ns / 1e6, clock.error_ns / 1e6)
    told = f"{offset_ms:+.3f} ms ± {error_ms:.3f} ms"
    told = "that of this machine" if clock.is_here else told
    what = f"the world's clock: {told}, round trip {round_trip_ms:.2f} ms"
    measured = {"round_trip_ms": round_trip_ms, "offset_ms": offset_ms, "error_ms": error_ms}
    return Finding("world_clock", what, ok=True, measured=measured)


def _version(bus: ZenohBus) -> Iterator[Finding]:
    setup = bus.ask("setup", Setup, CLOCK_S)
    if setup is None:
        advice = f"did not come within {CLOCK_S:g} s: a slow link?"
        yield Finding("world_version", "the run's setup", ok=False, advice=advice, optional=True)
        return
    theirs, own = setup.version or "of an unknown version", own_version()
    ok = theirs == own
    advice = "" if ok else f"here {own}: install the same on all machines"
    what = f"the world runs cpnet {theirs}"
    measured = {"version": theirs, "scenario": str(setup.scenario.get("name", ""))}
    yield Finding("world_version", what, ok, advice, optional=True, measured=measured)


def _of_another_version(name: BusName, roll: PresentProcesses) -> Finding:
    what = (
        f"on the {name.value} bus: processes that speak protocol {', '.join(roll.other_versions)}"
    )
    return Finding(f"{name.value}_protocol", what, ok=False, advice=roll.mismatch())


def _mistaken(name: BusName, found: BusName, way: str) -> Finding:
    advice = (
        f"this is the {found.value} bus; the {name.value} bus lives where the role {HOSTS[name]} "
        f"runs, one port {way} if both are on one machine"
    )
    return Finding(f"{name.value}_mistaken", f"the {name.value} bus", ok=False, advice=advice)
