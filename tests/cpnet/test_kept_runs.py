"""The newest run of a folder, and which runs `cpnet prune` removes."""

from __future__ import annotations

import os
from datetime import UTC, datetime
from pathlib import Path

import pytest

from cpnet.run_folder import newest_run, prune, recorded_runs
from protocol.errors import ConfigError

DAY_S = 86_400
NOW = datetime(2026, 1, 31, tzinfo=UTC)


def made(folder: Path, name: str, days_ago: float, *files: str) -> Path:
    run = folder / name
    run.mkdir(parents=True)
    for file in ("run.sqlite", "setup.msgpack", *files):
        (run / file).touch()
    written_s = NOW.timestamp() - days_ago * DAY_S
    os.utime(run / "run.sqlite", (written_s, written_s))
    return run


def test_the_newest_is_that_written_last_whatever_its_name(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match="there is no run in runs/"):
        newest_run()
    for name, days in (("c", 3), ("a", 1), ("b", 2)):
        made(tmp_path / "runs", name, days)
    (tmp_path / "runs" / "study-x").mkdir()
    assert newest_run() == Path("runs/a")
    assert [run.name for run in recorded_runs(Path("runs"))] == ["a", "b", "c"]


def test_the_newest_stay_whatever_their_age(tmp_path) -> None:
    runs = [made(tmp_path, f"r{days}", days) for days in (1, 40, 50, 60)]
    assert prune(tmp_path, 2, 30, NOW) == runs[2:]
    assert [run.exists() for run in runs] == [True, True, False, False]


def test_others_stay_until_they_are_old(tmp_path) -> None:
    runs = [made(tmp_path, f"r{days}", days) for days in (1, 2, 40)]
    assert prune(tmp_path, 0, 30, NOW) == [runs[2]]
    assert prune(tmp_path, 1, None, NOW) == [runs[1]]


def test_what_is_no_ended_run_is_never_touched(tmp_path) -> None:
    goes_on = made(tmp_path, "goes-on", 99, "buses.json")
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "run.sqlite").touch()
    elsewhere = made(tmp_path.with_name("elsewhere-runs"), "run", 99)
    link = tmp_path / "link"
    link.symlink_to(elsewhere)
    assert prune(tmp_path, 0, None, NOW) == []
    assert all(path.exists() for path in (goes_on, foreign, link, elsewhere / "setup.msgpack"))
