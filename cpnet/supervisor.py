"""Supervisor: starts the processes of one machine, notices exits, restarts, and ends them all."""

from __future__ import annotations

import json
import logging
import signal
import time
from collections import defaultdict, deque
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from cpnet.endpoints import Endpoints, connecting, free_locator
from cpnet.exit_report import CLEAN_STATUSES, ExitReport, describe_status, log_tail
from cpnet.fork_server import LOG_NAME, ChildProcess, ensure_fork_server, start_process
from cpnet.processes import AGENTS, RELAY, ProcessEntry
from cpnet.run_folder import written
from protocol.bus import Endpoint
from protocol.errors import CpnetError
from protocol.logs import LogStyle
from protocol.topics import BusName

MAX_RESTARTS = 5
WITHIN_NS = 30_000_000_000
FIRST_PAUSE_NS = 500_000_000


class Restarts:
    """Limits how often a process is restarted: `MAX_RESTARTS` times within `WITHIN_NS`.

    The first restart comes at once, each further one `FIRST_PAUSE_NS` after the one before, then
    twice as long each time: an external cause may have passed.
    """

    def __init__(self) -> None:
        self._at_ns: dict[str, deque[int]] = defaultdict(deque)

    def is_exhausted(self, process: str, now_ns: int) -> bool:
        """Whether a process has been restarted too often."""
        return len(self._recent_ns(process, now_ns)) >= MAX_RESTARTS

    def admits(self, process: str, now_ns: int) -> bool:
        """Whether a process may be restarted now; if so, the restart is counted."""
        times_ns = self._recent_ns(process, now_ns)
        if self.is_exhausted(process, now_ns):
            return False
        if times_ns and now_ns - times_ns[-1] < FIRST_PAUSE_NS << len(times_ns) - 1:
            return False
        times_ns.append(now_ns)
        return True

    def _recent_ns(self, process: str, now_ns: int) -> deque[int]:
        times_ns = self._at_ns[process]
        while times_ns and now_ns - times_ns[0] >= WITHIN_NS:
            times_ns.popleft()
        return times_ns


_log = logging.getLogger(__name__)

WORLD_GRACE_S = 1.0  # for the world to publish its end and the recorder to write it
STOPPED_NS = 5_000_000_000  # a process stopped for longer counts as failed
GRACE_S = 2.0  # then for all others, until SIGKILL
LAST_GRACE_S = 1.5  # then for a recorder that still writes: all within the 5 s that users wait
WRITERS = ("record", "mcap")
LIST_NAME = "processes.json"
FORK_SERVER = "fork-server"


@dataclass(slots=True, eq=False)
class SupervisedProcess:
    """A running process with its log."""

    entry: ProcessEntry
    process: ChildProcess
    log_path: Path
    stopped_since_ns: int | None = None

    def stopped_ns(self, now_ns: int) -> int:
        """For how long it has been stopped by a signal, 0 if it is not."""
        if self.process.poll() is not None or not is_stopped(self.process.pid):
            self.stopped_since_ns = None
            return 0
        self.stopped_since_ns = self.stopped_since_ns or now_ns
        return now_ns - self.stopped_since_ns

    @property
    def failure(self) -> ExitReport | None:
        """Returns its exit report, None while it runs."""
        status = self.process.poll()
        return (
            None
            if status is None
            else ExitReport(self.entry.id, describe_status(status), log_tail(self.log_path))
        )


