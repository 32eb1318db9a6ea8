"""All checks, each within its time; what one does wrong is no matter of the others."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from cpnet.doctor import kernel, loopback, machine, remote, sumo
from cpnet.doctor.certificates import certificates
from cpnet.doctor.finding import Finding
from protocol.bus import Endpoint
from protocol.topics import BusName

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
    Check("python", machine.python),
    Check("libraries", machine.libraries),
    Check("packages", machine.parts),
    Check("sumo", sumo.starts, sumo.TRIAL_TIMEOUT_S + 1),
    Check("bus_on_loopback", loopback.bus),
    Check("disk", machine.disk),
    Check("memory", machine.memory, optional=True),
    Check("cores", machine.cores, optional=True),
    Check("tcp_info", kernel.counters, optional=True),
    Check("send_buffer", kernel.send_buffer, optional=True),
)
"""In the order in which they are printed."""


def examine() -> list[Finding]:
    """Runs all checks of this machine."""
    return [finding for check in CHECKS for finding in carry_out(check)]


def examine_keys(folder: Path) -> list[Finding]:
    """Looks through the certificates of a folder."""
    return carry_out(Check("certificates", partial(certificates, folder)))


def examine_buses(places: Mapping[BusName, Endpoint], *, implied: bool = False) -> list[Finding]:
    """Asks the buses that are reached so; `implied` if nobody said where the world's is."""
    checks = [
        Check(f"{bus.value}_bus", partial(remote.examine_bus, bus, endpoint), REMOTE_S)
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
