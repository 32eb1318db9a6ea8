"""`cpnet study` as a user starts it: killed, stopped, resumed, here and on a Dask cluster."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.cpnet.commands import Shell
from tests.waiting import TIMEOUT_S, wait_until

pl = pytest.importorskip("polars", reason="needs the extra `study`")
pytest.importorskip("distributed", reason="needs the extra `study`")

STUDY = """
name: small
set:
  duration_s: 2
  frame_period_s: 1
  processes.vehicle: 1
  roadside_mounts: []
  traffic.warmup_s: 0
  traffic.cav_rate: 0
seeds: [1]
axes:
  traffic.cv_rate: [0.2, 0.5]
  controller:
    fixed plan: {signal.policy: fixed}
    max pressure: {signal.policy: max_pressure}
"""
CELLS = 4


@pytest.fixture
def folder(shell: Shell) -> Path:
    (shell.folder / "small.yaml").write_text(STUDY)
    return shell.folder


@pytest.fixture(scope="session")
def whole(shared: Callable[..., Path]) -> Path:
    """Returns the finished study, made by one process, which tests only read."""

    def make(folder: Path) -> None:
        (folder / "small.yaml").write_text(STUDY)
        finish(Shell(folder), "--out", "whole", "--jobs", "1")

    return shared("study", make) / "whole"


def kept(out: Path) -> dict[str, int]:
    """Returns when each finished cell was written."""
    return {path.name: path.stat().st_mtime_ns for path in (out / "cells").glob("*.json")}


def table(out: Path) -> pl.DataFrame:
    return pl.read_parquet(out / "results.parquet")


def finish(shell: Shell, *arguments: str) -> str:
    status, output = shell.run("study", "small.yaml", *arguments)
    assert status == 0, output
    return output


@pytest.mark.slow
def test_after_a_kill_finished_cells_are_not_run_again_and_the_table_is_the_same(
    shell, folder, whole
):
    killed = shell.start("study", "small.yaml", "--out", "killed", "--jobs", "2")
    killed.wait_until(lambda: kept(folder / "killed"), what="no cell was ever done")
    killed.process.kill()
    killed.finish()
    first = kept(folder / "killed")
    assert 1 <= len(first) < CELLS
    output = finish(shell, "--out", "killed", "--jobs", "2")
    assert f"{CELLS}/{CELLS}  all" in output
    assert f"  {len(first)}/{CELLS}  all" not in f"  {output}"
    second = kept(folder / "killed")
    assert len(second) == CELLS
    assert first.items() <= second.items()
    assert table(folder / "killed").equals(table(whole))
    assert len(table(whole)) == CELLS
    assert kept(folder / "killed").keys() == kept(whole).keys()


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_a_stop_ends_at_once_without_a_traceback_and_says_how_to_go_on(shell, folder, how):
    command = shell.start("study", "small.yaml", "--out", "out", "--jobs", "2")
    command.wait_until(lambda: kept(folder / "out"), what="no cell was ever done")
    workers = children(command.process.pid)
    assert workers
    command.process.send_signal(how)
    status, output = command.finish()
    assert status == 128 + how
    assert "the same command goes on from there" in output
    assert "Traceback" not in output
    wait_until(lambda: not [pid for pid in workers if runs(pid)], what="a worker is left")


def test_a_study_that_is_done_runs_nothing_and_gives_its_rows_to_programs(shell, folder, whole):
    out = shutil.copytree(whole, folder / "done")
    before = kept(out)
    results = json.loads(finish(shell, "--out", "done", "--json"))
    assert kept(out) == before == kept(whole)
    assert results["rows"] == CELLS
    assert results["failed"] == []
    labels = [(row["traffic.cv_rate"], row["controller"]) for row in results["cells"]]
    assert labels[:2] == [(0.2, "fixed plan"), (0.2, "max pressure")]


def test_runs_are_kept_where_asked_and_a_cell_that_fails_makes_the_status_1(shell, folder):
    text = STUDY.replace("[0.2, 0.5]", "[0.2]")
    bad = "    wrong: {junctions: [nowhere]}\n"
    (folder / "small.yaml").write_text(text + bad)
    status, output = shell.run("study", "small.yaml", "--out", "out", "--keep-runs", "--json")
    assert status == 1, output
    assert "failed  all traffic.cv_rate=0.2 controller=wrong seed=1: " in output
    assert "'nowhere'" in output
    assert len(list((folder / "out" / "runs").glob("*/run.sqlite"))) == 2
    assert len(table(folder / "out")) == 2


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """Yields the address of a scheduler with two worker processes, and the scheduler."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    address = f"tcp://127.0.0.1:{port}"
    place = ["--host", "127.0.0.1", "--no-dashboard"]
    commands = [["scheduler", *place, "--port", port]]
    commands += [["worker", address, *place, "--nthreads", "1"] for _ in range(2)]
    log = (tmp_path / "cluster.log").open("wb")
    started = [
        subprocess.Popen(
            [sys.executable, "-m", "dask", *command], stdout=log, stderr=log, cwd=tmp_path
        )
        for command in commands
    ]
    yield address, started[0]
    for process in reversed(started):
        process.terminate()
    for process in started:
        process.wait(TIMEOUT_S)
    log.close()


