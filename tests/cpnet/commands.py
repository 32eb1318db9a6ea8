"""`cpnet` commands as a user starts them, and queries of their processes and run folders.

To import what `cpnet` needs takes longer than most of the commands that tests give. So a command is
forked off one process that has imported everything; from outside it is the same: a process of its
own in a folder of its own, with arguments and a pipe. The fork server that such a command starts is
forked off it in turn, for the same reason; `fresh=True` and `test_installed` start it as users do.
"""

import ctypes
import multiprocessing
import os
import signal
import socket
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from multiprocessing import forkserver, util
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext
from pathlib import Path
from typing import Any, TypeVar
from unittest.mock import patch

from setproctitle import getproctitle, setproctitle

from cpnet import cli
from cpnet.__main__ import main
from cpnet.endpoints import free_locator
from protocol.starting import ONE_THREAD
from recording.latency_breakdown import stage_sum_ns
from recording.run import Run
from recording.tables import FrameRow, LatencyRow
from tests.waiting import TIMEOUT_S, wait_until

T = TypeVar("T")
SMALL = [
    "--set=lidar.vehicle.model=full",
    "--set=lidar.roadside.model=full",
    "--set=lidar.vehicle.channels=16",
    "--set=lidar.roadside.channels=16",
    "--set=lidar.vehicle.points_per_second=72000",
    "--set=lidar.roadside.points_per_second=72000",
    "--set=traffic.warmup_s=30",
]
"""Sensors that are cheap to cast."""
UNHURRIED = ["--set=frame_period_s=0.5", "--set=edge.deadline_ms=400"]
"""A realtime run that leaves a machine to others: an observer gets what a run leaves."""

_ROLES = ["edge_server", "sim_host", "recording", "signal_controller", "infra_agent"]
_PRELOAD = ["tests.cpnet.commands", "cpnet.up", "sim_host.setup", "studies.summary"]
_PRELOAD += [f"{package}.role" for package in [*_ROLES, "vehicle_agent"]]
cli.command()
_SETTINGS = {"COLUMNS": "120", "PYTHONWARNINGS": "error"}


class Command:
    """A `cpnet` command that was started: its process, and what it prints."""

    def __init__(self, folder: Path, arguments: list[str], *, fresh: bool, within: str) -> None:
        self.arguments = arguments
        ours, theirs = multiprocessing.Pipe(duplex=False)
        with ours, theirs:
            if fresh:
                self.process: _Fork | subprocess.Popen[bytes]
                self.process = _interpreter(folder, arguments, theirs)
            else:
                self.process = _Fork(folder, arguments, theirs, within)
            own = os.dup(ours.fileno())
        self._news = threading.Condition()
        self._lines: list[str] = []
        self._is_whole = False
        threading.Thread(target=self._pump, args=(own,), daemon=True).start()

    def finish(self, timeout_s: float = TIMEOUT_S) -> tuple[int, str]:
        """Waits for the end; returns the exit status and what was printed and not yet read."""
        with self._news:
            if not self._news.wait_for(lambda: self._is_whole, timeout_s):
                raise AssertionError(f"{self} has not ended:\n{''.join(self._lines)}")
            text = "".join(self._lines)
            self._lines.clear()
        return self.process.wait(timeout_s), text

    def read_until(self, text: str) -> str:
        """Reads lines until one holds the text."""
        seen: list[str] = []
        while not (seen and text in seen[-1]):
            with self._news:
                came = self._news.wait_for(lambda: self._lines or self._is_whole, TIMEOUT_S)
                if not (came and self._lines):
                    raise AssertionError(f"{self} never printed {text!r}:\n{''.join(seen)}")
                seen.append(self._lines.pop(0))
        return "".join(seen)

    def wait_until(self, holds: Callable[[], T], *, what: str | Callable[[], str] = "") -> T:
        """Returns the first answer that is true; fails at once if the command ends before."""
        return wait_until(holds, what=what or str(self), needs=self.process)

    def __str__(self) -> str:
        return f"cpnet {' '.join(self.arguments)}"

    def _pump(self, reading: int) -> None:
        with os.fdopen(reading, encoding="utf-8", errors="replace") as lines:
            for line in lines:
                with self._news:
                    self._lines.append(line)
                    self._news.notify_all()
        with self._news:
            self._is_whole = True
            self._news.notify_all()


def _interpreter(folder: Path, arguments: list[str], output: Connection) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-m", "cpnet", *arguments],
        cwd=folder, stdout=output.fileno(), stderr=output.fileno(), env=os.environ | _SETTINGS,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # ignored in background
    )  # fmt: skip


class _Fork:
    """The part of `subprocess.Popen` that commands use."""

    def __init__(self, folder: Path, arguments: list[str], output: Connection, within: str) -> None:
        words = ["cpnet", *arguments]
        self._process = _fork_server().Process(
            target=_become, args=(words, str(folder), dict(os.environ), output, within)
        )
        self._process.start()

    @property
    def pid(self) -> int:
        return self._process.pid or 0

    def poll(self) -> int | None:
        return self._process.exitcode

    def wait(self, timeout_s: float | None = None) -> int:
        self._process.join(timeout_s)
        assert self._process.exitcode is not None, "it printed its last and goes on"
        return self._process.exitcode

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


