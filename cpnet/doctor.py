"""`cpnet doctor`: checks of this machine, of certificates, and of buses on other machines."""

from __future__ import annotations

import ctypes
import os
import socket
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cpnet.endpoints import address_of, connecting, resolve
from cpnet.exit_report import signal_name
from cpnet.needs import OPEN3D, SUMO, lacking
from cpnet.processes import ROLES
from cpnet.security import check_key
from cpnet.shadowing import same_path
from protocol.access import AUTHORITY
from protocol.bus import SEND_BUFFER_BYTES, Endpoint, ZenohBus, open_bus
from protocol.clock import BURST, Exchange, OffsetFilter, this_machine
from protocol.errors import BusError, ConfigError
from protocol.extras import to_install
from protocol.inbox import Inbox
from protocol.instances import ROUTER, WORLD_HOST
from protocol.messages import Setup, TimeReply
from protocol.topics import BusName
from protocol.version import PresentProcesses, own_version

Measured = Mapping[str, float | str | list[str]]


@dataclass(frozen=True, slots=True)
class Finding:
    """One check: what was looked at, whether it is well, and what to do if not.

    `check` never changes its name; what was measured stands in `measured`, with its unit. What is
    `absent` is not installed, and not every machine needs it.
    """

    check: str
    what: str
    ok: bool
    advice: str = ""
    optional: bool = False
    measured: Measured = field(default_factory=dict)
    absent: bool = False

    @property
    def is_well(self) -> bool:
        """Whether a run can do: all is well, or only what it may lack is not."""
        return self.ok or self.optional


def print_findings(findings: Iterable[Finding], console: Console) -> None:
    """Prints a line per check."""
    table = Table(box=None, show_header=False)
    for finding in findings:
        table.add_row(_mark(finding), escape(finding.what), escape(finding.advice))
    console.print(table)


def _mark(finding: Finding) -> str:
    if finding.absent:
        return "--"
    if finding.ok:
        return "[green]ok[/]"
    return "[yellow]hint[/]" if finding.optional else "[red]fault[/]"


def as_json(findings: list[Finding]) -> dict[str, Any]:
    """Returns the findings by stable keys."""
    well = all(finding.is_well for finding in findings)
    return {"ok": well, "findings": [asdict(finding) for finding in findings]}


SUMO_LIBRARIES = {
    "libstdc++.so.6": "libstdc++6",
    "libgcc_s.so.1": "libgcc-s1",
    "libz.so.1": "zlib1g",
    "libexpat.so.1": "libexpat1",
    "libatomic.so.1": "libatomic1",
    "libX11.so.6": "libx11-6",
    "libXext.so.6": "libxext6",
    "libXrender.so.1": "libxrender1",
    "libGL.so.1": "libgl1",
}
"""What SUMO's wheels link to but do not bring: shared library to Debian and Ubuntu package."""

OPEN3D_LIBRARIES = {
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libGL.so.1": "libgl1",
    "libgomp.so.1": "libgomp1",
}
"""The same of Open3D, which the detector `reference` needs."""


def missing_packages() -> list[str]:
    """Returns the system packages that SUMO, and Open3D if it is installed, lack here."""
    return _missing(SUMO_LIBRARIES | ({} if lacking(OPEN3D) else OPEN3D_LIBRARIES))


def libraries() -> list[Finding]:
    """Looks for the system libraries of SUMO and of Open3D, and for Open3D itself."""
    user = "Open3D (edge.detector=reference)"
    found = [
        _of("sumo_libraries", "SUMO", SUMO_LIBRARIES, optional=bool(lacking(SUMO))),
        _of("open3d_libraries", user, OPEN3D_LIBRARIES, optional=True),
    ]
    if lacking(OPEN3D):
        found.append(_absent("open3d", "Open3D", "reference", "edge.detector=reference"))
    return found


