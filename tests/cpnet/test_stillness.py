"""What is said of a run that stands still."""

import os
import signal
import subprocess
import sys

import pytest

from cpnet.stillness import Stillness
from cpnet.supervisor import is_stopped
from tests.waiting import wait_until

pytestmark = pytest.mark.process

S = 1_000_000_000


def test_a_silence_is_told_once_and_so_is_its_end():
    stillness = Stillness()
    assert stillness.frames(None, 90 * S) is None, "before the first frame nobody waits"
    heard = [stillness.frames(7, (91 + n) * S) for n in range(9)]
    assert [line for line in heard if line] == ["no frame for 4 s"]
    assert stillness.frames(8, 101 * S) == "frames come again, after 10 s"
    assert stillness.frames(9, 102 * S) is None


def test_a_run_that_is_slow_does_not_stand_still():
    stillness = Stillness()
    told = [stillness.frames(n // 5, n * S) for n in range(50)]
    assert [line for line in told if line] == ["no frame for 4 s", "frames come again, after 5 s"]


def test_who_is_stopped_is_named_once_and_so_is_that_it_goes_on():
    stillness = Stillness()
    told = [stillness.stopped(names) for names in ([], ["edge"], ["edge"], [])]
    assert told == [[], ["nothing heard from edge: it is stopped (SIGSTOP)"], [], ["edge goes on"]]


def test_a_stopped_process_is_known_by_its_state():
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        assert not is_stopped(process.pid)
        os.kill(process.pid, signal.SIGSTOP)
        wait_until(lambda: is_stopped(process.pid))
        os.kill(process.pid, signal.SIGCONT)
        wait_until(lambda: not is_stopped(process.pid))
        process.kill()
    assert not is_stopped(process.pid)
