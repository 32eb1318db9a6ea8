"""Starts a run's processes, notices when one dies, and leaves none behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from cpnet.endpoints import Endpoints, connecting, free_locator
from cpnet.processes import AGENTS, RELAY, ProcessEntry
from protocol.bus import Endpoint
from protocol.topics import BusName

WORLD_GRACE_S = 1.0  # for the world to tell its end and the recorder to write it
GRACE_S = 2.0  # then for all others, until SIGKILL: both within the 5 s that users wait
TAIL_LINES = 12
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
"""Processes are the unit that work is spread by: a BLAS that spins on all cores slows the rest."""


@dataclass(slots=True, eq=False)
class Child:
    """A running process with its log."""

    entry: ProcessEntry
    process: subprocess.Popen[bytes]
    log_path: Path
    log: IO[bytes]


@dataclass(frozen=True, slots=True)
class Death:
    """A process that ended before the run did."""

    id: str
    how: str
    tail: str


class Supervisor:
    """Holds the processes of one machine; a context manager that ends them all."""

    def __init__(self, run_dir: Path, endpoints: Endpoints) -> None:
        self._run_dir = run_dir
        self._endpoints = endpoints
        self._uplinks: dict[str, str] = {}
        self._children: list[Child] = []

    def __enter__(self) -> Supervisor:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self, entries: list[ProcessEntry]) -> None:
        """Starts the processes; their standard error goes to `logs/ID.log` of the run folder."""
        for relay in (entry for entry in entries if entry.role is RELAY):
            self._uplinks[relay.id.removeprefix("relay-")] = free_locator()
        folder = self._run_dir / "logs"
        folder.mkdir(parents=True, exist_ok=True)
        for entry in entries:
            path = folder / f"{entry.id}.log"
            log = path.open("wb")
            process = subprocess.Popen(
                self._command(entry),
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=log,
                env=os.environ | ONE_THREAD,
                start_new_session=True,  # Ctrl-C reaches the supervisor, which stops in order
            )
            self._children.append(Child(entry, process, path, log))

    def death(self, *, at_end: bool) -> Death | None:
        """Returns a process that failed, or, before the run's end, that ended at all.

        Of several the one that a signal killed comes first: it is the cause, not a consequence.
        """
        dead = [
            (status, child)
            for child in self._children
            if (status := child.process.poll()) is not None and not (at_end and status == 0)
        ]
        if not dead:
            return None
        status, child = min(dead, key=lambda one: one[0])
        return Death(child.entry.id, _how(status), tail(child.log_path))

    def holds(self, role: str) -> bool:
        """Whether a process of this role was started here."""
        return any(child.entry.role.role == role for child in self._children)

    def running(self, *roles: str) -> bool:
        """Whether a process of one of these roles still runs here."""
        return any(
            child.process.poll() is None
            for child in self._children
            if child.entry.role.role in roles
        )

    def stop(self) -> list[str]:
        """Ends all processes, the world first. Returns who did not stop when asked."""
        world = [child for child in self._children if child.entry.role.role == "sim"]
        if any(child.process.poll() is None for child in world):
            _interrupt(world)
            _await([c for c in self._children if c.entry.role.role == "record"], WORLD_GRACE_S)
        _interrupt(self._children)
        killed = _await(self._children, GRACE_S)
        for child in killed:
            child.process.kill()
        for child in self._children:
            child.process.wait()
            _release(child)
        self._children.clear()
        return [child.entry.id for child in killed]

    def _command(self, entry: ProcessEntry) -> list[str]:
        command = [sys.executable, "-m", entry.role.module, "--supervised", "--id", entry.id]
        command += ["--setup", str(self._run_dir / "setup.msgpack"), "--run", str(self._run_dir)]
        for bus in BusName:
            command += [f"--{bus.value}", str(self._endpoint(bus, entry))]
        uplink = self._uplink(entry)
        return command + (["--uplink", str(uplink)] if uplink else [])

    def _uplink(self, entry: ProcessEntry) -> Endpoint | None:
        """Returns where a relay listens, or where an agent finds the relay before the edge."""
        is_relay = entry.role is RELAY
        kind = entry.id.removeprefix("relay-") if is_relay else AGENTS.get(entry.role.role, "")
        locator = self._uplinks.get(kind)
        return Endpoint(locator, listen=is_relay) if locator else None

    def _endpoint(self, bus: BusName, entry: ProcessEntry) -> Endpoint:
        endpoint = self._endpoints[bus]
        return endpoint if entry.role.hosts is bus else connecting(endpoint)


def tail(path: Path, lines: int = TAIL_LINES) -> str:
    """Returns the last lines of a log."""
    try:
        text = path.read_text("utf-8", errors="replace")
    except OSError as error:
        return f"(no log: {error})"
    return "\n".join(text.splitlines()[-lines:]) or "(its log is empty)"


def _how(status: int) -> str:
    if status >= 0:
        return f"ended with status {status}"
    return f"was killed by {signal.Signals(-status).name}"


def _interrupt(children: list[Child]) -> None:
    for child in children:
        if child.process.poll() is None:
            child.process.send_signal(signal.SIGINT)


def _await(children: list[Child], grace_s: float) -> list[Child]:
    """Waits for the end of all; returns those that still run when the time is over."""
    give_up_ns = time.monotonic_ns() + int(grace_s * 1e9)
    late = []
    for child in children:
        try:
            child.process.wait(max(0.0, (give_up_ns - time.monotonic_ns()) / 1e9))
        except subprocess.TimeoutExpired:
            late.append(child)
    return late


def _release(child: Child) -> None:
    if child.process.stdin is not None:
        child.process.stdin.close()
    child.log.close()