def _of(check: str, user: str, wanted: Mapping[str, str], *, optional: bool) -> Finding:
    missing = _missing(wanted)
    advice = f"apt-get install -y --no-install-recommends {' '.join(missing)}" if missing else ""
    what = f"{len(wanted)} system libraries of {user}"
    return Finding(check, what, not missing, advice, optional=optional)


def _absent(check: str, package: str, extra: str, user: str) -> Finding:
    what = f"{package} not installed (extra {extra}; only {user} needs it)"
    return Finding(check, what, ok=False, advice=to_install(extra), optional=True, absent=True)


def _missing(wanted: Mapping[str, str]) -> list[str]:
    return [package for library, package in wanted.items() if not _loads(library)]


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def send_buffer() -> list[Finding]:
    """Looks whether a socket takes a whole scan."""
    with socket.socket() as asked:
        asked.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        granted = asked.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF) // 2  # Linux doubles it
    ok = granted >= SEND_BUFFER_BYTES
    tune = f"sysctl -w net.core.wmem_max={SEND_BUFFER_BYTES}"
    advice = "" if ok else f"{tune}: else an agent waits while its link is full"
    what = f"send buffers of {granted >> 10} KiB"
    measured = {"send_buffer_bytes": granted}
    return [Finding("send_buffer", what, ok, advice, optional=True, measured=measured)]


_LOOPBACK_MS = 5_000


def bus_on_loopback() -> list[Finding]:
    """Hosts a bus and connects to it."""
    what = "a Zenoh bus over TCP on loopback"
    endpoint = resolve([], [], set(BusName))[BusName.V2X]
    try:
        router = open_bus(BusName.V2X, endpoint, Inbox())
        try:
            open_bus(BusName.V2X, connecting(endpoint), Inbox(), _LOOPBACK_MS).close()
        finally:
            router.close()
    except BusError as error:
        return [Finding("bus_on_loopback", what, ok=False, advice=str(error))]
    return [Finding("bus_on_loopback", what, ok=True)]


TRIAL_TIMEOUT_S = 15


def sumo_runs() -> list[Finding]:
    """Has SUMO simulate a step, where it is installed."""
    if lacking(SUMO):
        return [_absent("sumo", "SUMO", "sim", "the role sim")]
    command = [sys.executable, "-m", "sim_host.sumo"]
    try:
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=TRIAL_TIMEOUT_S,
            check=False,
            env=os.environ | same_path(),
        )
    except subprocess.TimeoutExpired:
        return [_sumo("SUMO", f"it did not simulate one step in {TRIAL_TIMEOUT_S} s")]
    if done.returncode == 0:
        return [_sumo(f"{done.stdout.strip().splitlines()[-1]} simulates a step", "")]
    return [_sumo("SUMO", f"{_how(done.returncode)}{_last_line(done.stderr)}")]


def _sumo(what: str, advice: str) -> Finding:
    return Finding("sumo", what, not advice, advice)


def _how(status: int) -> str:
    return f"it was killed by {signal_name(-status)} " if status < 0 else ""


def _last_line(text: str) -> str:
    return (text.strip().splitlines() or ["it ended without a word"])[-1][:300]


SOON_DAYS = 30
_HOSTS = {row.role for row in ROLES if row.hosts}


def certificates(folder: Path) -> Iterator[Finding]:
    """Looks through all that is there."""
    names = sorted(path.stem for path in folder.glob("*.pem") if path.name != AUTHORITY)
    if not names:
        advice = f"--keys {folder}: there is none; `cpnet keys` makes them"
        yield Finding("certificates", "certificates", ok=False, advice=advice)
    for name in names:
        yield _certificate(folder, name)
    yield from _exposed(folder)


def _exposed(folder: Path) -> Iterator[Finding]:
    """Tells of private keys that any user can read, and of the authority's beside machine's."""
    for path in sorted(folder.glob("*.key")):
        if path.stat().st_mode & stat.S_IROTH:
            advice = f"any user of this machine can read it: chmod o-rwx {path}"
            yield _key_hint("private_key", path, advice)
    authority_key = folder / f"{Path(AUTHORITY).stem}.key"
    if authority_key.exists():
        advice = "belongs on the machine that makes keys only: it makes any certificate"
        yield _key_hint("authority_key", authority_key, advice)