def _fork_server() -> ForkServerContext:
    """Starts the process that all are forked off, the first time."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_PRELOAD)
    with patch.dict(os.environ, _SETTINGS | ONE_THREAD):
        forkserver.ensure_running()
    return context


def _become(
    arguments: list[str],
    folder: str,
    environment: dict[str, str],
    output: Connection,
    within: str,
) -> None:
    if within:
        enter_namespace(within)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # whoever started the fork server
    for stream in (1, 2):
        os.dup2(output.fileno(), stream)
    output.close()
    os.chdir(folder)
    getproctitle()  # finds out how long titles may be, by where the environment is
    os.environ.clear()
    os.environ.update(environment | _SETTINGS)
    sys.argv = arguments
    patch.object(util, "spawnv_passfds", _spawn_fork_server).start()
    main()


_spawn = util.spawnv_passfds


def _spawn_fork_server(path: bytes, arguments: Sequence[Any], passed: Sequence[int]) -> int:
    """Forks the first fork server off this process, which has no threads yet, and imports nothing.

    Otherwise as `multiprocessing.util.spawnv_passfds`: nothing but what is passed stays open.
    """
    if "multiprocessing.forkserver" not in arguments[-1]:
        return _spawn(path, arguments, passed)
    util.spawnv_passfds = _spawn
    if pid := os.fork():
        return pid
    for number in [int(entry.name) for entry in Path("/proc/self/fd").iterdir()]:
        if number > 2 and number not in passed:
            with suppress(OSError):
                os.close(number)
    setproctitle(" ".join(["python -c", arguments[-1]]))
    vars(forkserver._forkserver)["_lock"] = threading.Lock()  # what was forked held the old one
    try:
        exec(arguments[-1])
    finally:
        os._exit(0)


def enter_namespace(name: str) -> None:
    """Moves this process, which has one thread, into a network namespace."""
    clone_newnet = 0x40000000
    with Path(f"/var/run/netns/{name}").open("rb") as place:
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.setns(place.fileno(), clone_newnet):
            raise OSError(ctypes.get_errno(), f"setns {name}")


class Shell:
    """Starts commands in a folder and leaves none running."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._started: list[Command] = []

    def start(self, *arguments: str, fresh: bool = False, within: str = "") -> Command:
        """Starts a command, by a new interpreter or in a network namespace if asked."""
        command = Command(self.folder, list(arguments), fresh=fresh, within=within)
        self._started.append(command)
        return command

    def run(self, *arguments: str) -> tuple[int, str]:
        return self.start(*arguments).finish()

    def up(self, *arguments: str, fresh: bool = False) -> Command:
        return self.start("up", "t_junction", *SMALL, *arguments, fresh=fresh)

    def stop_all(self) -> None:
        for command in self._started:
            if command.process.poll() is None:
                command.process.send_signal(signal.SIGTERM)
                command.finish()


def free_ports() -> int:
    """Returns a port that is free together with the next one."""
    while True:
        with socket.socket() as first, socket.socket() as second:
            first.bind(("127.0.0.1", 0))
            port: int = first.getsockname()[1]
            try:
                second.bind(("127.0.0.1", port + 1))
            except OSError:
                continue
            return port


def free_port() -> str:
    return free_locator().rpartition(":")[2]


def children_of(run_dir: Path) -> dict[str, int]:
    """Returns process id by role id of everything that runs for this run folder."""
    found: dict[int, tuple[str, int]] = {}
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            words = (entry / "cmdline").read_bytes().replace(b"\0", b" ").split()
            parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue
        if b"--id" in words and str(run_dir).encode() in words:
            found[int(entry.name)] = (words[words.index(b"--id") + 1].decode(), parent)
    # What a role starts, such as `ip`, bears the role's name for a moment.
    return {name: pid for pid, (name, parent) in found.items() if parent not in found}


def query(run_dir: Path, sql: str, *values: int | str) -> list[tuple[Any, ...]]:
    """Returns the rows of a query of a run's database, which may still be written."""
    place = f"file:{run_dir}/run.sqlite?mode=ro"
    with closing(sqlite3.connect(place, uri=True)) as database:
        return database.execute(sql, values).fetchall()


def rows(run_dir: Path, table: str) -> int:
    return int(query(run_dir, f"SELECT count(*) FROM {table}")[0][0])


def wait_for_frames(command: Command, run_dir: Path) -> None:
    """Waits until the recorder has committed something."""
    command.wait_until(lambda: rows(run_dir, "frames"), what="no frame was ever recorded")


def check_breakdown(run_dir: Path, *, exactly: bool) -> None:
    """Checks the latency breakdown: stages of every frame and agent sum to its end-to-end time."""
    with Run(run_dir) as run:
        accounts = list(run.rows(LatencyRow))
        whole = {row.frame: row.end_to_end_ns for row in run.rows(FrameRow)}
    assert accounts
    for row in accounts:
        assert stage_sum_ns(row) == row.end_to_end_ns
        assert row.clock_error_ns == 0
        assert row.link_ns >= 0
        assert row.wait_ns >= 0
        assert (row.other_ns == 0) if exactly else (row.other_ns >= 0)
    for frame in {row.frame for row in accounts}:
        mine = [row.end_to_end_ns for row in accounts if row.frame == frame]
        assert max(mine) == whole[frame]
