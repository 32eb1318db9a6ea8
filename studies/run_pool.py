"""Parallel runs, each in a process of its own, forked off one that has done their imports.

libsumo keeps state from one run to the next, which changes the results of the second, so no process
makes two; imports take seconds, as long as a short run itself.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from multiprocessing import forkserver
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerContext, ForkServerProcess
from pathlib import Path
from typing import Any, TypeVar

from protocol.errors import ConfigError
from protocol.starting import ONE_THREAD, signals_deferred

_EXIT_S = 10.0  # of a process that has sent its result
_PRELOAD = ["studies.perceived_case", "studies.bench_control"]
Task = TypeVar("Task")
Done = TypeVar("Done")


def run_each(
    work: Callable[[Task], Done], tasks: Sequence[Task], processes: int, log: Path | None = None
) -> Iterator[tuple[int, Done]]:
    """Yields the number of each task and its result of `work`, as soon as it is done.

    What the processes print, such as SUMO's warnings, is added to the log if there is one.
    Ctrl-C does not reach the processes: whatever ends this iterator ends them, at once.

    Raises:
        ConfigError: a process was killed.
        Exception: what `work` raised.
    """
    context, todo = _fork_server(), iter(enumerate(tasks))
    running: dict[Connection, tuple[int, ForkServerProcess]] = {}

    def start() -> None:
        for number, task in todo:
            ours, theirs = multiprocessing.Pipe(duplex=False)
            process = context.Process(target=_run, args=(work, task, theirs, log), daemon=True)
            with signals_deferred(), theirs:
                process.start()
                running[ours] = number, process
            return

    try:
        for _ in range(processes):
            start()
        while running:
            for ready in wait([*running]):
                assert isinstance(ready, Connection)
                number, process = running[ready]
                yield number, _received(ready)
                with signals_deferred():  # Python ignores Ctrl-C within a finalizer
                    del running[ready]
                    ready.close()
                    _end(process)
                    start()
    finally:
        for connection, (_, process) in running.items():
            process.terminate()
            process.join()
            process.close()
            connection.close()


def _end(process: ForkServerProcess) -> None:
    """Waits for a process that has sent its result, not for long, and closes it."""
    process.join(_EXIT_S)
    if process.is_alive():
        process.kill()
        process.join()
    process.close()


def _fork_server() -> ForkServerContext:
    """Starts the process that all are forked off, if none runs; they ignore Ctrl-C as it does."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_PRELOAD)
    os.environ.update(ONE_THREAD)
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        forkserver.ensure_running()
    finally:
        signal.signal(signal.SIGINT, before)
    return context


def _run(work: Callable[[Task], Done], task: Task, results: Connection, log: Path | None) -> None:
    """Sends the result of a task, or its error; the main function of a process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if log is not None:
        written = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
        for stream in (1, 2):
            os.dup2(written, stream)
        os.close(written)
    with results:
        try:
            results.send((work(task), None))
        except Exception as error:  # noqa: BLE001 - is raised again by the waiting process
            try:
                results.send((None, error))
            except Exception:  # noqa: BLE001 - one that cannot be sent
                results.send((None, RuntimeError(f"{type(error).__name__}: {error}")))


def _received(results: Connection) -> Any:  # noqa: ANN401 - what the task gave
    """Returns what a process sent.

    Raises:
        ConfigError: it was killed before.
        Exception: the task's error.
    """
    found, error = None, None
    with suppress(EOFError):
        found, error = results.recv()
        if error is not None:
            raise error
        return found
    raise ConfigError(
        "a run's process was killed, as when memory runs out; the same command goes on with what "
        "is left"
    )
