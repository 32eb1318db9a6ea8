"""The work of one cell, as a worker does it: play, measure, tidy up."""

from __future__ import annotations

import shutil
import tempfile
import threading
import time
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from distributed import get_worker

from protocol.errors import ConfigError
from studies.measures import Row, measure
from studies.solo import play

_ONE_AT_A_TIME = threading.Lock()  # SUMO keeps its state globally, whatever the worker's threads


@dataclass(frozen=True, slots=True)
class Task:
    """What a worker is asked."""

    scenario: dict[str, Any]
    version: str
    keep: str | None = None
    """A folder for the run, which must not exist; None: the run is deleted once measured."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a worker answers."""

    row: Row
    took_s: float


def do(task: Task) -> Outcome:
    """Plays and measures one run.

    Raises:
        ConfigError: the scenario cannot be played, or this is another version.
    """
    here = version("cpnet-edge")
    if here != task.version:
        raise ConfigError(f"this worker has cpnet {here}, the study is of {task.version}")
    with _ONE_AT_A_TIME, in_own_folder() as folder:
        begun_ns = time.monotonic_ns()
        run_dir = Path(folder) / "run"
        run_dir.mkdir()
        play(task.scenario, run_dir)
        row = measure(run_dir)
        took_s = (time.monotonic_ns() - begun_ns) / 1e9
        if task.keep is not None:
            shutil.copytree(run_dir, task.keep, dirs_exist_ok=True)
    return Outcome(row, took_s)


def in_own_folder() -> tempfile.TemporaryDirectory[str]:
    """Returns a folder for one run, in the worker's own: Dask deletes that of a killed one too."""
    try:
        within = get_worker().local_directory
    except ValueError:  # no worker does this
        within = None
    return tempfile.TemporaryDirectory(prefix="cell-", dir=within)
