"""The newest run of a folder, and which runs `cpnet prune` removes."""

from __future__ import annotations

import json
import os
from datetime import UTC, datetime
from pathlib import Path

import pytest
from typer.testing import CliRunner

from cpnet.cli import app
from cpnet.run_folder import newest_run, prune, recorded_runs
from protocol.errors import ConfigError
from recording.database import Database
from recording.tables import MetaRow

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


def made_without_recorder(folder: Path, name: str, days_ago: float) -> Path:
    """What `cpnet up --only vehicle` leaves."""
    run = folder / name
    (run / "logs").mkdir(parents=True)
    for file in ("setup.msgpack", "scenario.json", "processes.json", "logs/vehicle-0.log"):
        (run / file).touch()
    written_s = NOW.timestamp() - days_ago * DAY_S
    os.utime(run / "logs" / "vehicle-0.log", (written_s, written_s))
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


def test_a_report_without_a_run_is_of_the_newest(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name, seed in (("older", 1), ("newer", 2)):
        (tmp_path / "runs" / name).mkdir(parents=True)
        database = Database(tmp_path / "runs" / name)
        scenario = {"name": name, "seed": seed, "frame_period_s": 0.1}
        database.add(MetaRow, {"scenario": json.dumps(scenario)}.items())
        database.close()
        os.utime(tmp_path / "runs" / name / "run.sqlite", (seed, seed))
    done = CliRunner().invoke(app, ["report", "--json"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.output)["scenario"] == "newer"


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


def test_runs_of_a_machine_without_recorder_are_removed_too(tmp_path) -> None:
    runs = [made_without_recorder(tmp_path, f"r{days}", days) for days in (1, 2, 40)]
    recorded = made(tmp_path, "recorded", 3)
    assert prune(tmp_path, 0, 30, NOW) == [runs[2]]
    assert prune(tmp_path, 2, None, NOW) == [recorded]
    assert prune(tmp_path, 0, 0, NOW) == runs[:2]


def test_without_recorder_what_is_no_ended_run_is_never_touched(tmp_path) -> None:
    goes_on = made_without_recorder(tmp_path, "goes-on", 99)
    (goes_on / "buses.json").touch()
    starts = made_without_recorder(tmp_path, "starts", 99)
    (starts / "logs" / "vehicle-0.log").rename(starts / "logs" / "fork-server.log")
    foreign = tmp_path / "foreign"
    (foreign / "logs").mkdir(parents=True)
    (foreign / "logs" / "vehicle-0.log").touch()
    link = tmp_path / "link"
    link.symlink_to(made_without_recorder(tmp_path.with_name("other-runs"), "run", 99))
    assert prune(tmp_path, 0, None, NOW) == []
    assert all(path.exists() for path in (goes_on, starts, foreign, link))


def test_pruning_a_folder_that_is_not_there_is_an_error(tmp_path) -> None:
    done = CliRunner().invoke(app, ["prune", str(tmp_path / "ruins")])
    assert isinstance(done.exception, ConfigError)
    assert "ruins: No such file" in str(done.exception)
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="Not a directory"):
        prune(tmp_path / "file", 0, None, NOW)
