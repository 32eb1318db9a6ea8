"""Commands that begin with everything imported: forked off one process that did it for all.

To import what `cpnet` needs takes longer than most of the commands that tests give. The fork is the
same from outside: a process of its own in a folder of its own, with arguments and a pipe.
"""

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from multiprocessing import forkserver
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext
from pathlib import Path
from unittest.mock import patch

from cpnet.__main__ import main
from cpnet.nursery import ONE_THREAD

PRELOAD = ["tests.cpnet.forked", "cpnet.cli", "cpnet.up", "cpnet.conclusion", "sim_host.setup"]
SETTINGS = {"COLUMNS": "120", "PYTHONWARNINGS": "error"}


def template() -> ForkServerContext:
    """Starts the process that all are forked off, the first time."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(PRELOAD)
    with patch.dict(os.environ, SETTINGS | ONE_THREAD):
        forkserver.ensure_running()
    return context


class Forked:
    """As much of `subprocess.Popen` as tests use."""

    def __init__(self, folder: Path, arguments: list[str]) -> None:
        self.args = ["cpnet", *arguments]
        ours, theirs = multiprocessing.Pipe(duplex=False)
        with ours, theirs:
            self._process = template().Process(
                target=_become, args=(self.args, str(folder), dict(os.environ), theirs)
            )
            self._process.start()
            reading = os.dup(ours.fileno())
        self._news = threading.Condition()
        self._unread: list[str] = []
        self._is_whole = False
        threading.Thread(target=self._pump, args=(reading,), daemon=True).start()

    @property
    def pid(self) -> int:
        return self._process.pid or 0

    @property
    def returncode(self) -> int | None:
        return self._process.exitcode

    @property
    def stdout(self) -> Iterator[str]:
        """Yields lines as they come, each once."""
        while (line := self._next()) is not None:
            yield line

    def poll(self) -> int | None:
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        self._process.join(timeout)
        if self.returncode is None:
            raise subprocess.TimeoutExpired(self.args, timeout or 0.0)
        return self.returncode

    def communicate(self, timeout: float | None = None) -> tuple[str, None]:
        with self._news:
            if not self._news.wait_for(lambda: self._is_whole, timeout):
                raise subprocess.TimeoutExpired(self.args, timeout or 0.0)
            text = "".join(self._unread)
            self._unread.clear()
        self.wait(timeout)
        return text, None

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def _pump(self, reading: int) -> None:
        with os.fdopen(reading, encoding="utf-8", errors="replace") as lines:
            for line in lines:
                with self._news:
                    self._unread.append(line)
                    self._news.notify_all()
        with self._news:
            self._is_whole = True
            self._news.notify_all()

    def _next(self) -> str | None:
        with self._news:
            self._news.wait_for(lambda: self._unread or self._is_whole)
            return self._unread.pop(0) if self._unread else None


def _become(
    arguments: list[str], folder: str, environment: dict[str, str], pipe: Connection
) -> None:
    for stream in (1, 2):
        os.dup2(pipe.fileno(), stream)
    pipe.close()
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment | SETTINGS)
    sys.argv = arguments
    main()
