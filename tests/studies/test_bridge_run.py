"""A run on a net where a road passes over another: both are seen as if the other were not there."""

from __future__ import annotations

from pathlib import Path

import pytest

from cpnet import scenario as scenarios
from recording.run import Run
from recording.tables import TruthRow
from studies.in_process import run_in_process
from studies.summary import agent_scores
from studies.sweep.worker import measure
from tests.bridges import ACROSS_M, write_bridge

HIGH_M = 7.0
LIDAR = {"channels": 32, "points_per_second": 576_000}
KEYS = {
    **{
        f"lidar.{who}.{key}": value
        for who in ("vehicle", "roadside")
        for key, value in LIDAR.items()
    },
    "processes.vehicle": 1,
    "frame_period_s": 1,
    "duration_s": 25,
    "traffic.warmup_s": 60,
    "traffic.cav_rate": 0.3,
    "junctions": "all",
}


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bridge")
    keys = KEYS | {"traffic.net": str(write_bridge(folder, HIGH_M))}
    run_dir = folder / "run"
    run_dir.mkdir()
    run_in_process(scenarios.load("t_junction", keys).model_dump(mode="json"), run_dir)
    return run_dir


def test_agents_on_a_bridge_and_below_it_are_trusted(run_dir: Path) -> None:
    with Run(run_dir) as run:
        truth, lowered = list(run.rows(TruthRow)), agent_scores(run)
    near = [
        row for row in truth if row.equipment and abs(row.x_m - ACROSS_M) < 8 and abs(row.y_m) < 8
    ]
    assert {round(row.z_m / HIGH_M) for row in near} == {0, 1}
    assert lowered == {}


def test_vehicles_on_a_bridge_and_below_it_are_found(run_dir: Path) -> None:
    row = measure(run_dir).row
    assert row["e_cvpr"] > 0.9
    assert row["e_cvpr"] > row["visible_share"] - 0.015
