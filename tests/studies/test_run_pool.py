"""Runs in processes of their own: all come back, an error ends the rest, a killed one is named."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from multiprocessing import util

import pytest

from protocol.errors import ConfigError
from studies.run_pool import run_each

pytestmark = pytest.mark.process


class Unsendable(Exception):
    """An error that no other process can be sent."""

    def __init__(self) -> None:
        super().__init__("for good")
        self.lock = threading.Lock()


def work(task: str) -> tuple[str, int]:
    match task:
        case "wrong":
            raise ConfigError("it is wrong")
        case "killed":
            os.kill(os.getpid(), signal.SIGKILL)
        case "unsendable":
            raise Unsendable
        case "endless":
            signal.pause()
        case "warns":
            os.write(2, b"Warning: a vehicle brakes hard\n")  # as compiled code does
    return task, os.getpid()


def test_each_task_has_a_process_of_its_own() -> None:
    found = dict(run_each(work, ["a", "b", "c", "d"], 2))
    assert [found[number][0] for number in range(4)] == ["a", "b", "c", "d"]
    assert len({pid for _, pid in found.values()} - {os.getpid()}) == 4


def test_what_tasks_print_goes_to_the_log(tmp_path, capfd) -> None:
    assert len(list(run_each(work, ["warns", "a", "warns"], 2, tmp_path / "runs.log"))) == 3
    printed = (tmp_path / "runs.log").read_text()
    assert printed == 2 * "Warning: a vehicle brakes hard\n"
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("task", "error", "error_text"),
    [
        ("wrong", ConfigError, "it is wrong"),
        ("killed", ConfigError, "a run's process was killed"),
        ("unsendable", RuntimeError, "Unsendable: for good"),
    ],
)
def test_what_ends_a_task_ends_the_others(
    task: str, error: type[Exception], error_text: str
) -> None:
    with pytest.raises(error, match=error_text):
        list(run_each(work, ["endless", task, "a"], 2))
    assert multiprocessing.active_children() == []


def test_who_stops_listening_leaves_no_process() -> None:
    runs = run_each(work, ["a", "endless", "endless"], 2)
    assert next(runs)[0] == 0
    runs.close()
    assert multiprocessing.active_children() == []


@pytest.fixture
def ctrl_c_raises() -> Iterator[None]:
    """Whatever an earlier test in this process left."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("ctrl_c_raises")
def test_ctrl_c_while_a_process_is_cleaned_up_is_not_lost(monkeypatch) -> None:
    close, closed = util.close_fds, []

    def interrupted(*ends: int) -> None:
        monkeypatch.undo()
        signal.raise_signal(signal.SIGINT)
        close(*ends)
        closed.extend(ends)

    monkeypatch.setattr(util, "close_fds", interrupted)
    with pytest.raises(KeyboardInterrupt):
        list(run_each(work, ["a", "b", "c"], 1))
    assert closed
    assert multiprocessing.active_children() == []
