"""Commands about tracks, on a small run and on files in KITTI's format."""

import json
from pathlib import Path

import polars as pl

from tests.studies.tracked_runs import make_run

KITTI = Path(__file__).parents[1] / "studies" / "kitti"


def test_the_tracks_of_a_run_are_measured_and_written(shell, tmp_path):
    make_run(tmp_path)
    status, output = shell.run("eval", "--tracks", str(tmp_path))
    assert status == 0, output
    assert "IDF1" in output
    status, output = shell.run("eval", "--tracks", str(tmp_path), "--json")
    assert json.loads(output)["passages"] == 1
    status, output = shell.run("report", str(tmp_path), "--trajectories", "found.parquet")
    assert (status, output.strip()) == (0, "wrote 1 tracks to found.parquet")
    assert len(pl.read_parquet(tmp_path / "found.parquet")) == 40
    status, output = shell.run("report", str(tmp_path), "--json")
    assert json.loads(output)["tracks"]["precision"]["coasted"] == 0.5
    status, output = shell.run("report", str(tmp_path))
    assert "precision, coasted" in output


def test_files_in_kittis_format_are_tracked_and_scored(shell, tmp_path):
    places = (str(KITTI / "detections"), "--poses", str(KITTI / "poses"))
    status, output = shell.run("track", *places, "--out", "out")
    assert (status, output.strip()) == (0, "wrote 1 files in out")
    labels = ("--format=kitti", f"--truth={KITTI / 'labels'}")
    status, output = shell.run("eval", "--tracks=out", *labels, "--json")
    found = json.loads(output)
    assert (found["type"], found["rules"], found["passages"]) == ("Car", "kitti", 3)
    assert found["id_switches"] == 0
