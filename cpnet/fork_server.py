"""Fork server: one process imports what all roles need, and each role is forked off it.

Imports are most of what a process does before it can take part: a second or two each, on every
core. A forked process starts with them done; `cpnet.fork_server_preload` is imported last.
"""

from __future__ import annotations

import multiprocessing
import os
import runpy
import signal
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing import forkserver
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerProcess
from pathlib import Path

from setproctitle import setproctitle

from cpnet.main_module import without_main
from cpnet.shadowing import same_path
from protocol.errors import CpnetError
from protocol.starting import ONE_THREAD

LOG_NAME = "fork-server.log"
UNKNOWN_STATUS = 255  # of multiprocessing, where the fork server has gone
STATUS_WAIT_S = 1.0  # the fork server is notified of an exit at once


class ChildProcess:
    """A process forked off the fork server; it ends when its standard input is closed.

    Whether it runs is asked of the kernel; only its exit status comes from the fork server, which
    may have failed by then.
    """

    def __init__(self, process: ForkServerProcess, lifeline: Connection) -> None:
        """Wraps a process that was started.

        Raises:
            OSError: too many files are open.
        """
        self._process = process
        self._lifeline = lifeline
        self._status: int | None = None
        self._pidfd: int | None = None
        with suppress(ProcessLookupError):  # it has ended already
            self._pidfd = os.pidfd_open(self.pid)

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid or 0

    @property
    def orphaned(self) -> bool:
        """Whether it runs although the fork server has ended."""
        status = self._process.exitcode  # first: a process that has ended since is no orphan
        return status is not None and self.poll() is None

    def poll(self) -> int | None:
        """Returns its exit status, minus the number of the signal that ended it, or None."""
        return self.wait(0.0)

    def wait(self, timeout_s: float | None = None) -> int | None:
        """Waits for its end; returns as `poll`."""
        if self._status is None and (self._pidfd is None or wait([self._pidfd], timeout_s)):
            self._process.join(STATUS_WAIT_S)
            status = self._process.exitcode
            self._status = UNKNOWN_STATUS if status is None else status
        return self._status

    def send_signal(self, number: int) -> None:
        """Sends it a signal, if it still runs."""
        if self._pidfd is not None and self.poll() is None:
            with suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._pidfd, number)

    def release(self) -> None:
        """Closes its descriptors, once it has ended."""
        self._lifeline.close()
        if self._pidfd is not None:
            os.close(self._pidfd)
            self._pidfd = None


def preload(modules: Iterable[str], log: Path) -> None:
    """Starts the fork server, which begins to import these modules.

    It ends with this process, not before: Ctrl-C does not reach it.
    """
    os.environ.update(ONE_THREAD)
    multiprocessing.set_forkserver_preload(
        ["cpnet.__main__", *modules, "cpnet.fork_server_preload"]
    )
    log.parent.mkdir(parents=True, exist_ok=True)
    ensure_fork_server(log)


def ensure_fork_server(log: Path) -> None:
    """Starts the fork server if it does not run; it imports what `preload` was given.

    Raises:
        CpnetError: it cannot be started.
    """
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with _printing_to(log), _same_path():
            forkserver.ensure_running()
    except OSError as error:
        raise CpnetError(f"the fork server cannot be started: {error}") from None
    finally:
        signal.signal(signal.SIGINT, before)


def start_process(module: str, arguments: list[str], log: Path) -> ChildProcess:
    """Starts `python -m MODULE ARGUMENTS`; what it prints is added to the log.

    Raises:
        CpnetError: the fork server does not answer, or too many files are open.
    """
    try:
        return _fork(module, arguments, log)
    except (OSError, EOFError) as error:
        raise CpnetError(
            f"{module} cannot be started: {error}; see the logs beside {log}"
        ) from None


def _fork(module: str, arguments: list[str], log: Path) -> ChildProcess:
    theirs, ours = multiprocessing.Pipe(duplex=False)
    with theirs:
        process = ForkServerProcess(
            target=_run_module,
            args=(module, arguments, str(log), theirs, _own_path()),
            name=module,
            daemon=True,
        )
        try:
            with without_main():  # roles need nothing of it
                process.start()
            return ChildProcess(process, ours)
        except BaseException:
            ours.close()  # a process that was started after all ends by that
            raise


@contextmanager
def _printing_to(log: Path) -> Iterator[None]:
    """Redirects standard output and error, so that a reader of ours sees the end of file."""
    kept = [os.dup(stream) for stream in (1, 2)]
    written = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    try:
        for stream in (1, 2):
            os.dup2(written, stream)
        yield
    finally:
        for stream, own in zip((1, 2), kept, strict=True):
            os.dup2(own, stream)
            os.close(own)
        os.close(written)


@contextmanager
def _same_path() -> Iterator[None]:
    """Makes processes that are started meanwhile use this process's module search path."""
    before = _own_path()
    os.environ.update(same_path())
    try:
        yield
    finally:
        _set(before)


def _own_path() -> dict[str, str | None]:
    return {name: os.environ.get(name) for name in same_path()}


def _set(environment: dict[str, str | None]) -> None:
    for name, value in environment.items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value


def _run_module(
    module: str,
    arguments: list[str],
    log: str,
    lifeline: Connection,
    environment: dict[str, str | None],
) -> None:
    """Runs the module in the forked process, where some settings are the fork server's own."""
    os.setsid()  # Ctrl-C reaches the supervisor, which stops in order
    signal.signal(signal.SIGINT, signal.default_int_handler)
    written = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    for source, stream in ((lifeline.fileno(), 0), (written, 1), (written, 2)):
        os.dup2(source, stream)
    _set(environment)
    lifeline.close()
    os.close(written)
    sys.argv = [module, *arguments]
    setproctitle(" ".join(["python -m", *sys.argv]))
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    except Exception:  # noqa: BLE001 - printed as for a process that was not forked
        sys.excepthook(*sys.exc_info())
        sys.exit(1)
