"""What is printed about a run that has stalled."""

import io
import os
import signal
import subprocess
import sys
from types import SimpleNamespace

import pytest
from rich.console import Console

from cpnet.exit_report import ExitReport
from cpnet.run_monitor import RunMonitor, StallCheck
from cpnet.supervisor import is_stopped
from tests.waiting import wait_until

pytestmark = pytest.mark.process

S = 1_000_000_000


def test_a_silence_is_told_once_and_so_is_its_end():
    stall_check = StallCheck()
    assert stall_check.frames(None, 90 * S) is None, "before the first frame nobody waits"
    reports = [stall_check.frames(7, (91 + n) * S) for n in range(9)]
    assert [line for line in reports if line] == ["no frame for 4 s"]
    assert stall_check.frames(8, 101 * S) == "frames come again, after 10 s"
    assert stall_check.frames(9, 102 * S) is None


def test_a_run_that_is_slow_does_not_stand_still():
    stall_check = StallCheck()
    reports = [stall_check.frames(n // 5, n * S) for n in range(50)]
    assert [line for line in reports if line] == [
        "no frame for 4 s",
        "frames come again, after 5 s",
    ]


def test_who_is_stopped_is_named_once_and_so_is_that_it_goes_on():
    stall_check = StallCheck()
    reports = [stall_check.stopped(names) for names in ([], ["edge"], ["edge"], [])]
    assert reports == [
        [],
        ["nothing heard from edge: it is stopped (SIGSTOP)"],
        [],
        ["edge goes on"],
    ]


def test_a_stopped_process_is_known_by_its_state():
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        assert not is_stopped(process.pid)
        os.kill(process.pid, signal.SIGSTOP)
        wait_until(lambda: is_stopped(process.pid))
        os.kill(process.pid, signal.SIGCONT)
        wait_until(lambda: not is_stopped(process.pid))
        process.kill()
    assert not is_stopped(process.pid)


class Dying:
    """A supervisor of whose processes one dies just after `remove_failed` for a recording."""

    def __init__(self, failure: ExitReport) -> None:
        self._coming = failure
        self._dead: ExitReport | None = None

    def fork_server_exit(self) -> None:
        return None

    def failure(self, *, at_end: bool) -> ExitReport | None:
        return self._dead

    def remove_failed(self, role: str, *, at_end: bool) -> ExitReport | None:
        found, self._dead = self._dead, self._coming
        if found is None or found.id != role:
            return None
        self._dead = None
        return found


@pytest.mark.parametrize(("name", "has_begun", "ends"), [
    ("mcap", True, False), ("mcap", False, True), ("edge", True, True),
])  # fmt: skip
def test_a_death_that_comes_at_an_odd_moment_ends_the_run_unless_it_is_a_recordings(
    name, has_begun, ends
):
    failure = ExitReport(name, "was killed by SIGKILL", "")
    supervisor = Dying(failure)
    if not has_begun:
        supervisor.remove_failed("", at_end=False)  # which is not removed
    printed, recordings = io.StringIO(), []
    monitor = RunMonitor(supervisor, None, None, Console(file=printed), restart=False)
    progress = object() if has_begun else None
    watch = SimpleNamespace(end=None, progress=progress, await_end=lambda _: None)
    assert monitor._fatal(watch, recordings) == (failure if ends else None)
    if not ends:
        assert monitor._fatal(watch, recordings) is None
        assert recordings == [failure]
        assert "the run goes on without it" in printed.getvalue()


class Alone:
    """A supervisor on a machine without the world."""

    def holds(self, process: str) -> bool:
        return False


@pytest.mark.parametrize("comes_back", [True, False])
def test_a_world_that_is_missed_for_a_moment_ends_no_run_elsewhere(comes_back):
    missed = [("sim", "sim")]
    watch = SimpleNamespace(end=None, lost=lambda: [*missed])
    watch.await_end = lambda _: missed.clear() if comes_back else None
    monitor = RunMonitor(Alone(), None, None, Console(file=io.StringIO()), restart=True)
    failure = monitor._lost_elsewhere(watch)
    assert (failure is None) == comes_back
