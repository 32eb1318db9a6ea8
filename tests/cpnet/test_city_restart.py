"""`--restart` in a city: who dies takes himself along, and the others' frames go on."""

from __future__ import annotations

import os
import signal
import time

import pytest

from recording.run import Run
from recording.tables import FrameRow, RequestRow
from tests.cpnet.commands import SMALL, Command, Shell, query
from tests.signal_safety import violations_of
from tests.soak.findings import processes_of

PERIOD_S = 0.5
STEADY = 3  # frames in a row that are right
FRAMES_AFTER = 6
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
VICTIMS = {  # and the region whose frames go on without a gap meanwhile
    "edge-r1": ["r0"],
    "signal-r1": ["r0"],
    "infra-r1": ["r0"],
    "vehicle-0": [],  # its agents are of both regions: each waits for them until its deadline
    "router": [],
}
_RIGHT = (
    "SELECT count(*) FROM (SELECT complete, request_ns FROM region_frames WHERE region = 'r{}' "
    "AND frame > ? ORDER BY frame DESC LIMIT ?) WHERE complete AND request_ns IS NOT NULL"
)


def wait_until_right(command: Command, shell: Shell, after: int) -> None:
    """Waits for frames in a row, later than `after`, that are whole and answered in each region."""

    def is_right() -> bool:
        run = shell.folder / "run"
        counts = [query(run, _RIGHT.format(n), after, STEADY)[0][0] for n in (0, 1)]
        return min(counts) == STEADY

    command.wait_until(is_right)


def newest_frame(shell: Shell) -> int:
    return int(query(shell.folder / "run", "SELECT max(frame) FROM frames")[0][0])


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> Shell:
    """Returns the folder of a run in which each victim was killed once and all came right again."""
    shell = Shell(tmp_path_factory.mktemp("city"))
    command = shell.start("up", *CITY)
    try:
        command.wait_until((shell.folder / "run" / "run.sqlite").is_file)
        command.read_until("vehicles")
        wait_until_right(command, shell, 0)
        for victim in VICTIMS:
            number = processes_of(shell.folder / "run")[victim]
            os.kill(number, signal.SIGKILL)
            (shell.folder / victim).write_text(str(time.monotonic_ns()))
            came = lambda: processes_of(shell.folder / "run")[victim] != number  # noqa: B023, E731
            command.wait_until(came)
            wait_until_right(command, shell, newest_frame(shell))
        command.process.send_signal(signal.SIGINT)
        status, output = command.finish()
        assert status == 130, output
    finally:
        shell.stop_all()
    return shell


@pytest.mark.process
@pytest.mark.parametrize("victim", [name for name, others in VICTIMS.items() if others])
def test_the_other_regions_frames_go_on(city: Shell, victim: str):
    killed_ns = int((city.folder / victim).read_text())
    with Run(city.folder / "run") as run:
        ticks = [row.frame for row in run.rows(FrameRow) if (row.tick_ns or 0) > killed_ns]
        requests = {(row.frame, row.tls) for row in run.rows(RequestRow)}
        regions = run.scenario["regions"]
    after = ticks[:FRAMES_AFTER]
    assert len(after) == FRAMES_AFTER or victim == [*VICTIMS][-1]
    for region in VICTIMS[victim]:
        missed = [n for n in after if any((n, tls) not in requests for tls in regions[region])]
        assert len(missed) <= 1, (region, missed)  # one may come too late on a loaded machine


@pytest.mark.process
def test_no_signal_of_the_city_was_unsafe_meanwhile(city: Shell):
    with Run(city.folder / "run") as run:
        assert violations_of(run) == []
