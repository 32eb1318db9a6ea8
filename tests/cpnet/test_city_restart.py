"""`--restart` in a city: a killed process is restarted, and frames of other regions continue.

All is right again within 3 s by the run's own clock, its frames. A machine that others load may be
too slow for that: there it may take longer, as loading the programs alone takes longer, and a
process is killed again; one kill that goes well is enough.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from recording.run import Run
from tests.cpnet.commands import SMALL, Command, Shell, query
from tests.signal_safety import violations_of
from tests.soak.findings import processes_of

PERIOD_S = 0.5
STEADY = 3  # frames in a row that are right
AGAIN_S = 3.0
LOADING = "import edge_server.role, infra_agent.role, signal_controller.role"
LOADING_S = 2.0  # what that takes on a machine without other work
KILLS = 4  # of one process at most
CITY = (
    "corridor",
    *SMALL,
    "--regions=2",
    "--cav-rate=0.2",
    "--mode=realtime",
    "--restart",
    "--duration=600",
    f"--set=frame_period_s={PERIOD_S}",
    "--set=edge.deadline_ms=300",
    "--set=traffic.warmup_s=30",
    "--out=run",
)
GO_ON = {
    "edge-r1": ["r0"],
    "signal-r1": ["r0"],
    "infra-r1": ["r0"],
    "vehicle-0": ["r0", "r1"],  # without its uploads
    "router": [],  # it serves both
}
"""By killed process the regions that miss no frame meanwhile."""
_RIGHT = """
SELECT (SELECT count(*) FROM region_frames r WHERE r.frame = f.frame AND complete) = 2
   AND (SELECT count(*) FROM requests q WHERE q.frame = f.frame) = 5
   AND agents = cavs + 5
FROM frames f WHERE tick_ns > ? ORDER BY frame
"""
"""Of each frame after a time: whether both regions were complete, with a request for each of the
five signals and uploads of all CAVs and posts."""


def frames_until_right(run_dir: Path, since_ns: int) -> int:
    """Returns how many frames it took to the first of `STEADY` right ones, itself counted; or 0."""
    right = [bool(holds) for (holds,) in query(run_dir, _RIGHT, since_ns)]
    windows = range(len(right) - STEADY + 1)
    return next((n + 1 for n in windows if all(right[n : n + STEADY])), 0)


@dataclass(frozen=True, slots=True)
class Kill:
    """How many frames it took until all was right; those missed by regions that were to go on.

    `loading_s` is how long it took then to load the programs, 0 where that decides nothing.
    """

    frames: int
    missed: list[int]
    loading_s: float

    @property
    def went_well(self) -> bool:
        within_s = AGAIN_S * max(1.0, self.loading_s / LOADING_S)
        return self.frames * PERIOD_S <= within_s and not self.missed


def loading_s() -> float:
    """Loads the programs; returns how long it took."""
    since_s = time.monotonic()
    subprocess.run([sys.executable, "-c", LOADING], check=True)
    return time.monotonic() - since_s


def kill_once(command: Command, run_dir: Path, victim: str) -> Kill:
    """Kills a process and waits until all is right."""
    number = processes_of(run_dir)[victim]
    killed_ns = time.monotonic_ns()
    os.kill(number, signal.SIGKILL)
    command.wait_until(lambda: processes_of(run_dir)[victim] != number)
    frames = command.wait_until(lambda: frames_until_right(run_dir, killed_ns))
    sql = "SELECT frame FROM frames WHERE tick_ns > ? ORDER BY frame LIMIT ?"
    meanwhile = [frame for (frame,) in query(run_dir, sql, killed_ns, frames)]
    asked = set(query(run_dir, "SELECT frame, tls FROM requests"))
    regions = json.loads((run_dir / "scenario.json").read_text())["regions"]
    signals = [tls for region in GO_ON[victim] for tls in regions[region]]
    missed = [n for n in meanwhile if any((n, tls) not in asked for tls in signals)]
    is_late = frames * PERIOD_S > AGAIN_S
    return Kill(frames, missed, loading_s() if is_late and not missed else 0.0)


@dataclass(frozen=True, slots=True)
class City:
    """A run, and its kills by victim."""

    run_dir: Path
    kills: dict[str, list[Kill]]


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> City:
    shell = Shell(tmp_path_factory.mktemp("city"))
    city = City(shell.folder / "run", {victim: [] for victim in GO_ON})
    command = shell.start("up", *CITY)
    try:
        command.wait_until((city.run_dir / "run.sqlite").is_file)
        command.read_until("vehicles")
        command.wait_until(lambda: frames_until_right(city.run_dir, 0))
        for victim, kills in city.kills.items():
            while len(kills) < KILLS and not any(kill.went_well for kill in kills):
                kills.append(kill_once(command, city.run_dir, victim))
        command.process.send_signal(signal.SIGINT)
        status, output = command.finish()
        assert status == 130, output
    finally:
        shell.stop_all()
    return city


@pytest.mark.process
@pytest.mark.parametrize("victim", GO_ON)
def test_all_is_right_again_within_three_seconds_and_the_others_miss_no_frame(
    city: City, victim: str
):
    assert any(kill.went_well for kill in city.kills[victim]), city.kills


@pytest.mark.process
def test_no_signal_of_the_city_was_unsafe_meanwhile(city: City):
    with Run(city.run_dir) as run:
        assert violations_of(run) == []
