"""A run whose one car is tracked."""

import json
from pathlib import Path

from recording.database import Database
from recording.tables import DetectionRow, FrameRow, MetaRow, TruthRow
from tests.studies.straight_runs import write_setup

MS = 1_000_000
SIZE = (4.0, 2.0, 1.5)


def make_run(run_dir: Path, *, track: int = 5, frames: int = 40) -> None:
    """A car at 10 m/s towards the stop bar, seen all the time but for 20 frames of coasting."""
    write_setup(run_dir)
    database = Database(run_dir)
    scenario = {
        "frame_period_s": 0.1,
        "lidar": {"roadside": {"range": 200}},
        "roadside_mounts": [{"id": "rsu", "x_m": 0, "y_m": 0}],
    }
    database.add(MetaRow, [("scenario", json.dumps(scenario))])
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
