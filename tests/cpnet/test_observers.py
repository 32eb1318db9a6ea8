"""Observers of real runs: in the terminal, into a file."""

import os
import pty
import re
import signal
import subprocess
import sys
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.cpnet.commands import UNHURRIED, Shell
from tests.waiting import wait_until

LEFT_SCREEN = "\x1b[?1049l"  # what makes a terminal show again what was there before

NEEDS_VIEW = pytest.mark.skipif(
    find_spec("rerun") is None, reason="the extra `view` is not installed"
)
ENOUGH_BYTES = 500_000  # more than what stands still


class Terminal:
    """A command on a terminal of its own."""

    def __init__(self, folder: Path, *arguments: str) -> None:
        self._own, theirs = pty.openpty()
        self.process = subprocess.Popen(
            [sys.executable, "-m", "cpnet", *arguments],
            cwd=folder, stdin=theirs, stdout=theirs, stderr=theirs,
            env=os.environ | {"TERM": "xterm", "COLUMNS": "120", "LINES": "60"},
        )  # fmt: skip
        os.close(theirs)
        os.set_blocking(self._own, False)

    def read_until(self, text: str) -> str:
        """Reads what is shown until the text is there."""
        seen = ""

        def is_there() -> bool:
            nonlocal seen
            with suppress(OSError):  # nothing new, or the writer has ended
                seen += os.read(self._own, 1 << 16).decode(errors="replace")
            return text in seen

        wait_until(is_there, needs=self.process)
        return seen

    def read_to_end(self) -> str:
        """Reads until the command is over: it ends only once its output was read."""
        seen = ""

        def is_over() -> bool:
            nonlocal seen
            ended = self.process.poll() is not None
            with suppress(OSError):
                while chunk := os.read(self._own, 1 << 16):
                    seen += chunk.decode(errors="replace")
            return ended

        wait_until(is_over)
        return seen


def test_top_shows_a_run_once_and_for_good(shell: Shell) -> None:
    run = shell.up("--duration=600", "--out=run", "--mode=realtime", "--restart", *UNHURRIED)
    run.read_until("vehicles")
    status, output = shell.run("top", "run", "--once")
    assert status == 0, output
    assert re.search(r"rsu-0 +\d{3,} +\d\.\d\d +1\.00", output), output
    for word in ("end to end", "east_in, west_in", "north_in_0", "max_pressure", "upstream"):
        assert word in output, output
    screen = Terminal(shell.folder, "top", "run")
    screen.read_until("end to end")
    screen.process.send_signal(signal.SIGINT)
    rest = screen.read_to_end()
    assert screen.process.returncode == 0, rest
    assert LEFT_SCREEN in rest
    assert "Traceback" not in rest


def test_a_run_is_kept_as_a_drawing(shell: Shell) -> None:
    pytest.importorskip("rerun", reason="the extra `view` is not installed")
    run = shell.up("--duration=600", "--out=run", "--mode=realtime", "--restart", *UNHURRIED)
    run.read_until("vehicles")
    view = shell.start("view", "run", "--save", "run.rrd")
    view.read_until("writing")
    kept = shell.folder / "run.rrd"
    view.wait_until(lambda: kept.stat().st_size > ENOUGH_BYTES)
    view.process.send_signal(signal.SIGINT)
    status, output = view.finish()
    assert status == 0, output
    shown = re.search(r"(\d+) frames shown", output)
    assert shown is not None, output
    assert int(shown[1]) > 0
    assert run.process.poll() is None


@pytest.mark.parametrize(
    ("options", "error_text"),
    [
        pytest.param(["view", "--web"], "no run goes on in runs/", marks=NEEDS_VIEW),
        (["top", "nowhere"], "no run goes on there"),
        (["view", "--web", "--save", "a.rrd"], "give one of them"),
        (["top", "--connect", "here"], "HOST:PORT"),
    ],
)
def test_what_cannot_be_looked_at_is_named(
    shell: Shell, options: list[str], error_text: str
) -> None:
    status, output = shell.run(*options)
    assert status == 2
    assert error_text in output
    assert "Traceback" not in output
