"""A package with a plug-in of each kind is installed and used by name."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from cpnet import scenario as scenarios
from cpnet.evaluation import detectors_of
from edge_server.config import check_fusion
from perception.registry import check
from protocol.errors import ConfigError
from recording.run import Run
from recording.tables import DetectionRow, RequestRow, UploadRow
from studies.in_process import run_in_process
from studies.sweep.worker import measure
from tests.cpnet.commands import Shell
from tests.example_plugins import install, pretend

SMALL = {
    "lidar.vehicle.channels": 16,
    "lidar.roadside.channels": 16,
    "lidar.vehicle.points_per_second": 72_000,
    "lidar.roadside.points_per_second": 72_000,
    "processes.vehicle": 1,
    "frame_period_s": 1,
    "duration_s": 6,
    "traffic.warmup_s": 30,
    "traffic.cav_rate": 0.1,
}
BY_NAME = {
    "edge.detector": "grid",
    "upload.policy": "near-first",
    "edge.fusion.rule": "sure-ones",
    "signal.policy": "longest-queue",
}


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return install(tmp_path_factory.mktemp("packages"))


@pytest.fixture
def installed(packages: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.syspath_prepend(packages)
    return packages


def played(folder: Path, **settings: Any) -> Path:
    folder.mkdir()
    run_in_process(scenarios.load("t_junction", SMALL | settings).model_dump(mode="json"), folder)
    return folder


def test_all_kinds_by_name_in_one_run(installed, tmp_path) -> None:
    run_dir = played(tmp_path / "a", **BY_NAME, **{"upload.plugin.near_m": 25})
    assert measure(run_dir).row["e_cvpr"] > 0.2
    with Run(run_dir) as run:
        assert {row.policy for row in run.rows(RequestRow)} == {"longest-queue"}
        points = {0: 0, 1: 0}
        for upload in run.rows(UploadRow):
            points[upload.chunk] += upload.points
    assert min(points.values()) > 0


def test_settings_reach_the_detector(installed, tmp_path) -> None:
    none = played(tmp_path / "a", **BY_NAME, **{"edge.plugin.least_points": 10**6})
    with Run(none) as run:
        assert not [row for row in run.rows(DetectionRow) if row.source == "lidar"]


@pytest.mark.parametrize(
    ("settings", "error_text"),
    [
        ({"edge.plugin.side_m": 3}, r"detector grid of cpnet-example 0\.1\.0 .*\n?.*side_m"),
        ({"edge.fusion.plugin.least_score": 2}, r"fusion sure-ones of .*least_score is 2"),
        ({"upload.plugin.near_m": -1}, r"policy near-first of cpnet-example 0\.1\.0 .*near_m is"),
    ],
)
def test_settings_that_cannot_be_name_the_package(
    installed, tmp_path, settings, error_text
) -> None:
    with pytest.raises(ConfigError, match=error_text):
        played(tmp_path / "a", **BY_NAME, **settings)


@pytest.mark.parametrize("key", BY_NAME)
def test_a_name_that_is_not_installed_is_refused_with_those_that_are(installed, key) -> None:
    with pytest.raises(ConfigError) as caught:
        scenarios.load("t_junction", {key: "nobody"})
    for part in (key, "must be one of", BY_NAME[key], "cpnet-example 0.1.0", "got 'nobody'"):
        assert part in str(caught.value)


def test_detectors_are_measured_by_the_same_names(installed) -> None:
    assert detectors_of("grid,fast") == ("fast", "grid")
    with pytest.raises(ConfigError, match=r"'gird': must be one of fast, .* grid \(cpnet-example"):
        detectors_of("gird")


BAD = """
import numpy as np
from signal_controller.policies import Decision
from sensing.upload_policies import Policy

class Sees:
    def __init__(self, *_): pass
    def detect(self, cloud, rng, stage=None): return np.zeros((0, 7))

class Chooses:
    def __init__(self, *_): pass
    def choose(self, scan, map_SE3_sensor): return np.full(scan.range_m.shape, 2, np.uint8)

class Fuses:
    def __init__(self, *_): pass
    def fuse(self, found, poses): return found.boxes

class Decides:
    def __init__(self, *_): pass
    def decide(self, observation): return Decision("GG", [], "bad")

CHOICE = Policy("bad", chooser=Chooses)
"""


@pytest.fixture
def bad(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    points = {
        "cpnet.detectors": {"bad": "cpnet_test_bad:Sees"},
        "cpnet.upload_policies": {"bad": "cpnet_test_bad:CHOICE", "none": "cpnet_test_bad:Sees"},
        "cpnet.fusions": {"bad": "cpnet_test_bad:Fuses", "lost": "cpnet_test_lost:X"},
        "cpnet.signal_policies": {"bad": "cpnet_test_bad:Decides", "lost": "cpnet_test_lost:X"},
    }
    pretend(tmp_path / "bad", "bad-package", points, cpnet_test_bad=BAD)
    monkeypatch.syspath_prepend(tmp_path / "bad")


@pytest.mark.parametrize(
    ("key", "error_text"),
    [
        ("edge.detector", "found a ndarray, must find Vehicles"),
        ("edge.fusion.rule", "found a ndarray, must find Vehicles"),
        ("upload.policy", "chose chunk 2: it has 0 to 0, 255 is not sent"),
        ("signal.policy", "decided 'GG', must be a G, g or r for each of"),
    ],
)
def test_what_a_plugin_returns_is_looked_at(bad, tmp_path, key, error_text) -> None:
    with pytest.raises(ConfigError, match=rf"bad of bad-package 1\.0 {error_text}"):
        played(tmp_path / "a", **{key: "bad"})


def test_an_upload_policy_must_be_one(bad) -> None:
    with pytest.raises(ConfigError, match=r"none of bad-package 1\.0 is a type, must be a Policy"):
        scenarios.load("t_junction", {"upload.policy": "none"})


def test_a_plugin_that_cannot_be_imported_stops_before_the_start(bad, installed) -> None:
    check(scenarios.load("t_junction", {"edge.detector": "grid"}).edge)
    from signal_controller.config import check_policy

    with pytest.raises(ConfigError, match=r"lost of bad-package 1\.0 cannot be imported"):
        check_policy(scenarios.load("t_junction", {"signal.policy": "lost"}).signal)
    with pytest.raises(ConfigError, match=r"fusion lost of bad-package 1\.0 cannot be imported"):
        check_fusion(scenarios.load("t_junction", {"edge.fusion.rule": "lost"}).edge.fusion)


def test_a_part_of_a_program_that_has_ended_is_named_but_cannot_be_had() -> None:
    config = scenarios.load("t_junction", {"edge.detector": "own:squares"}).edge
    with pytest.raises(ConfigError, match="'own:squares' was a part of the program that ran this"):
        check(config)


def test_every_process_finds_plugins(packages: Path, shell: Shell, monkeypatch) -> None:
    path = os.pathsep.join(filter(None, [str(packages), os.environ.get("PYTHONPATH")]))
    monkeypatch.setenv("PYTHONPATH", path)
    names = [f"--set={key}={name}" for key, name in BY_NAME.items()]
    status, output = shell.up("--duration", "3", "--out", "run", *names, fresh=True).finish()
    assert status == 0, output
    with Run(shell.folder / "run") as run:
        assert {row.policy for row in run.rows(RequestRow)} == {"longest-queue"}