@pytest.mark.slow
def test_a_scheduler_with_two_workers_gives_the_table_of_this_machine_and_its_loss_ends_a_study(
    shell, folder, cluster, whole
):
    address, scheduler = cluster
    finish(shell, "--out", "there", "--scheduler", address)
    assert table(folder / "there").equals(table(whole))
    for name in ("results.parquet", "junctions.parquet", "regions.parquet"):
        assert (folder / "there" / name).read_bytes() == (whole / name).read_bytes()

    longer = ("--out", "out", "--set", "duration_s=20", "--scheduler", address)
    command = shell.start("study", "small.yaml", *longer)
    command.wait_until(lambda: kept(folder / "out"), what="no cell was ever done")
    scheduler.kill()
    status, output = command.finish()
    assert status == 2
    assert "the scheduler was lost; the same command goes on with what is left" in output
    assert "Traceback" not in output
    assert 1 <= len(kept(folder / "out")) < CELLS


def test_without_the_extra_it_is_named(folder):
    code = "import sys; sys.modules['polars'] = None; from cpnet.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code, "study", "small.yaml"],
        cwd=folder, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert "studies need polars (extra `study`)" in done.stderr
    assert "-m pip install" in done.stderr
    assert [path.name for path in folder.iterdir()] == ["small.yaml"]


def refused(shell: Shell, *arguments: str) -> str:
    status, output = shell.run("study", *arguments)
    assert status == 2, output
    assert "Traceback" not in output
    return output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], "there is no study 'nowhere'"),
        (["small.yaml", "--seeds", "1,x"], "--seeds 1,x: must be numbers"),
        (["small.yaml", "--seeds", "5-1"], "must be a range"),
        (["small.yaml", "--set", "traffic.cv_rate=1"], "the axis traffic.cv_rate varies it"),
        (["small.yaml", "--set", "durations_s=1"], "unknown key durations_s; did you mean"),
        (["small.yaml", "--set", "mode=realtime"], "must be lockstep"),
        (["small.yaml", "--jobs", "0"], "jobs"),
        (["small.yaml", "--scheduler", "tcp://127.0.0.1:1", "--jobs", "1"], "--scheduler"),
    ],
)
def test_what_cannot_be_starts_nothing(shell, folder, arguments, message):
    assert message in refused(shell, *arguments)
    assert [path.name for path in folder.iterdir()] == ["small.yaml"]


def children(pid: int) -> list[int]:
    """Returns the processes that a process started."""
    found = Path(f"/proc/{pid}/task").glob("*/children")
    return [int(word) for path in found for word in path.read_text().split()]


def runs(pid: int) -> bool:
    """Whether a process is there, and is no zombie that its new parent has not noticed yet."""
    try:
        os.kill(pid, 0)
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (OSError, IndexError):
        return False
