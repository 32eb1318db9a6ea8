"""`cpnet.run`, `cpnet.simulate`, `cpnet.study`: in one process, results as Polars frames."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import polars as pl
import pytest

import cpnet
from perception.detector import Vehicles
from protocol.errors import ConfigError
from recording.tables import RequestRow
from tests.waiting import TIMEOUT_S

ROOT = Path(__file__).parents[2]
LIDAR = {"channels": 16, "points_per_second": 72_000}
SMALL = {
    "frame_period_s": 1,
    "duration_s": 3,
    "traffic": {"warmup_s": 30, "cav_rate": 0.1},
    "lidar": {"vehicle": LIDAR, "roadside": LIDAR},
    "processes": {"vehicle": 1},
}


@pytest.fixture(scope="module")
def run() -> cpnet.Run:
    return cpnet.run(SMALL, seed=3)


def test_tables_are_frames_with_the_columns_of_the_database_and_the_time(run) -> None:
    assert run.frames["frame"].to_list() == [0, 1, 2]
    assert run.frames["sim_time_s"].to_list() == [30.0, 31.0, 32.0]
    assert {"x_m", "yaw_rad", "track", "sim_time_s"} <= set(run.detections.columns)
    assert run.uploads.schema["payload_bytes"] == pl.Int64
    assert run.uploads.schema["link_sim_ns"] == pl.Int64  # though every row of it is null
    assert run.counts["vehicles"].sum() > 0
    for table in (run.signals, run.latency, run.truth, run.trips):
        assert len(table)


def test_tracks_are_detections_that_follow_one_another(run) -> None:
    assert len(run.tracks) == len(run.detections.filter(pl.col("track") != 0)) > 0
    assert run.tracks["track"].is_sorted()


def test_scans_are_arrays_in_the_map_frame(run) -> None:
    (frame, *_) = run.scan_frames
    cloud = run.cloud(frame)
    assert cloud.shape[1] == 3
    assert len(cloud) == sum(len(scan.points()) for scan in run.scans(frame)) > 1_000
    with pytest.raises(ConfigError, match="no scans of frame 999"):
        run.scans(999)


def test_the_same_seed_gives_the_same_rows_in_the_same_process(run) -> None:
    again = cpnet.run(SMALL, seed=3)
    assert again.detections.equals(run.detections)
    assert again.truth.equals(run.truth)


def test_what_there_is_is_listed(run) -> None:
    assert {"Run", "run", "simulate", "study"} <= set(dir(cpnet))
    for row in ("uploads", int, ["uploads"]):
        with pytest.raises(ConfigError, match=r"must be a class of recording\.tables.* UploadRow"):
            run.table(row)


def test_a_temporary_run_goes_with_its_object() -> None:
    made = cpnet.run(SMALL, duration_s=1)
    folder = made.dir
    assert folder.is_dir()
    made.close()
    del made
    assert not folder.exists()


def test_a_run_stays_where_it_is_told_to_and_is_read_again(tmp_path) -> None:
    cpnet.run(SMALL, duration_s=1, out=tmp_path / "kept").close()
    with cpnet.Run(tmp_path / "kept") as kept:
        assert kept.figures["frames"] == 1


def test_keys_are_those_of_scenarios_dotted_or_by_section() -> None:
    with pytest.raises(ConfigError, match=r"unknown key traffic\.cav_rat.*did you mean cav_rate"):
        cpnet.run(SMALL, traffic={"cav_rat": 1})
    with pytest.raises(ConfigError, match="mode is realtime"):
        cpnet.run(SMALL, mode="realtime")
    demand = {"demand_vph_per_lane": {"east_in": 100}}  # a value with keys of its own
    with cpnet.run({**SMALL, "duration_s": 1}, traffic=demand, **{"edge.upstream_m": 80}) as made:
        assert made.scenario["traffic"]["demand_vph_per_lane"] == {"east_in": 100}
        assert made.scenario["traffic"]["cav_rate"] == 0.1
        assert made.scenario["edge"]["upstream_m"] == 80


def one_box(cloud) -> np.ndarray:
    points, over_road_m = cloud.points_over_road()
    assert len(points) == len(over_road_m)  # both are empty when the edge warms up
    return np.array([[-20.0, 5.0, 0.8, 4.5, 1.8, 1.5, 0.0, 0.5]])


def nothing(scan, map_SE3_sensor) -> np.ndarray:
    return np.zeros(scan.range_m.shape, np.bool_)


def poses_alone(found: Vehicles, poses) -> Vehicles:
    return found.take(np.zeros(len(found), np.bool_))


def second_green(observation, signal) -> int:
    assert observation.vehicles is not None
    return 1


def test_functions_take_the_place_of_the_parts(tmp_path) -> None:
    with cpnet.run(SMALL, detector=one_box, controller=second_green, out=tmp_path / "a") as made:
        lidar = made.detections.filter(pl.col("source") == "lidar")
        assert set(lidar["length_m"]) <= {4.5}
        requests = made.table(RequestRow)
        assert set(requests["policy"]) == {"own:second_green"}
        assert requests["state"].n_unique() == 1
        assert made.figures["e_cvpr"] is not None  # who reads it later needs no function
    with cpnet.run(SMALL, upload_policy=nothing, fusion=poses_alone) as made:
        assert made.uploads["points"].sum() == 0
        assert made.detections.is_empty()


@pytest.mark.parametrize(
    ("part", "error_text"),
    [
        (
            {"detector": lambda cloud: np.zeros((2, 3))},
            r"returned float64 \(2, 3\), must return boxes",
        ),
        ({"detector": lambda cloud: None}, r"own:<lambda> .* returned a NoneType .*must return"),
        ({"detector": lambda cloud: "box"}, r"own:<lambda> .* returned a str .*must return boxes"),
        ({"detector": lambda cloud: np.full((1, 7), np.nan)}, r"own:<lambda> .* boxes with NaN"),
        ({"upload_policy": lambda scan, pose: None}, r"own:<lambda> .* returned a NoneType"),
        ({"upload_policy": lambda scan, pose: np.ones(3, bool)}, r"returned bool \(3,\), must"),
        (
            {"upload_policy": lambda scan, pose: scan.range_m},
            r"returned float32 \(.*\), must return a mask",
        ),
        ({"fusion": lambda found, poses: 1}, r"found a int, must find Vehicles"),
        ({"controller": lambda observation, signal: 7}, r"chose green 7 of J, which has 0 to 1"),
        ({"controller": lambda observation, signal: None}, r"own:<lambda> .* a NoneType \(None\)"),
        ({"controller": lambda observation, signal: float("nan")}, r"chose a float \(nan\) for J"),
        ({"controller": lambda observation, signal: np.zeros(2)}, r"chose float64 \(2,\) for J"),
        ({"controller": lambda observation, signal: True}, r"chose a bool \(True\) for J"),
        ({"controller": lambda observation, signal: "north"}, r"'north' for J, must choose one of"),
        (
            {"controller": lambda observation, signal: "r" * len(signal.greens[0])},
            r"must choose one of its greens .*, not all r",
        ),
        (
            {"controller": lambda observation, signal: "G" * len(signal.greens[0])},
            r"own:<lambda> .* gives green to links that conflict: \d+ and \d+.*; its greens are",
        ),
        ({"detector": "fast"}, r"a name is a key of the scenario: \*\*{\"edge.detector\": 'fast'}"),
        ({"controller": 7}, r"signal\.policy: a int was given, must be a function"),
    ],
)
def test_what_functions_return_is_looked_at(part, error_text) -> None:
    with pytest.raises(ConfigError, match=error_text):
        cpnet.run(SMALL, duration_s=1, **part)


def test_frames_are_those_of_the_run_before_signals_decide() -> None:
    asked = []

    def noted(observation, signal) -> int:
        asked.append(observation.counts.frame)
        return 0

    numbers = []
    for frame in cpnet.simulate(SMALL, controller=noted):
        assert frame.number not in asked
        assert len(frame.cloud()) > 1_000
        assert frame.upload_bytes > 0
        assert frame.boxes.shape == (len(frame.boxes), 7)
        assert set(frame.counts) == set(frame.signals) == {"J"}
        assert len(frame.truth.ids) > 0
        numbers.append(frame.number)
    assert numbers == sorted(asked) == [0, 1, 2]


def test_looking_on_changes_no_row(run, tmp_path) -> None:
    for _ in cpnet.simulate(SMALL, seed=3, out=tmp_path / "looked-at"):
        pass
    with cpnet.Run(tmp_path / "looked-at") as seen:
        assert seen.detections.equals(run.detections)
        assert seen.signals.equals(run.signals)


def test_there_is_one_run_at_a_time_in_a_process() -> None:
    frames = cpnet.simulate(SMALL)
    next(frames)
    with pytest.raises(ConfigError, match="another run of this process has not ended"):
        cpnet.run(SMALL)
    frames.close()
    with cpnet.run(SMALL, duration_s=1) as made:
        assert made.figures["frames"] == 1


def test_a_study_gives_its_table_and_runs_no_cell_twice(tmp_path, monkeypatch) -> None:
    study = {"name": "small", "axes": {"traffic.cav_rate": [0.0, 0.1]}, "seeds": [1]}
    settings = {**SMALL, "traffic": {"warmup_s": 30}, "duration_s": 1}
    table = cpnet.study(study, out=tmp_path, **settings)
    assert table["traffic.cav_rate"].to_list() == [0.0, 0.1]
    assert table["uplink_mbps"][0] < table["uplink_mbps"][1]
    monkeypatch.setattr("studies.sweep.worker.run_in_process", None)  # nothing can be run
    assert cpnet.study(study, out=tmp_path, **settings).equals(table)
    with pytest.raises(ConfigError, match="jobs is 0, must be 1 or more"):
        cpnet.study(study, jobs=0)
    with pytest.raises(ConfigError, match="unknown key axis"):
        cpnet.study({**study, "axis": 1})


def test_a_function_where_a_name_is_meant_is_told_its_argument() -> None:
    for keys in ({"edge": {"detector": one_box}}, {"signal.policy": second_green}):
        with pytest.raises(ConfigError, match=r"a function, .*argument (detector|controller)="):
            cpnet.run(SMALL, **keys)


def test_a_part_is_given_by_a_function_or_by_a_name() -> None:
    error_text = r"edge\.detector is 'fast', and detector= gives a function: give one"
    with pytest.raises(ConfigError, match=error_text):
        cpnet.run(SMALL, detector=one_box, edge={"detector": "fast"})


def test_processes_take_no_functions() -> None:
    with pytest.raises(ConfigError, match="functions of this program run in its process"):
        cpnet.run(SMALL, detector=one_box, processes=True)


def test_a_child_that_runs_the_script_again_is_told_of_the_guard(monkeypatch) -> None:
    monkeypatch.setattr(sys, "tracebacklimit", 1000, raising=False)
    monkeypatch.setattr(multiprocessing.current_process(), "_inheriting", True, raising=False)
    for call in (cpnet.run, lambda what: next(cpnet.simulate(what)), cpnet.study):
        with pytest.raises(ConfigError, match='under `if __name__ == "__main__":`'):
            call(SMALL)


UNGUARDED = """
import cpnet

