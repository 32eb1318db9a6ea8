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
from cpnet.fork_server import ChildProcess, ensure_fork_server, start_process
from cpnet.processes import AGENTS, RELAY, ProcessEntry
from cpnet.run_folder import written
from protocol.bus import Endpoint
from protocol.errors import CpnetError
from protocol.logs import LogStyle
from protocol.topics import BusName

MAX_RESTARTS = 5
WITHIN_NS = 30_000_000_000


class Restarts:
    """Remembers when each process was started again; dying all the time is no life."""

    def __init__(self) -> None:
        self._at_ns: dict[str, deque[int]] = defaultdict(lambda: deque(maxlen=MAX_RESTARTS))

    def admits(self, process: str, now_ns: int) -> bool:
        """Whether a process may be started once more now; if so, that counts."""
        times_ns = self._at_ns[process]
        if len(times_ns) == MAX_RESTARTS and now_ns - times_ns[0] < WITHIN_NS:
            return False
        times_ns.append(now_ns)
        return True


_log = logging.getLogger(__name__)

WORLD_GRACE_S = 1.0  # for the world to tell its end and the recorder to write it
STOPPED_NS = 5_000_000_000  # then it is as good as dead
GRACE_S = 2.0  # then for all others, until SIGKILL: both within the 5 s that users wait
WRITERS = ("record", "tape")
LIST_NAME = "processes.json"
FORK_SERVER = "nursery"


@dataclass(slots=True, eq=False)
class SupervisedProcess:
    """A running process with its log."""

    entry: ProcessEntry
    process: ChildProcess
    log_path: Path
    still_since_ns: int | None = None

    def stopped_ns(self, now_ns: int) -> int:
        """For how long it has been stopped by a signal, 0 if it is not."""
        if self.process.poll() is not None or not is_stopped(self.process.pid):
            self.still_since_ns = None
            return 0
        self.still_since_ns = self.still_since_ns or now_ns
        return now_ns - self.still_since_ns

    @property
    def death(self) -> ExitReport | None:
        """How it ended, if it has."""
        status = self.process.poll()
        return (
            None
            if status is None
            else ExitReport(self.entry.id, describe_status(status), log_tail(self.log_path))
        )


class Supervisor:
    """Holds the processes of one machine; a context manager that ends them all."""

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

    def revive(self) -> tuple[list[ExitReport], list[ExitReport]]:
        """Starts again what has ended too early; returns who that was, and who stays dead.

        Who was stopped by a signal and does not go on is ended first.
        The world stays dead, and so does a process that dies again and again. Who dies after this
        looked, or cannot be started yet, is found by the next call.
        """
        found, lost = [], []
        for number, child in enumerate(self._children):
            may = child.entry.role.role != "sim"
            death = child.death or (self._end_stopped(child) if may else None)
            if death is None:
                continue
            if may and self._restarts.admits(child.entry.id, time.monotonic_ns()):
                found.append(self._again(number, death))
            else:
                lost.append(death)
        if found:
            self._list()
        return found, lost

    def stopped(self, for_ns: int) -> list[str]:
        """Returns who was stopped by a signal that long ago, and did not go on."""
        now_ns = time.monotonic_ns()
        return [c.entry.id for c in self._children if c.stopped_ns(now_ns) >= for_ns]

    def _end_stopped(self, child: SupervisedProcess) -> ExitReport | None:
        stopped_ns = child.stopped_ns(time.monotonic_ns())
        if stopped_ns < STOPPED_NS:
            return None
        child.process.send_signal(signal.SIGKILL)
        child.process.wait(GRACE_S)
        stood = f"was stopped (SIGSTOP) for {stopped_ns / 1e9:.0f} s"
        return ExitReport(child.entry.id, stood, log_tail(child.log_path))

    def _again(self, number: int, death: ExitReport) -> ExitReport:
        """Starts a child again; returns its death with what became of it."""
        child = self._children[number]
        child.process.release()
        try:
            self._children[number] = self._spawn(child.entry)
        except CpnetError as error:
            return replace(death, how=f"{death.how}; {error}")
        return replace(death, how=f"{death.how}; started again")

    def bereft(self) -> ExitReport | None:
        """Returns the death of the fork server, once, if processes have outlived it."""
        orphans = {c.process.pid for c in self._children if c.process.orphaned}
        if orphans <= self._orphans:
            return None
        self._orphans = orphans
        gone = "was killed or crashed, the fork server that starts all others"
        return ExitReport(FORK_SERVER, gone, log_tail(self._nursery_log))

    @property
    def _nursery_log(self) -> Path:
        return self._run_dir / "logs" / f"{FORK_SERVER}.log"

    def _list(self) -> None:
        """Writes which process is which, for whoever looks after them from outside.

        A full disk is said once, and is no reason to end a run: the old list goes, being wrong.
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
            ensure_fork_server(self._nursery_log)
        return SupervisedProcess(
            entry, start_process(entry.role.module, self._arguments(entry), path), path
        )

    def death(self, *, at_end: bool) -> ExitReport | None:
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

    def dismiss(self, role: str, *, at_end: bool) -> ExitReport | None:
        """Returns a process of this role that is dead as in `death`, and no longer asks for it."""
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
        """Ends all processes, the world first. Returns who did not stop when asked."""
        world = [child for child in self._children if child.entry.role.role == "sim"]
        if any(child.process.poll() is None for child in world):
            _interrupt(world)
            writers = [c for c in self._children if c.entry.role.role in WRITERS]
            _await(writers, WORLD_GRACE_S)
        _interrupt(self._children)
        killed = _await(self._children, GRACE_S)
        for child in killed:
            child.process.send_signal(signal.SIGKILL)
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
