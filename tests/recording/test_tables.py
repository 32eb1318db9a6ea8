"""Columns: a new schema version with every change, and each message's values where they belong."""

from pathlib import Path

import numpy as np

from protocol.messages import Detections, LaneCounts, Truth
from recording.rows import count_rows, detection_rows, truth_rows
from recording.tables import (
    SCHEMA_DIGESTS,
    SCHEMA_VERSION,
    TABLES,
    CountRow,
    DetectionRow,
    Table,
    TruthRow,
    schema_digest,
)

DOCS = Path(__file__).parents[2] / "docs" / "running.md"


def test_a_change_of_columns_needs_a_new_schema_version() -> None:
    assert SCHEMA_DIGESTS[SCHEMA_VERSION] == schema_digest(), (
        f"the columns have changed: add {SCHEMA_VERSION + 1}: {schema_digest()!r} to SCHEMA_DIGESTS"
    )


def test_a_column_more_changes_the_digest(monkeypatch) -> None:
    class WiderRow(CountRow):
        _fields = (*CountRow._fields, "more")
        more: int

    before = schema_digest()
    monkeypatch.setitem(TABLES, CountRow, Table("counts", WiderRow, 3, is_result=True))
    assert schema_digest() != before


def test_the_docs_name_every_table() -> None:
    (line,) = [line for line in DOCS.read_text("utf-8").splitlines() if "| `run.sqlite` |" in line]
    assert {table.name for table in TABLES.values()} <= set(line.split("`"))


def test_every_value_of_a_detection_stands_in_its_own_column() -> None:
    message = Detections(
        frame=7,
        sim_time_ns=1,
        boxes=np.array([[1, 2, 3, 4.5, 1.75, 1.5, 0.25]], np.float32),
        scores=np.array([0.5], np.float32),
        lanes=["in_0"],
        distances_m=np.array([12.5], np.float32),
        sources=["lidar"],
        agents=["a"],
    )
    (row,) = detection_rows(message)
    assert row._asdict() == {
        "frame": 7, "detection": 0, "x_m": 1, "y_m": 2, "z_m": 3, "length_m": 4.5, "width_m": 1.75,
        "height_m": 1.5, "yaw_rad": 0.25, "score": 0.5, "lane": "in_0", "distance_m": 12.5,
        "source": "lidar",
    }  # fmt: skip
    assert row == DetectionRow(*row)


def test_every_value_of_a_true_vehicle_stands_in_its_own_column() -> None:
    message = Truth(
        frame=7,
        sim_time_ns=1,
        ids=["a"],
        types=["car"],
        poses=np.array([[1.0, 2, 3, 0.1, 0.2, 0.3]]),
        speeds_mps=np.array([8.5], np.float32),
        equipment=np.array([2], np.uint8),
        lanes=["in_0"],
        lane_positions_m=np.array([40.5], np.float32),
    )
    assert list(truth_rows(message)) == [
        TruthRow(
            frame=7, vehicle="a", type="car", equipment=2, x_m=1, y_m=2, z_m=3, roll_rad=0.1,
            pitch_rad=0.2, yaw_rad=0.3, speed_mps=8.5, lane="in_0", lane_position_m=40.5,
        )
    ]  # fmt: skip


def test_stationary_vehicles_are_no_count_of_all() -> None:
    message = LaneCounts.model_construct(
        frame=7,
        upstream={"in_0": 5},
        stationary_upstream={"in_0": 2},
        downstream={"out_0": 3},
        stationary_downstream={},
    )
    assert list(count_rows(message)) == [
        CountRow(frame=7, lane="in_0", side="upstream", vehicles=5, queued=2),
        CountRow(frame=7, lane="out_0", side="downstream", vehicles=3, queued=0),
    ]