print("once")
lidar = {lidar}
print(cpnet.{call}, duration_s=1, frame_period_s=1, lidar=dict(vehicle=lidar, roadside=lidar)))
"""


def script(folder: Path, call: str) -> tuple[int, str, str]:
    """Runs a script that calls this without a guard; returns its status and what it prints."""
    (folder / "script.py").write_text(UNGUARDED.format(lidar=LIDAR, call=call), "utf-8")
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    done = subprocess.run(
        [sys.executable, "script.py"],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
    )
    return done.returncode, done.stdout, done.stderr


@pytest.mark.process
def test_a_script_without_a_guard_may_run_many_processes(tmp_path: Path) -> None:
    status, printed, errors = script(tmp_path, "run(processes=True, traffic={'warmup_s': 5}")
    assert status == 0, errors
    assert printed.splitlines()[0] == "once"
    assert printed.count("once") == 1


@pytest.mark.process
def test_a_study_of_several_jobs_names_the_guard(tmp_path: Path) -> None:
    what = "{'name': 'a', 'axes': {'traffic.cav_rate': [0, 0.1]}, 'seeds': [1]}"
    status, _, errors = script(tmp_path, f"study({what}, jobs=2, traffic={{'warmup_s': 5}}")
    assert status == 1
    assert "jobs is 2: no process of them could be started" in errors.splitlines()[-1]
    assert errors.splitlines()[-1].count('`if __name__ == "__main__":`') == 1
    assert len(errors.splitlines()) < 40


@pytest.mark.process
@pytest.mark.parametrize("arguments", [["--help"], ["runs"], ["run", "test"]])
def test_setup_makes_nothing_of_an_unknown_argument(arguments, tmp_path: Path) -> None:
    venv = tmp_path / "venv"
    command = [str(ROOT / "scripts" / "setup"), *arguments]
    environment = os.environ | {"CPNET_VENV": str(venv)}
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=TIMEOUT_S
    )
    assert (done.returncode, done.stderr) == (2, "usage: scripts/setup [run | test]\n")
    assert not venv.exists()


@pytest.mark.process
def test_a_run_of_many_processes_gives_the_same_rows(run, tmp_path: Path) -> None:
    with cpnet.run(SMALL, seed=3, processes=True, out=tmp_path / "many") as many:
        assert many.detections.equals(run.detections)