class Supervisor:
    """Starts, restarts and, as a context manager, ends the processes of one machine."""

    def __init__(
        self,
        run_dir: Path,
        endpoints: Endpoints,
        log_style: LogStyle = LogStyle.TEXT,
        keys: Path | None = None,
    ) -> None:
        self._run_dir = run_dir
        self._keys = keys
        self._endpoints = endpoints
        self._log_style = log_style
        self._uplinks: dict[str, str] = {}
        self._children: list[SupervisedProcess] = []
        self._orphans: set[int] = set()
        self._is_listed = True
        self._restarts = Restarts()

    def __enter__(self) -> Supervisor:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self, entries: list[ProcessEntry]) -> None:
        """Starts the processes; their standard error goes to `logs/ID.log` of the run folder.

        Raises:
            CpnetError: the run folder cannot be written, or a process cannot be started.
        """
        for relay in (entry for entry in entries if entry.role is RELAY):
            kind = relay.id.removeprefix("relay-")
            self._uplinks[kind] = free_locator("tls" if self._keys else "tcp")
        with written(self._run_dir):
            (self._run_dir / "logs").mkdir(parents=True, exist_ok=True)
        for entry in entries:
            self._children.append(self._spawn(entry))
        self._list()

    def restart_ended(self) -> tuple[list[ExitReport], list[ExitReport]]:
        """Restarts processes that ended too early; returns the restarted ones and the others.

        A process that a signal has stopped for `STOPPED_NS` is killed first. The simulator is never
        restarted, nor a process that fails again and again (see `Restarts`). A process that ends
        during this call, or cannot be started yet, is found by the next call.
        """
        found, lost = [], []
        for number, child in enumerate(self._children):
            may = child.entry.role.role != "sim"
            failure = child.failure or (self._end_stopped(child) if may else None)
            if failure is None:
                continue
            now_ns = time.monotonic_ns()
            if not may or self._restarts.is_exhausted(child.entry.id, now_ns):
                lost.append(failure)
            elif self._restarts.admits(child.entry.id, now_ns):
                found.append(self._restart(number, failure))
        if found:
            self._list()
        return found, lost

    def stopped(self, for_ns: int) -> list[str]:
        """Returns the processes that a signal has stopped for at least so long."""
        now_ns = time.monotonic_ns()
        return [c.entry.id for c in self._children if c.stopped_ns(now_ns) >= for_ns]

    def _end_stopped(self, child: SupervisedProcess) -> ExitReport | None:
        stopped_ns = child.stopped_ns(time.monotonic_ns())
        if stopped_ns < STOPPED_NS:
            return None
        child.process.send_signal(signal.SIGKILL)
        child.process.wait(GRACE_S)
        how = f"was stopped (SIGSTOP) for {stopped_ns / 1e9:.0f} s"
        return ExitReport(child.entry.id, how, log_tail(child.log_path))

    def _restart(self, number: int, failure: ExitReport) -> ExitReport:
        """Restarts a child; returns its exit report with the outcome."""
        child = self._children[number]
        child.process.release()
        try:
            self._children[number] = self._spawn(child.entry)
        except CpnetError as error:
            return replace(failure, how=f"{failure.how}; {error}")
        return replace(failure, how=f"{failure.how}; started again")

    def fork_server_exit(self) -> ExitReport | None:
        """Returns the exit report of the fork server, once, if processes still run without it."""
        orphans = {c.process.pid for c in self._children if c.process.orphaned}
        if orphans <= self._orphans:
            return None
        self._orphans = orphans
        gone = "was killed or crashed, the fork server that starts all others"
        return ExitReport(FORK_SERVER, gone, log_tail(self._fork_server_log))

    @property
    def _fork_server_log(self) -> Path:
        return self._run_dir / "logs" / LOG_NAME

    def _list(self) -> None:
        """Writes the ids and process numbers to `processes.json`, for external tools.

        A full disk is logged once and does not end the run; the outdated list is removed.
        """
        path = self._run_dir / LIST_NAME
        fresh = path.with_suffix(".new")
        listed = json.dumps({c.entry.id: c.process.pid for c in self._children})
        try:
            fresh.write_text(listed, "utf-8")
            fresh.replace(path)
        except OSError as error:
            if self._is_listed:
                _log.warning("%s cannot be written: %s", path, error.strerror)
            self._is_listed = False
            for left in (fresh, path):
                with suppress(OSError):
                    left.unlink(missing_ok=True)

    def _spawn(self, entry: ProcessEntry) -> SupervisedProcess:
        path = self._run_dir / "logs" / f"{entry.id}.log"
        if self._orphans:
            ensure_fork_server(self._fork_server_log)
        return SupervisedProcess(
            entry, start_process(entry.role.module, self._arguments(entry), path), path
        )

    def failure(self, *, at_end: bool) -> ExitReport | None:
        """Returns a process that failed, or, before the run's end, that ended at all.

        Of several the one that a signal killed comes first: it is the cause, not a consequence.
        """
        dead = [
            (status, child)
            for child in self._children
            if (status := child.process.poll()) is not None
            and not (at_end and status in CLEAN_STATUSES)
        ]
        if not dead:
            return None
        status, child = min(dead, key=lambda one: one[0])
        return ExitReport(child.entry.id, describe_status(status), log_tail(child.log_path))

    def remove_failed(self, role: str, *, at_end: bool) -> ExitReport | None:
        """Returns a failed process of this role, see `failure`, and stops supervising it."""
        for child in self._children:
            status = child.process.poll()
            is_dead = status is not None and not (at_end and status in CLEAN_STATUSES)
            if child.entry.role.role == role and status is not None and is_dead:
                self._children.remove(child)
                self._list()
                child.process.release()
                return ExitReport(child.entry.id, describe_status(status), log_tail(child.log_path))
        return None

    def holds(self, process: str) -> bool:
        """Whether this process was started here."""
        return any(child.entry.id == process for child in self._children)

    def running(self, *roles: str) -> bool:
        """Whether a process of one of these roles still runs here."""
        return any(
            child.process.poll() is None
            for child in self._children
            if child.entry.role.role in roles
        )

    def stop(self) -> list[str]:
        """Ends all processes, the simulator first. Returns those that had to be killed."""
        world = [child for child in self._children if child.entry.role.role == "sim"]
        if any(child.process.poll() is None for child in world):
            _interrupt(world)
            writers = [c for c in self._children if c.entry.role.role in WRITERS]
            _await(writers, WORLD_GRACE_S)
        _interrupt(self._children)
        late = _await(self._children, GRACE_S)
        writing = [child for child in late if child.entry.role.role in WRITERS]
        killed = [child for child in late if child not in writing]
        _kill(killed)
        cut = _await(writing, LAST_GRACE_S)
        _kill(cut)
        killed += cut
        for child in self._children:
            child.process.wait()
            child.process.release()
        self._children.clear()
        return [child.entry.id for child in killed]

    def _arguments(self, entry: ProcessEntry) -> list[str]:
        command = ["--supervised", "--id", entry.id]
        command += ["--setup", str(self._run_dir / "setup.msgpack"), "--run", str(self._run_dir)]
        for bus in BusName:
            command += [f"--{bus.value}", str(self._endpoint(bus, entry))]
        command += ["--keys", str(self._keys)] if self._keys else []
        command += ["--log", self._log_style.value]
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
        hosts = entry.role.hosts is bus and endpoint.listen
        return endpoint if hosts else connecting(endpoint)


def _interrupt(children: list[SupervisedProcess]) -> None:
    for child in children:
        child.process.send_signal(signal.SIGINT)


def _kill(children: list[SupervisedProcess]) -> None:
    for child in children:
        child.process.send_signal(signal.SIGKILL)


def _await(children: list[SupervisedProcess], grace_s: float) -> list[SupervisedProcess]:
    """Waits for the end of all; returns those that still run when the time is over."""
    give_up_ns = time.monotonic_ns() + int(grace_s * 1e9)
    return [
        child
        for child in children
        if child.process.wait(max(0.0, (give_up_ns - time.monotonic_ns()) / 1e9)) is None
    ]


def is_stopped(pid: int) -> bool:
    """Whether a process is stopped by a signal; one that a debugger holds is not."""
    try:
        return Path(f"/proc/{pid}/stat").read_bytes().rpartition(b") ")[2].startswith(b"T")
    except OSError:
        return False
