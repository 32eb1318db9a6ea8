"""`cpnet doctor`: what this machine lacks, and the command that installs it."""

from __future__ import annotations

import ctypes
import importlib.util
import os
import platform
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cpnet.endpoints import connecting, resolve
from link_relay.netns import probe
from protocol.bus import open_bus
from protocol.errors import BusError
from protocol.inbox import Inbox
from protocol.topics import BusName

LIBRARIES = {
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

PARTS = {
    "zenoh": "eclipse-zenoh",
    "embreex": "embreex",
    "numba": "numba",
    "libsumo": "libsumo",
    "sumo": "eclipse-sumo",
    "matplotlib": "matplotlib",
}
MIN_FREE_BYTES = 1 << 30


@dataclass(frozen=True, slots=True)
class Finding:
    """One check: what was looked at, whether it is well, and what to do if not."""

    what: str
    ok: bool
    advice: str
    optional: bool = False


def missing_packages() -> list[str]:
    """Returns the system packages that must be installed before SUMO can run here."""
    return [package for library, package in LIBRARIES.items() if not _loads(library)]


def examine() -> list[Finding]:
    """Runs all checks."""
    return [_python(), _libraries(), *_parts(), _bus(), _disk(), _netns()]


def print_findings(findings: list[Finding], console: Console) -> None:
    """Prints a line per check."""
    table = Table(box=None, show_header=False)
    for finding in findings:
        absent = "[yellow]optional[/]" if finding.optional else "[red]missing[/]"
        mark = "[green]ok[/]" if finding.ok else absent
        table.add_row(mark, finding.what, escape(finding.advice))
    console.print(table)


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def _python() -> Finding:
    ok = sys.version_info >= (3, 11)
    return Finding(f"Python {platform.python_version()}", ok, "" if ok else "needs 3.11 or newer")


def _libraries() -> Finding:
    missing = missing_packages()
    advice = f"apt-get install -y --no-install-recommends {' '.join(missing)}" if missing else ""
    return Finding(f"{len(LIBRARIES)} system libraries of SUMO", not missing, advice)


def _parts() -> list[Finding]:
    result = []
    for module, package in PARTS.items():
        found = importlib.util.find_spec(module) is not None
        result.append(
            Finding(f"package {package}", found, "" if found else f"pip install {package}")
        )
    return result


def _bus() -> Finding:
    what = "a Zenoh bus over TCP on loopback"
    endpoint = resolve([], [], set(BusName))[BusName.V2X]
    try:
        router = open_bus(BusName.V2X, endpoint, Inbox())
        client = open_bus(BusName.V2X, connecting(endpoint), Inbox())
        client.close()
        router.close()
    except BusError as error:
        return Finding(what, ok=False, advice=str(error))
    return Finding(what, ok=True, advice="")


def _disk() -> Finding:
    free = shutil.disk_usage(Path.cwd()).free
    ok = free >= MIN_FREE_BYTES and os.access(Path.cwd(), os.W_OK)
    advice = "" if ok else "run folders are written here: needs 1 GiB and write permission"
    return Finding(f"{free / 2**30:.0f} GiB free in this folder", ok, advice)


def _netns() -> Finding:
    ability = probe.examine()
    advice = "" if ability.delays else "no netem (sch_netem): rates and outages, no round trips"
    what = "network namespaces for cpnet up --netns"
    return Finding(what, not ability.missing, ability.missing or advice, optional=True)
