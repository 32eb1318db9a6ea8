"""Whole runs in one process: policies, links, controllers, and what goes wrong."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from cpnet import scenario as scenarios
from protocol.errors import ConfigError
from recording.run import Run, differences
from recording.tables import CountRow, PhaseRow, TripRow
from studies.in_process import run_in_process
from studies.sweep.study_file import MEASURES, PART_MEASURES
from studies.sweep.worker import HISTOGRAM_BINS, measure

SMALL = {
    "lidar.vehicle.channels": 16,
    "lidar.roadside.channels": 16,
    "lidar.vehicle.points_per_second": 72_000,
    "lidar.roadside.points_per_second": 72_000,
    "processes.vehicle": 1,
    "frame_period_s": 1,
    "duration_s": 6,
    "traffic.warmup_s": 30,
}
BLIND = {"roadside_mounts": [], "traffic.cav_rate": 0, "traffic.cv_rate": 1}
EXACT = {f"pose.cv_{name}": 0 for name in ("position_std_m", "height_std_m", "heading_std_deg")}


def played(folder: Path, **settings: Any) -> Path:
    keys = {name.replace("__", "."): value for name, value in settings.items()}
    folder.mkdir()
    run_in_process(scenarios.load("t_junction", SMALL | keys).model_dump(mode="json"), folder)
    return folder


def test_the_same_seed_gives_the_same_rows_and_another_does_not(tmp_path):
    one, same = played(tmp_path / "a", seed=3), played(tmp_path / "b", seed=3)
    assert differences(one, same) == []
    assert differences(one, played(tmp_path / "c", seed=4))


def test_planned_uploads_over_virtual_links_end_well(tmp_path):
    settings = {"upload.policy": "reap", "upload.filters": ["foreground"], "link.profile": "5mbit"}
    row = measure(played(tmp_path / "a", **settings, traffic__cav_rate=0.1)).row
    assert row["frames"] == 6
    assert row["e_cvpr"] > 0.3
    assert row["e_cvpr"] <= row["visible_share"] <= row["in_range_share"] <= 1
    assert sum(row["e_cvpr_hist"]) == 6
    assert len(row["e_cvpr_hist"]) == HISTOGRAM_BINS


def test_junctions_and_regions_of_a_network_add_up_to_the_whole(tmp_path):
    city = {"traffic.network": "corridor", "regions": 2, "duration_s": 4, "traffic.warmup_s": 60}
    found = measure(played(tmp_path / "a", **city))
    assert {*found.junctions} == {"A0", "B0", "C0", "D0", "E0"}
    assert {row["region"] for row in found.junctions.values()} == {*found.regions} == {"r0", "r1"}
    whole = pytest.approx(found.row["uplink_mbps"])
    assert sum(row["mbps"] for row in found.junctions.values()) == whole
    assert sum(row["mbps"] for row in found.regions.values()) == whole
    shares = [row["e_cvpr"] for row in found.junctions.values()]
    assert min(shares) <= found.row["e_cvpr"] <= max(shares)
    assert {name for row in found.regions.values() for name in row} <= PART_MEASURES


def test_exact_reports_of_all_are_perfect_counts(tmp_path):
    row = measure(played(tmp_path / "a", **BLIND, **EXACT)).row
    assert row.keys() == MEASURES
    assert row["e_cvpr"] == 1
    assert row["count_error"] < 0.15  # where a vehicle changes lanes, its middle decides
    assert row["uplink_mbps"] is None or row["uplink_mbps"] == 0


def test_queued_vehicles_are_some_of_those_counted(tmp_path):
    settings = BLIND | EXACT | {"signal.weight": "queued", "duration_s": 20}
    with Run(played(tmp_path / "a", **settings)) as run:
        rows = list(run.rows(CountRow))
    assert all(row.queued <= row.vehicles for row in rows)
    assert 0 < sum(row.queued for row in rows) < sum(row.vehicles for row in rows)
    assert sum(row.queued for row in rows if row.side == "upstream") > 0


def test_sumos_own_control_shows_greens_between_yellows(tmp_path):
    settings = BLIND | {"cabinet.control": "actuated", "duration_s": 60}
    with Run(played(tmp_path / "a", **settings)) as run:
        phases = list(run.rows(PhaseRow))
        trips = list(run.rows(TripRow))
    assert {phase.source for phase in phases} == {"actuated"}
    assert {phase.stage for phase in phases} == {"green", "yellow", "all_red"}
    assert len({phase.green for phase in phases}) == 2
    assert trips


def test_what_cannot_be_played_is_said(tmp_path):
    with pytest.raises(ConfigError, match=r"missing\.net\.xml"):
        played(tmp_path / "a", traffic__net=str(tmp_path / "missing.net.xml"))
