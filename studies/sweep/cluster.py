"""Dask workers for cells: processes of this machine, or an existing Dask cluster.

Dask sends pickled Python in both directions: anyone who reaches a scheduler can run any code on its
workers and clients. A local one listens on loopback only; a remote one must be your own.
"""

from __future__ import annotations

import asyncio
import logging
import os
import signal
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any

import dask
from distributed import Client, LocalCluster, Worker, WorkerPlugin
from distributed.comm import connect
from distributed.security import Security

from protocol.errors import ConfigError
from protocol.starting import DEFERRED, signals_deferred

LOOPBACK = "127.0.0.1"
CONNECT_S = 10.0
_CONFIG = {
    "distributed.scheduler.allowed-failures": 1,  # a cell whose worker is killed twice fails
    "distributed.scheduler.worker-ttl": None,  # a long step of SUMO is no failure
    "distributed.admin.system-monitor.disk": False,
}


class CorePinning(WorkerPlugin):
    """Pins each worker process to a core, by which its thread pools size themselves."""

    def __init__(self, cores: list[int]) -> None:
        self._cores = cores

    def setup(self, worker: Worker) -> None:
        """Pins all present threads; later ones inherit it."""
        core = self._cores[int(worker.name) % len(self._cores)]
        for thread in Path("/proc/self/task").iterdir():
            with suppress(ProcessLookupError):  # it has just ended
                os.sched_setaffinity(int(thread.name), {core})


def usable_cores() -> list[int]:
    """Returns the cores that this process may use."""
    return sorted(os.sched_getaffinity(0))


@contextmanager
def local(jobs: int) -> Iterator[Client]:
    """Starts worker processes here, one thread each, and ends them; from the main thread only."""
    _silence_dask_logs()
    with dask.config.set(_CONFIG), ExitStack() as stack:
        with _signals_held():
            cluster = stack.enter_context(_cluster(jobs))
            client = stack.enter_context(Client(cluster))
            stack.push(lambda kind, *_: _kill_workers(cluster) if kind is not None else None)
            client.register_plugin(CorePinning(usable_cores()))
        yield client


def _silence_dask_logs() -> None:
    """Silences Dask's logs: failures are reported as a failed cell or a lost scheduler."""
    for name in sorted(logging.root.manager.loggerDict):  # Dask gives some a level of their own
        if name.split(".")[0] in ("distributed", "tornado", "asyncio"):
            logging.getLogger(name).setLevel(logging.CRITICAL)


def _cluster(jobs: int) -> LocalCluster:
    return LocalCluster(
        n_workers=jobs,
        threads_per_worker=1,
        processes=True,
        host=LOOPBACK,
        dashboard_address=None,
        scheduler_kwargs={"dashboard": False, "dashboard_address": f"{LOOPBACK}:0"},
        memory_limit=0,  # a worker paused for its memory would block the study
        silence_logs=logging.CRITICAL,
    )


@contextmanager
def _signals_held() -> Iterator[None]:
    """Defers Ctrl-C and SIGTERM until all is started; children inherit that both are blocked.

    A terminal sends Ctrl-C to all processes, but the parent ends the workers.
    """
    resource_tracker.ensure_running()  # if a later thread started it, this would unblock them there
    with signals_deferred():
        signal.pthread_sigmask(signal.SIG_BLOCK, DEFERRED)
        try:
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, DEFERRED)


@contextmanager
def remote(address: str) -> Iterator[Client]:
    """Connects to a scheduler, such as tcp://host:8786.

    Raises:
        ConfigError: it does not answer.
    """
    _silence_dask_logs()
    try:
        asyncio.run(asyncio.wait_for(_check_scheduler(address), CONNECT_S))
        client = Client(address, timeout=CONNECT_S)
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"--scheduler {address}: no answer ({error}); start one with `dask scheduler`"
        ) from None
    with client:
        yield client


async def _check_scheduler(address: str) -> None:
    """Connects and disconnects; a listener that is no scheduler would block a client for ever."""
    secured = Security().get_connection_args("client")
    comm = await connect(address, timeout=CONNECT_S, **secured)
    await comm.close()


def _kill_workers(cluster: Any) -> None:  # noqa: ANN401 - Dask's classes are untyped
    """Kills the workers at once: their present cells are not wanted any more."""
    for nanny in cluster.workers.values():
        nanny.auto_restart = False
        if nanny.pid is not None:
            with suppress(ProcessLookupError):
                os.kill(nanny.pid, signal.SIGKILL)
