"""Columns: a new schema version with every change, and each message's values where they belong."""

from pathlib import Path

import numpy as np

from protocol.messages import (
    AgentScore,
    Detections,
    Equipment,
    LaneCounts,
    Metrics,
    Scan,
    Sighting,
    SignalRequest,
    SignalState,
    Span,
    Trip,
    Trips,
    Truth,
)
from recording.database import Database
from recording.rows import (
    agent_score_rows,
    cloud_row,
    count_rows,
    detection_rows,
    phase_row,
    request_row,
    sighting_row,
    stage_rows,
    trip_rows,
    truth_rows,
)
from recording.run import Run
from recording.tables import (
    SCHEMA_DIGESTS,
    SCHEMA_VERSION,
    TABLES,
    AgentScoreRow,
    CloudRow,
    CountRow,
    DetectionRow,
    PhaseRow,
    RequestRow,
    SightingRow,
    StageRow,
    Table,
    TripRow,
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
    monkeypatch.setitem(TABLES, CountRow, Table("counts", WiderRow, 4, is_result=True))
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
        classes=np.zeros(1, np.uint8),
        lanes=["in_0"],
        distances_m=np.array([12.5], np.float32),
        sources=["lidar"],
        agents=["a"],
        track_ids=np.array([9]),
        speeds_mps=np.array([8.5], np.float32),
        coasted_s=np.array([0.75], np.float32),
        ages_s=np.array([3], np.float32),
        position_std_m=np.array([0.375], np.float32),
        speed_std_mps=np.array([0.625], np.float32),
    )
    (row,) = detection_rows(message, "r3")
    assert row._asdict() == {
        "frame": 7, "region": "r3", "detection": 0, "x_m": 1, "y_m": 2, "z_m": 3, "length_m": 4.5,
        "width_m": 1.75, "height_m": 1.5, "yaw_rad": 0.25, "score": 0.5, "object_class": 0,
        "lane": "in_0", "distance_m": 12.5, "source": "lidar", "track": 9, "speed_mps": 8.5,
        "coasted_s": 0.75, "position_std_m": 0.375, "speed_std_mps": 0.625,
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


def test_stationary_and_coasted_vehicles_are_no_count_of_all() -> None:
    message = LaneCounts.model_construct(
        frame=7,
        tls="J",
        upstream={"in_0": 5},
        stationary_upstream={"in_0": 2},
        downstream={"out_0": 3},
        stationary_downstream={},
        coasted_upstream={"in_0": 1},
        coasted_downstream={"out_0": 3},
    )
    assert list(count_rows(message)) == [
        CountRow(frame=7, tls="J", lane="in_0", side="upstream", vehicles=5, queued=2, coasted=1),
        CountRow(
            frame=7, tls="J", lane="out_0", side="downstream", vehicles=3, queued=0, coasted=3
        ),
    ]


def test_regions_and_signals_do_not_replace_each_others_rows(tmp_path) -> None:
    database = Database(tmp_path, "{}")
    box = (1, 2, 0.7, 4.4, 1.8, 1.5, 0, 1.0, 0, "in_0", 20, "lidar")
    found = [DetectionRow(7, region, 0, *box) for region in ("r0", "r1")]
    counts = [CountRow(7, tls, "in_0", "upstream", 1, 0) for tls in ("A", "B")]
    database.add(DetectionRow, found)
    database.add(CountRow, counts)
    database.close()
    with Run(tmp_path) as run:
        assert (list(run.rows(DetectionRow)), list(run.rows(CountRow))) == (found, counts)


def test_every_value_of_a_signal_state_stands_in_its_own_column() -> None:
    message = SignalState(
        frame=7, sim_time_ns=700, tls="j", state="GGr", stage="green", green="GGr", source="plan",
        earliest_change_ns=900,
    )  # fmt: skip
    assert phase_row(message) == PhaseRow(
        frame=7, tls="j", sim_time_ns=700, state="GGr", stage="green", green="GGr", source="plan"
    )


def test_every_value_of_a_signal_request_stands_in_its_own_column() -> None:
    message = SignalRequest(
        frame=7, sim_time_ns=700, tls="j", state="GGr", policy="max_pressure",
        pressures=[1.5, -2.0], unknown=["in_0", "in_1"], delay_sim_ns=30, not_before_ns=750,
    )  # fmt: skip
    assert request_row(message) == RequestRow(
        frame=7, tls="j", state="GGr", policy="max_pressure", pressures="[1.5, -2.0]",
        delay_sim_ns=30, unknown="in_0 in_1", wait_sim_ns=50,
    )  # fmt: skip


def test_points_of_a_sighting_stand_beside_their_vehicle() -> None:
    message = Sighting(frame=7, agent="a", vehicles=["x", "y"], points=np.array([3, 5], np.uint32))
    assert sighting_row(message) == SightingRow(7, "a", '{"x": 3, "y": 5}')


def test_every_value_of_a_trip_stands_in_its_own_column() -> None:
    message = Trips(
        frame=7,
        trips=[
            Trip(
                vehicle="a", equipment=Equipment.CAV, depart_s=1.5, arrive_s=61.5, time_loss_s=9.25,
                teleported=True, stops=3, co2_g=210.5,
            ),
            Trip(
                vehicle="b", equipment=Equipment.NONE, depart_s=2.5, arrive_s=None, time_loss_s=4.0
            ),
        ],
    )  # fmt: skip
    assert list(trip_rows(message)) == [
        TripRow("a", int(Equipment.CAV), 1.5, 61.5, 9.25, 1, 3, 210.5),
        TripRow("b", int(Equipment.NONE), 2.5, None, 4.0, 0, 0, 0.0),
    ]


def test_the_duration_of_a_stage_is_the_time_from_its_start_to_its_end() -> None:
    spans = [Span(stage="decode", agent="a", start_ns=100, end_ns=130)]
    message = Metrics(process="edge-r0", frame=7, sim_time_ns=700, spans=spans)
    assert list(stage_rows(message)) == [
        StageRow(
            frame=7, process="edge-r0", agent="a", stage="decode", start_ns=100, duration_ns=30
        )
    ]


def test_every_part_of_an_agents_score_stands_in_its_own_column() -> None:
    score = AgentScore(agent="a", score=0.5, trusted=True, motion=0.1, place=0.2, ground=0.3)
    other = AgentScore(agent="b", score=0.25, trusted=False)
    message = Metrics(process="edge-r0", frame=7, sim_time_ns=700, scores=[score, other])
    assert list(agent_score_rows(message)) == [
        AgentScoreRow(7, "r0", "a", 0.5, trusted=1, motion=0.1, place=0.2, ground=0.3),
        AgentScoreRow(7, "r0", "b", 0.25, trusted=0, motion=None, place=None, ground=None),
    ]


def test_every_value_of_a_cloud_stands_in_its_own_column() -> None:
    message = Scan(
        frame=7, sim_time_ns=700, agent="a", chunk=1, chunks=2, points=9,
        sensor_pose=np.array([1.0, 2, 3, 0.1, 0.2, 0.3]),
        sense_start_ns=1, sense_end_ns=2, encode_end_ns=3,
        payload=np.frombuffer(b"scan", np.uint8),
    )  # fmt: skip
    assert cloud_row(message, "r0") == CloudRow(
        frame=7, region="r0", agent="a", chunk=1, points=9,
        sensor_x_m=1, sensor_y_m=2, sensor_z_m=3,
        sensor_roll_rad=0.1, sensor_pitch_rad=0.2, sensor_yaw_rad=0.3, payload=b"scan",
    )  # fmt: skip
