"""The bench of misbehaviour detection (`scripts/misbehaviour`) on a short run."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from cpnet import scenario as scenarios
from studies.in_process import run_in_process
from tests.misbehaviour.attacks import GHOST, Displaced, Emptied, GhostReport, Peopled, Replayed
from tests.misbehaviour.bench import HONEST, RecordedRun, attacks_on, print_misbehaviour
from tests.misbehaviour.honest import KINDS, honest_run

pytestmark = pytest.mark.slow

SHORT = {
    "duration_s": 12,
    "traffic.cav_rate": 0.1,
    "traffic.warmup_s": 30,
    "record.snapshot_period_s": 0.2,
    "frame_period_s": 0.2,
    "lidar.vehicle.points_per_second": 144_000,
    "lidar.roadside.points_per_second": 144_000,
    "lidar.vehicle.channels": 32,
    "lidar.roadside.channels": 32,
}


@pytest.fixture(scope="module")
def recorded_run(tmp_path_factory: pytest.TempPathFactory) -> RecordedRun:
    folder = tmp_path_factory.mktemp("run")
    run_in_process(scenarios.load("t_junction", SHORT).model_dump(mode="json"), folder)
    return RecordedRun(folder)


def test_honest_agents_are_never_left_out_and_a_jump_is_seen_at_once(recorded_run: RecordedRun):
    honest = recorded_run.honest()
    assert (honest.attack, honest.others_s) == (HONEST, 0)
    assert honest.hours > 0
    jump = recorded_run.tried(
        "jumps 10 m along", attacks_on(recorded_run.road_map, 0.2)["jumps 10 m along"]
    )
    assert jump.found == jump.tried > 0
    assert jump.after_s is not None
    assert jump.after_s < 1
    printed = io.StringIO()
    print_misbehaviour([honest, jump], Console(file=printed, width=60))
    assert "the truth" in printed.getvalue()
    assert set(jump.as_json()) >= {"cav_rate", "attack", "tried", "found", "after_s"}


def test_an_attack_changes_what_its_victim_says_and_nothing_else(recorded_run: RecordedRun):
    frame = recorded_run.frames[20]
    victim = next(p.agent for p in frame.chunks if p.agent != "rsu-0")
    replay = Replayed(1)
    replay.apply(recorded_run.frames[19], victim)
    for attack in (Displaced(up_m=1.0), Emptied(), Peopled(recorded_run.road_map, 2), replay):
        changed = attack.apply(frame, victim)
        others = [p for p in changed.chunks if p.agent != victim]
        before = [p for p in frame.chunks if p.agent != victim]
        assert all(a is b for a, b in zip(others, before, strict=True))
        (own,) = [p for p in changed.chunks if p.agent == victim]
        (was,) = [p for p in frame.chunks if p.agent == victim]
        differs = not np.array_equal(own.points, was.points)
        assert differs or not np.array_equal(own.sensor_pose, was.sensor_pose)
    ghost = GhostReport(recorded_run.road_map, 0.5).apply(frame, "rsu-0")
    assert set(ghost.agents) - set(frame.agents) == {GHOST}


def test_a_run_that_kept_no_scan_has_no_frames(tmp_path: Path):
    keys = SHORT | {"duration_s": 1, "record.snapshot_period_s": 0}
    run_in_process(scenarios.load("t_junction", keys).model_dump(mode="json"), tmp_path)
    assert RecordedRun(tmp_path).frames == []


@pytest.mark.parametrize("number", range(len(KINDS)), ids=KINDS)
def test_on_other_nets_honest_agents_are_never_left_out_either(number: int):
    sparse = {key: value for key, value in SHORT.items() if key.startswith("lidar.")}
    keys = sparse | {"duration_s": 30, "frame_period_s": 1, "traffic.cav_rate": 0.2}
    row = honest_run(1, number, keys | {"processes.vehicle": 1, "traffic.warmup_s": 60})
    assert row.net == KINDS[number]
    assert row.agents > 5
    assert (row.beyond_map > 0) == (row.net == "town")
    assert (row.excluded, row.reasons) == (0, {})
