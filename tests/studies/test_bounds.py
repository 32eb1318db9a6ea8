"""What could have been seen: by points, by distance, and who reports itself."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from protocol.messages import Equipment
from recording.database import Database
from recording.run import Run
from recording.tables import MetaRow, SightingRow, TruthRow
from studies.ecvpr import VISIBLE_POINTS, PerceptionBounds
from tests.studies.straight_runs import write_setup

SCENARIO = {
    "roadside_mounts": [{"x_m": 0.0, "y_m": 0.0}],
    "lidar": {"vehicle": {"range": 30.0}, "roadside": {"range": 50.0}},
}


def vehicle(name: str, x_m: float, equipment: Equipment = Equipment.NONE) -> TruthRow:
    return TruthRow(0, name, "car", int(equipment), x_m, 0, 0, 0, 0, 0, 5.0, "in", 5.0)


@pytest.fixture
def run(tmp_path: Path):
    write_setup(tmp_path)
    database = Database(tmp_path)
    half = VISIBLE_POINTS // 2
    rows = [
        SightingRow(3, "rsu", json.dumps({"a": half, "b": VISIBLE_POINTS})),
        SightingRow(3, "cav", json.dumps({"a": VISIBLE_POINTS - half, "c": VISIBLE_POINTS - 1})),
        SightingRow(5, "rsu", json.dumps({"c": VISIBLE_POINTS})),
    ]
    database.add(SightingRow, rows)
    database.add(MetaRow, [MetaRow("scenario", json.dumps(SCENARIO))])
    database.close()
    with Run(tmp_path) as opened:
        yield opened


def test_points_of_all_agents_count_together(run):
    bounds = PerceptionBounds(run)
    assert bounds.visible(2, []) == set()
    assert bounds.visible(3, []) == {"a", "b"}
    assert bounds.visible(4, []) == set()
    assert bounds.visible(5, []) == {"c"}


def test_who_reports_itself_is_visible_and_in_range(run):
    reporting = [vehicle("cv", 900, Equipment.CV), vehicle("dark", 901)]
    assert PerceptionBounds(run).visible(0, reporting) == {"cv"}
    assert PerceptionBounds(run).in_range(reporting) == {"cv"}


def test_range_is_that_of_each_kind_of_lidar(run):
    vehicles = [
        vehicle("near the post", 49),
        vehicle("beyond", 51),
        vehicle("cav", 100, Equipment.CAV),
        vehicle("near the cav", 129),
        vehicle("far off", 131),
    ]
    assert PerceptionBounds(run).in_range(vehicles) == {"near the post", "cav", "near the cav"}
