"""Processes that have imported all they need and wait to take the place of one that dies."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import IO

REST_NS = 1_500_000_000
"""After one was taken: what has just begun to live needs the machine more than its successor."""


class Standby:
    """Keeps one process a module at hand, once it is told to; a process is taken once."""

    def __init__(self, log: Path, environment: dict[str, str]) -> None:
        self._log = log
        self._environment = environment
        self._waiting: dict[str, subprocess.Popen[bytes]] = {}
        self._rests_until_ns = 0

    def tend(self, modules: set[str]) -> None:
        """Starts what is missing, one at a time."""
        for module, process in list(self._waiting.items()):
            if process.poll() is not None:
                _hang_up(self._waiting.pop(module))
        missing = sorted(modules - self._waiting.keys())
        now_ns = time.monotonic_ns()
        if missing and now_ns >= self._rests_until_ns:
            self._rests_until_ns = now_ns + REST_NS
            with self._log.open("ab") as log:
                self._waiting[missing[0]] = start(
                    [sys.executable, "-m", missing[0], "--standby"], log, self._environment
                )

    def take(self, module: str, arguments: list[str], log: Path) -> subprocess.Popen[bytes] | None:
        """Returns a process that now goes on with these arguments, None if none was at hand."""
        process = self._waiting.pop(module, None)
        if process is None or process.stdin is None:
            return None
        self._rests_until_ns = time.monotonic_ns() + REST_NS
        order = json.dumps({"arguments": arguments, "log": str(log)}) + "\n"
        try:
            process.stdin.write(order.encode())
            process.stdin.flush()
        except OSError:  # it has died meanwhile
            _hang_up(process)
            return None
        return process

    def stop(self) -> None:
        """Ends all that wait."""
        for process in self._waiting.values():
            process.kill()
            _hang_up(process)
        self._waiting.clear()


def start(
    command: list[str], log: IO[bytes], environment: dict[str, str]
) -> subprocess.Popen[bytes]:
    """Starts a process whose standard input is its lifeline."""
    return subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=log,
        stderr=log,
        env=os.environ | environment,
        start_new_session=True,  # Ctrl-C reaches the supervisor, which stops in order
    )


def _hang_up(process: subprocess.Popen[bytes]) -> None:
    if process.stdin is not None:
        process.stdin.close()
    process.wait()
