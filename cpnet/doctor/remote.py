"""What answers where a bus is said to be, step by step: TCP, Zenoh, cpnet, its clock."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass

from cpnet.doctor.finding import Finding
from cpnet.doctor.reach import HOSTS, reach
from protocol.bus import Endpoint, ZenohBus, open_bus
from protocol.clock import BURST, Exchange, OffsetFilter, this_machine
from protocol.errors import BusError
from protocol.inbox import Inbox
from protocol.messages import Setup, TimeReply
from protocol.roll import Roll
from protocol.topics import BusName
from protocol.version import own_version

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
class Clock:
    """The world's clock as seen from here."""

    is_here: bool
    offset_ns: int
    error_ns: int
    round_trip_ns: int


def examine_bus(name: BusName, endpoint: Endpoint) -> Iterator[Finding]:
    """Goes as far as the other side answers."""
    reached = reach(name, endpoint.locator)
    yield reached
    if not reached.ok:
        return
    try:
        # Opened as the world's, whichever it is meant to be: only the world's host tells the time.
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
    roll = Roll.of(bus.roll_call(ANSWER_S))
    present = roll.present
    clock = ask_clock(bus)
    if roll.strangers:
        yield _of_another_version(name, roll)
    if clock is not None and name is BusName.V2X:
        yield _mistaken(name, BusName.WORLD, "below")
    elif clock is None and name is BusName.WORLD and present:
        yield _mistaken(name, BusName.V2X, "above")
    elif present:
        what = f"on the {name.value} bus: {', '.join(present)}"
        yield Finding(f"{name.value}_processes", what, ok=True, measured={"processes": present})
    elif not roll.strangers:
        what, advice = f"on the {name.value} bus: nobody", "still starting, or not a bus of cpnet?"
        yield Finding(f"{name.value}_processes", what, ok=False, advice=advice)
    if clock is not None and name is BusName.WORLD:
        yield _clock(clock)
        yield from _version(bus)


def ask_clock(bus: ZenohBus) -> Clock | None:
    """Returns what the world's host tells of its clock, None if nobody there does.

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
        exchange = Exchange(asked_ns, reply.heard_ns, reply.told_ns, time.monotonic_ns())
        offsets.add(exchange)
        round_trips_ns.append(2 * exchange.error_ns)
        is_here = reply.machine == this_machine()
    best = offsets.best(time.monotonic_ns())
    return Clock(is_here, *best, min(round_trips_ns)) if best else None


def _clock(clock: Clock) -> Finding:
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


def _of_another_version(name: BusName, roll: Roll) -> Finding:
    what = f"on the {name.value} bus: processes that speak protocol {', '.join(roll.strangers)}"
    return Finding(f"{name.value}_protocol", what, ok=False, advice=roll.misfit())


def _mistaken(name: BusName, found: BusName, way: str) -> Finding:
    advice = (
        f"this is the {found.value} bus; the {name.value} bus lives where the role {HOSTS[name]} "
        f"runs, one port {way} if both are on one machine"
    )
    return Finding(f"{name.value}_mistaken", f"the {name.value} bus", ok=False, advice=advice)
