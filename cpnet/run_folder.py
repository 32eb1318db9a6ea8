"""The folder of a run, removed if the start fails or is interrupted.

Also finds the newest run, and prunes old ones.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from protocol.config import is_file
from protocol.errors import ConfigError
from protocol.instances import role_of
from protocol.topics import ROLES

RUNS = Path("runs")
_DATABASE, _SETUP, _BUSES = "run.sqlite", "setup.msgpack", "buses.json"
_SCENARIO, _LOGS = "scenario.json", "logs"
_DAY_S = 86_400.0


@dataclass(frozen=True, slots=True)
class RunFolder:
    """A folder that is to hold a run; `was_there` if it was the user's, and empty."""

    path: Path
    was_there: bool

    @classmethod
    def at(cls, out: Path | None, name: str) -> RunFolder:
        """Checks the path, `runs/NAME-TIME` if none is given.

        Raises:
            ConfigError: there can be no such folder, or it holds something.
        """
        if out is None:
            stamp = datetime.now(UTC).strftime("%Y%m%d-%H%M%S-%f")[:-3]
            out = RUNS / f"{name}-{stamp}"
        if "," in str(out.absolute()):
            raise ConfigError(f"--out {out}: SUMO takes no path with a comma in it")
        try:
            found = out.exists()
            if found and (not out.is_dir() or any(out.iterdir())):
                raise ConfigError(f"--out {out}: it exists and is not an empty folder")
            return cls(out.absolute(), found)
        except (OSError, ValueError) as error:
            raise ConfigError(f"--out {out}: {error}") from None

    def make(self) -> Path:
        """Makes it, unless it exists; returns its path.

        Raises:
            ConfigError: it cannot be made.
        """
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            return self.path.resolve()
        except (OSError, ValueError) as error:
            why = getattr(error, "strerror", None) or error
            raise ConfigError(f"--out {self.path}: no folder can be made there: {why}") from None

    def take_back(self) -> None:
        """Removes the made files, so that the same command can be repeated."""
        if not self.was_there:
            shutil.rmtree(self.path, ignore_errors=True)
            return
        for entry in self.path.iterdir():
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry, ignore_errors=True)
            else:
                entry.unlink(missing_ok=True)


@contextmanager
def written(run_dir: Path) -> Iterator[None]:
    """Context manager: turns errors of writing there into ConfigError.

    Raises:
        ConfigError: the disk is full, or may not be written.
    """
    try:
        yield
    except OSError as error:
        raise ConfigError(f"run folder {run_dir} cannot be written: {error}") from None


def newest_run() -> Path:
    """Returns the newest run in `runs/`, by when its database was written last.

    Raises:
        ConfigError: there is none.
    """
    found = recorded_runs(RUNS)
    if not found:
        raise ConfigError(f"there is no run in {RUNS}/: give its folder, or `cpnet up` makes one")
    return found[0]


def recorded_runs(folder: Path) -> list[Path]:
    """Returns the folders within one that hold a recorded run, newest first."""
    found = [path.parent for path in folder.glob(f"*/{_DATABASE}") if is_file(path)]
    return sorted(found, key=lambda run: (_written_s(run), run.name), reverse=True)


def prune(folder: Path, keep: int, days: float | None, now: datetime) -> list[Path]:
    """Removes runs that have ended, but for the newest, and returns what it removed.

    Only folders that a run made are touched, recorded or not (see `_is_run`), and no link to one.

    Args:
        folder: that holds the runs' folders.
        keep: how many of the newest stay in any case.
        days: others stay until they are so old; None: none of the others stays.
        now: the time, with its zone.

    Raises:
        ConfigError: there is no such folder, or a run cannot be removed.
    """
    removed = []
    for run in _runs(folder)[keep:]:
        age_s = now.timestamp() - _written_s(run)
        if (days is not None and age_s < days * _DAY_S) or not _has_ended(run):
            continue
        try:
            shutil.rmtree(run)
        except OSError as error:
            raise ConfigError(f"{run} cannot be removed: {error}") from None
        removed.append(run)
    return removed


def _runs(folder: Path) -> list[Path]:
    """Returns the runs within a folder, with a recorder or without, newest first."""
    try:
        found = [entry for entry in folder.iterdir() if _is_run(entry)]
    except OSError as error:
        raise ConfigError(f"{folder}: {error.strerror}") from None
    return sorted(found, key=lambda run: (_written_s(run), run.name), reverse=True)


def _is_run(run: Path) -> bool:
    """Whether a run made it: a setup, and a database or, without recorder, a process's log."""
    if run.is_symlink() or not is_file(run / _SETUP):
        return False
    return is_file(run / _DATABASE) or (is_file(run / _SCENARIO) and bool(_process_logs(run)))


def _process_logs(run: Path) -> list[Path]:
    """Returns the logs of a run's processes, which begin once `cpnet up` marks it as running."""
    return [path for path in (run / _LOGS).glob("*.log") if role_of(path.stem) in ROLES]


def _has_ended(run: Path) -> bool:
    """Whether no `cpnet up` marks it as running."""
    return not (run / _BUSES).exists()


def _written_s(run: Path) -> float:
    """Returns when the database was written last, or without one the logs of its processes."""
    database = run / _DATABASE
    files = [database] if is_file(database) else _process_logs(run)
    return max(map(_changed_s, files), default=0.0)


def _changed_s(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:  # it was removed since
        return 0.0
