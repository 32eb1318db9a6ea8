"""Real runs: `cpnet up` as a user starts it, with sensors that are cheap to cast."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.cpnet.forked import SETTINGS, Forked

SMALL = [
    "--set=lidar.vehicle.channels=16",
    "--set=lidar.roadside.channels=16",
    "--set=lidar.vehicle.points_per_second=72000",
    "--set=lidar.roadside.points_per_second=72000",
    "--set=traffic.warmup_s=30",
]


class Command:
    """A `cpnet` command, in a network namespace if one is named."""

    def __init__(self, folder: Path, arguments: list[str], within: str = "") -> None:
        is_fresh = within or "PYTHONPATH" in os.environ  # which only a new interpreter heeds
        self.process = _fresh(folder, arguments, within) if is_fresh else Forked(folder, arguments)

    def finish(self, timeout_s: float = 120) -> tuple[int, str]:
        """Waits for the end; returns the exit status and what was printed."""
        output, _ = self.process.communicate(timeout=timeout_s)
        return self.process.returncode, output

    def read_until(self, text: str) -> str:
        """Reads lines until one holds the text."""
        seen = []
        assert self.process.stdout is not None
        for line in self.process.stdout:
            seen.append(line)
            if text in line:
                return "".join(seen)
        raise AssertionError(f"{text!r} was never printed:\n{''.join(seen)}")


def _fresh(folder: Path, arguments: list[str], within: str) -> subprocess.Popen[str]:
    enter = ["ip", "netns", "exec", within] if within else []
    return subprocess.Popen(
        [*enter, sys.executable, "-m", "cpnet", *arguments],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=os.environ | SETTINGS,
    )


class Shell:
    """Starts commands in a folder and leaves none running."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._started: list[Command] = []

    def start(self, *arguments: str, within: str = "") -> Command:
        command = Command(self.folder, list(arguments), within)
        self._started.append(command)
        return command

    def run(self, *arguments: str) -> tuple[int, str]:
        return self.start(*arguments).finish()

    def up(self, *arguments: str) -> Command:
        return self.start("up", "t_junction", *SMALL, *arguments)

    def stop_all(self) -> None:
        for command in self._started:
            if command.process.poll() is None:
                command.process.send_signal(signal.SIGTERM)
                command.process.communicate(timeout=30)


@pytest.fixture
def shell(tmp_path: Path) -> Iterator[Shell]:
    made = Shell(tmp_path)
    yield made
    made.stop_all()


@pytest.fixture(scope="session")
def first_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns a finished run, which tests only read."""
    shell = Shell(tmp_path_factory.mktemp("first"))
    status, output = shell.up("--duration", "8", "--out", "first").finish()
    assert status == 0, output
    return shell.folder / "first"


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