def _key_hint(check: str, path: Path, advice: str) -> Finding:
    return Finding(check, f"the private key {path.name}", ok=False, advice=advice, optional=True)


def _certificate(folder: Path, name: str) -> Finding:
    what = f"the certificate of {name}"
    try:
        until = check_key(folder, name, hosts=name in _HOSTS)
    except ConfigError as error:
        return Finding("certificate", what, ok=False, advice=str(error))
    days = (until - datetime.now(UTC)).days
    soon = days < SOON_DAYS
    return Finding(
        "certificate",
        f"{what} holds until {until:%Y-%m-%d}",
        ok=not soon,
        advice=f"{days} days are left: `cpnet keys` makes another once it is removed"
        if soon
        else "",
        optional=True,
        measured={"process": name, "days_left": days},
    )


TCP_S = 1.5
HOSTS = {BusName.V2X: ROUTER, BusName.WORLD: WORLD_HOST}


def reach(bus: BusName, locator: str) -> Finding:
    """Connects and hangs up."""
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
        # Opened as the world's, whichever it is meant to be: only the world's host serves the time.
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


REMOTE_S = 5.0
IMPLIED = "(one port above the V2X bus; give world=HOST:PORT if it is elsewhere)"


@dataclass(frozen=True, slots=True)
class Check:
    """What is looked at, for so long at most."""

    name: str
    look: Callable[[], Iterable[Finding]]
    limit_s: float = 10.0
    optional: bool = False


CHECKS = (
    Check("libraries", libraries),
    Check("sumo", sumo_runs, TRIAL_TIMEOUT_S + 1),
    Check("bus_on_loopback", bus_on_loopback),
    Check("send_buffer", send_buffer, optional=True),
)
"""In the order in which they are printed."""


def examine() -> list[Finding]:
    """Runs all checks of this machine."""
    return [finding for check in CHECKS for finding in carry_out(check)]


def examine_keys(folder: Path) -> list[Finding]:
    """Looks through the certificates of a folder."""
    return carry_out(Check("certificates", partial(certificates, folder)))


def examine_buses(places: Mapping[BusName, Endpoint], *, implied: bool = False) -> list[Finding]:
    """Asks the buses that are reached so; `implied` if the user did not name the world bus."""
    checks = [
        Check(f"{bus.value}_bus", partial(examine_bus, bus, endpoint), REMOTE_S)
        for bus, endpoint in places.items()
    ]
    found = [finding for check in checks for finding in carry_out(check)]
    return [_with_origin(finding) if implied else finding for finding in found]


def _with_origin(finding: Finding) -> Finding:
    """Explains a port that the user did not name."""
    if finding.ok or finding.check not in ("world_reached", "world_zenoh", "world_mistaken"):
        return finding
    return replace(finding, advice=f"{finding.advice} {IMPLIED}")


def carry_out(check: Check) -> list[Finding]:
    """Returns what a check found until it ended, failed, or had no more time."""
    found: list[Finding] = []

    def work() -> None:
        try:
            for finding in check.look():
                found.append(finding)  # noqa: PERF402 - those before an error are wanted too
        except Exception as error:  # noqa: BLE001 - whatever it is, the others are to be seen
            found.append(_failed(check, f"failed: {type(error).__name__}: {error}"))

    worker = threading.Thread(target=work, daemon=True)
    worker.start()
    worker.join(check.limit_s)
    if worker.is_alive():
        return [*found, _failed(check, f"did not end within {check.limit_s:g} s")]
    return found


def _failed(check: Check, how: str) -> Finding:
    what = f"the check {check.name}"
    return Finding(check.name, what, ok=False, advice=how, optional=check.optional)
