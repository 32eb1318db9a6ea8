"""Calls of `ip` and `tc`."""

from __future__ import annotations

import contextlib
import os
import select
import subprocess
from collections.abc import Sequence

from protocol.errors import BusError

PATIENCE_S = 5.0


class NetnsError(BusError):
    """The kernel, or `ip` or `tc`, refused something; the text is theirs."""


def call(program: str, *words: str, lines: Sequence[str] = ()) -> None:
    """Runs `ip` or `tc` to its end, with lines for `-batch -` if there are any.

    Raises:
        NetnsError: it is not there, or it failed.
    """
    command = [program, *words, *(["-batch", "-"] if lines else [])]
    text = "".join(f"{line}\n" for line in lines)
    try:
        done = subprocess.run(command, input=text, capture_output=True, text=True, check=False)
    except OSError as error:
        raise NetnsError(f"{program} cannot be started: {error.strerror}") from None
    if done.returncode != 0:
        said = " ".join(done.stderr.split()) or f"status {done.returncode}"
        raise NetnsError(f"{' '.join(command)}: {said}")


class Batch:
    """A `tc` that stays and takes one line after the other: many times cheaper than one a line."""

    def __init__(self, *words: str) -> None:
        self._process = subprocess.Popen(
            ["tc", *words, "-batch", "-"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )

    def tell(self, line: str, device: str) -> None:
        """Hands over a line; returns when the kernel has it.

        Asked next for a device with one queue, `tc` answers in one line that it came so far.

        Raises:
            NetnsError: `tc` refused it, its reason is in the log; or it does not answer.
        """
        stdin, stdout = self._process.stdin, self._process.stdout
        assert stdin is not None
        assert stdout is not None
        try:
            stdin.write(f"{line}\nqdisc show dev {device}\n".encode())
            stdin.flush()
            answer = b""
            while not answer.endswith(b"\n"):
                if not select.select([stdout], [], [], PATIENCE_S)[0]:
                    raise NetnsError(f"tc does not answer within {PATIENCE_S:g} s to: {line}")
                if not (more := os.read(stdout.fileno(), 4096)):
                    raise NetnsError(f"tc failed, its reason is above, at: {line}")
                answer += more
        except BrokenPipeError:
            raise NetnsError(f"tc has ended and was not told: {line}") from None

    def close(self) -> None:
        """Ends it."""
        self._process.terminate()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with contextlib.suppress(BrokenPipeError):
                    pipe.close()
        self._process.wait()
