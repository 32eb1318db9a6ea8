"""`cpnet doctor`: checks of this machine, of certificates, and of buses on other machines."""

from __future__ import annotations

import ctypes
import os
import socket
import stat
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

from cpnet.doctor_buses import examine_bus
from cpnet.endpoints import connecting, resolve
from cpnet.exit_report import signal_name
from cpnet.findings import Finding
from cpnet.needs import OPEN3D, SUMO, lacking
from cpnet.processes import ROLES
from cpnet.security import check_key
from cpnet.shadowing import same_path
from protocol.access import AUTHORITY
from protocol.bus import SEND_BUFFER_BYTES, Endpoint, open_bus
from protocol.errors import BusError, ConfigError
from protocol.extras import to_install
from protocol.inbox import Inbox
from protocol.topics import BusName

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
"""Libraries that SUMO's wheels link to but do not bring: by name, the Debian/Ubuntu package."""

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
    """Checks the system libraries of SUMO and of Open3D, and Open3D itself."""
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
    """Checks whether a socket's send buffer takes a whole scan."""
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
    """Checks that SUMO, where it is installed, simulates a step."""
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
    """Checks all certificates of a folder."""
    names = sorted(path.stem for path in folder.glob("*.pem") if path.name != AUTHORITY)
    if not names:
        advice = f"--keys {folder}: there is none; `cpnet keys` makes them"
        yield Finding("certificates", "certificates", ok=False, advice=advice)
    for name in names:
        yield _certificate(folder, name)
    yield from _exposed(folder)


def _exposed(folder: Path) -> Iterator[Finding]:
    """Finds private keys that any user can read, and the CA's key beside a machine's."""
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


REMOTE_S = 5.0
IMPLIED = "(one port above the V2X bus; give world=HOST:PORT if it is elsewhere)"


@dataclass(frozen=True, slots=True)
class Check:
    """A check and its time limit."""

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
"""The checks, in the order in which they are printed."""


def examine() -> list[Finding]:
    """Runs all checks of this machine."""
    return [finding for check in CHECKS for finding in carry_out(check)]


def examine_keys(folder: Path) -> list[Finding]:
    """Runs the checks of the certificates of a folder."""
    return carry_out(Check("certificates", partial(certificates, folder)))


def examine_buses(places: Mapping[BusName, Endpoint], *, implied: bool = False) -> list[Finding]:
    """Checks the buses at these endpoints; `implied` if the user did not name the world bus."""
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
        except Exception as error:  # noqa: BLE001 - whatever it is, show the other findings
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
