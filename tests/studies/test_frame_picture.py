"""Pictures of recorded frames."""

import builtins
import sqlite3
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cpnet.cli import draw_command
from protocol.codec import encode_cloud
from protocol.errors import ConfigError
from protocol.messages import Setup, VehicleType
from protocol.scans import PointCloud
from protocol.wire import encode
from recording.database import Database
from recording.run import SETUP_NAME, Run
from recording.tables import CloudRow, CountRow, DetectionRow, FrameRow, PhaseRow, TruthRow
from studies.frame_picture import draw_frame
from studies.snapshot import load_snapshot
from tests.roads import WEST_TO_EAST

FRAME = 7


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    car = VehicleType(name="car", mesh="car", length_m=4.5, width_m=1.8, height_m=1.5)
    setup = Setup(
        scenario={"regions": {"r0": ["t"]}}, road_map=WEST_TO_EAST, vehicle_types=[car], meshes=[],
        mesh_vertices=np.zeros((0, 3)), mesh_triangles=np.zeros((0, 3)),
    )  # fmt: skip
    (tmp_path / SETUP_NAME).write_bytes(encode(setup))
    database = Database(tmp_path)
    points = (rng.uniform(-40, 40, (500, 3)) * [1, 1, 0.05]).astype(np.float32)
    payload = encode_cloud(PointCloud(points, np.zeros(500, np.float32)), 0.02)
    pose = (1.0, 2.0, 3.0, 0.0, 0.0, np.pi / 2)
    clouds = [CloudRow(FRAME, "r0", a, 0, 500, *pose, payload) for a in ("car-1", "rsu-0")]
    database.add(
        CloudRow, [*clouds, CloudRow(FRAME, "r0", "rsu-0", 1, 5, *pose, b"no scan at all")]
    )
    database.add(CloudRow, [CloudRow(2, "r0", "rsu-0", 0, 500, *pose, payload)])
    database.add(TruthRow, [TruthRow(FRAME, "car-1", "car", 1, -30, 0, 0, 0, 0, 0, 9, "west", 70)])
    database.add(
        DetectionRow,
        [
            DetectionRow(
                FRAME, "r0", 0, -30, 0, 0.7, 4.4, 1.8, 1.5, 0.01, 1.0, 0, "west", 20, "car-1"
            )
        ],
    )
    database.add(
        CountRow,
        [
            CountRow(FRAME, "t", "west", "upstream", 1, 0),
            CountRow(FRAME, "t", "east", "downstream", 0, 0),
        ],
    )
    database.add(PhaseRow, [PhaseRow(FRAME, "t", 7 * 10**8, "G", "green", "G", "plan")])
    database.add(FrameRow, [FrameRow(FRAME, 7 * 10**8, 1, 1, 0, 2, 1000, 1, 1, 0, 0, 50_000_000)])
    database.close()
    return tmp_path


def test_a_kept_frame_is_drawn_by_default(run_dir: Path) -> None:
    png = run_dir / "frame.png"
    draw_frame(run_dir, None, png)
    assert png.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert png.stat().st_size > 20_000


def test_of_the_kept_frames_the_fullest_is_chosen(run_dir: Path) -> None:
    """Frame 2, the first, has a cloud and no detection; a later one without any is no better."""
    with closing(sqlite3.connect(run_dir / "run.sqlite")) as database, database:
        database.execute("UPDATE clouds SET frame = 9 WHERE chunk = 1")
    with Run(run_dir) as run:
        assert load_snapshot(run, None).row.frame == FRAME


def test_a_frame_with_nothing_but_a_cloud_is_drawn(run_dir: Path) -> None:
    draw_frame(run_dir, 2, run_dir / "frame.png")
    assert (run_dir / "frame.png").is_file()


def test_a_snapshot_holds_the_frame_and_leaves_out_what_does_not_decode(run_dir: Path) -> None:
    with Run(run_dir) as run:
        snapshot = load_snapshot(run, FRAME)
    assert [cloud.agent for cloud in snapshot.clouds] == ["rsu-0", "car-1"]
    assert [len(cloud.points) for cloud in snapshot.clouds] == [500, 500]
    assert snapshot.clouds[0].sensor_m.tolist() == [1, 2, 3]
    assert np.ptp(snapshot.clouds[0].points[:, 0]) > 70
    assert (snapshot.score.present, snapshot.score.true) == (1, 1)
    assert snapshot.counts == {("west", "upstream"): 1, ("east", "downstream"): 0}
    assert snapshot.shown == {"t": "G"}


def test_a_frame_without_uploads_names_those_that_have_them(run_dir: Path) -> None:
    with pytest.raises(ConfigError, match="no uploads of frame 3; it has 2, 7"):
        draw_frame(run_dir, 3, run_dir / "frame.png")


def test_a_run_without_snapshots_says_why(tmp_path: Path) -> None:
    Database(tmp_path).close()
    with pytest.raises(ConfigError, match="snapshot_period_s"):
        draw_frame(tmp_path, None, tmp_path / "frame.png")


def test_missing_matplotlib_names_what_to_install(
    run_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real_import = builtins.__import__

    def refuse(name: str, *rest: Any) -> object:
        if name.startswith("matplotlib"):
            raise ModuleNotFoundError(f"No module named {name!r}", name="matplotlib")
        return real_import(name, *rest)

    for module in [m for m in sys.modules if m.startswith("studies.")]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(ConfigError, match="pip install 'matplotlib"):
        draw_command(run_dir)


def test_an_unwritable_picture_is_a_clear_error(run_dir: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be written"):
        draw_frame(run_dir, None, run_dir / "missing" / "frame.png")
