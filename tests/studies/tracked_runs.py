"""A run whose one car is tracked."""

import json
from pathlib import Path

from recording.database import Database
from recording.tables import DetectionRow, FrameRow, MetaRow, PhaseRow, SightingRow, TruthRow
from studies.ecvpr import VISIBLE_POINTS
from tests.studies.straight_runs import write_setup

MS = 1_000_000
SIZE = (4.0, 2.0, 1.5)


def make_run(run_dir: Path, *, track: int = 5, frames: int = 40) -> None:
    """A car at 10 m/s towards the stop bar, seen all the time but for 20 frames of coasting.

    Enough points for a sighting lie on it in its tenth frame alone.
    """
    write_setup(run_dir)
    database = Database(run_dir)
    scenario = {
        "frame_period_s": 0.1,
        "lidar": {"roadside": {"range": 200}},
        "roadside_mounts": [{"id": "rsu", "x_m": 0, "y_m": 0}],
    }
    database.add(MetaRow, [("scenario", json.dumps(scenario))])
    database.add(SightingRow, [SightingRow(10, "rsu", json.dumps({"a": VISIBLE_POINTS}))])
    for n in range(frames):
        x_m = -100.0 + n
        database.add(FrameRow, [FrameRow(n, n * 100 * MS, 1, 0, 0, 1, 9, 1, 1, 0, 0, 0)])
        body = (x_m, 0, 0, 0, 0, 0, 10.0, "in", x_m + 155)
        database.add(TruthRow, [TruthRow(n, "a", "car", 0, *body)])
        coasted_s = 0.1 * (n - 9) if 10 <= n < 30 else 0.0
        off_m = 5.0 if coasted_s > 1.0 else 0.0
        place = (x_m + off_m, 0.0, 0.75, *SIZE, 0.0)
        known = (track, 10.5, coasted_s)
        row = DetectionRow(n, "r0", 0, *place, 0.9, 0, "in", -x_m, "lidar", *known)
        database.add(DetectionRow, [row])
    database.close()


def make_queue_run(run_dir: Path) -> None:
    """Seven cars stand 7 m apart until their light turns green at 10 s, then cross every 2 s.

    One more green begins at 30 s; another car passes in between.
    """
    write_setup(run_dir)
    database = Database(run_dir)
    database.add(MetaRow, [("scenario", '{"frame_period_s": 0.5}')])
    for n in range(90):
        at_s = n / 2
        database.add(FrameRow, [FrameRow(n, n * 500 * MS, 7, 0, 0, 1, 9, 7, 1, 0, 0, 0)])
        state = "G" if 10 <= at_s < 28 or at_s >= 30 else "r"
        stage = "green" if state == "G" else "all_red"
        database.add(PhaseRow, [PhaseRow(n, "j", n * 500 * MS, state, stage, "G", "fixed")])
        cars = []
        for k in range(7):
            cross_s, left_m = 12 + 2 * k, 2 + 7 * k
            is_off = at_s > 10
            distance_m = left_m * (cross_s - at_s) / (cross_s - 10) if is_off else left_m
            cars.append((k + 1, distance_m, 5.0 if is_off else 0.0))
        cars.append((8, 130.0 - 10 * (at_s - 14), 10.0))
        rows = [
            DetectionRow(
                n, "r0", track, -5 - away_m, 0, 0.75, *SIZE, 0.0, 0.9, 0,
                "in" if away_m >= 0 else "out", away_m, "lidar", track, speed_mps, 0.0,
            )
            for track, away_m, speed_mps in cars
            if -80 <= away_m <= 150
        ]  # fmt: skip
        database.add(DetectionRow, rows)
    database.close()
