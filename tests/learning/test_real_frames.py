"""Real scans with labels in KITTI's layout become training samples on the ground around them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra `learn`")

from learning.examples import SURE_POINTS, example_of
from learning.kitti import line_of
from learning.real_frames import RealFrames
from learning.training import MixedSamples
from perception.pillars.config import PillarsConfig
from protocol.errors import ConfigError
from protocol.messages import ObjectClass

SENSOR_M = 1.8  # over the ground
CAR = np.array([10.0, 5.0, 0.75 - SENSOR_M, 4.4, 1.8, 1.5, 0.3])
UNSURE = np.array([-10.0, 5.0, 0.75 - SENSOR_M, 4.4, 1.8, 1.5, 0.0])
RANGE_M = 30.0


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """One frame, level ground with a car and something that may be one; points beyond the range."""
    rng = np.random.default_rng(1)
    ground = np.column_stack([rng.uniform(-45, 45, (40_000, 2)), np.full(40_000, -SENSOR_M)])
    things = [box[:3] + rng.uniform(-0.7, 0.7, (200, 3)) for box in (CAR, UNSURE)]
    for part in ("velodyne", "label_2"):
        (tmp_path / part).mkdir()
    points = np.concatenate([ground, *things]).astype(np.float32)
    np.save(tmp_path / "velodyne" / "one.npy", points)
    lines = [line_of(box, ObjectClass.CAR) for box in (CAR, UNSURE)]
    lines[1] = lines[1].replace("Car", "DontCare", 1)
    (tmp_path / "label_2" / "one.txt").write_text("\n".join(lines) + "\n")
    return tmp_path


def test_objects_stand_on_the_ground_and_nothing_beyond_the_range_is_left(folder: Path) -> None:
    (sample,) = RealFrames(folder, RANGE_M, 0.3).samples().values()
    (points,), (height_m,) = sample.points, sample.height_m
    assert np.hypot(*points[:, :2].T).max() <= RANGE_M
    is_ground = points[:, 2] == np.float32(-SENSOR_M)
    assert np.abs(height_m[is_ground]).max() < 0.05
    np.testing.assert_allclose(sample.boxes[:, 2], 0.75)
    np.testing.assert_allclose(sample.boxes[:, [0, 1, 3, 4, 5, 6]], [
        CAR[[0, 1, 3, 4, 5, 6]], UNSURE[[0, 1, 3, 4, 5, 6]]
    ], atol=1e-3)  # fmt: skip
    assert (sample.points_on >= SURE_POINTS).tolist() == [[True, False]]


def test_what_may_be_a_vehicle_is_not_judged(folder: Path) -> None:
    (sample,) = RealFrames(folder, RANGE_M, 0.3).samples().values()
    rng = np.random.default_rng(2)
    examples = [example_of(sample, 320, PillarsConfig(), rng) for _ in range(8)]
    for example in examples:
        judged = example.targets.counts
        assert 0 < example.targets.is_vehicle.sum() < 100
        assert (~judged).any(), "anchors on the box DontCare"
        assert len(example.targets.place) == example.targets.is_vehicle.sum()


@pytest.mark.parametrize(
    ("share", "made", "scans"), [(0.5, 100, 3), (0.25, 100, 3), (0.75, 100, 3), (0.1, 10, 70)]
)
def test_all_samples_are_drawn_real_ones_by_their_share(
    share: float, made: int, scans: int
) -> None:
    real = [-1 - number for number in range(scans)]
    mixed = MixedSamples(range(made), real, share)  # type: ignore[arg-type]
    drawn = np.array([mixed[index] for index in range(len(mixed))])
    assert set(drawn) == {*range(made), *real}
    assert np.mean(drawn < 0) == pytest.approx(share, abs=0.002)
    times = np.bincount(drawn[drawn >= 0])
    assert times.min() == times.max()


KITTI_CALIB = """P2: 700 0 600 0 0 700 180 0 0 0 1 0
R0_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0
"""


def test_with_a_camera_only_its_image_is_taken_and_not_its_regions_dont_care(folder: Path) -> None:
    (folder / "calib").mkdir()
    (folder / "calib" / "one.txt").write_text(KITTI_CALIB)
    labels = folder / "label_2" / "one.txt"
    region = "DontCare -1 -1 -10 0 150 300 400 -1 -1 -1 -1000 -1000 -1000 -10"
    labels.write_text(labels.read_text() + region + "\n")
    (sample,) = RealFrames(folder, RANGE_M, 0.3).samples().values()
    x, y, z = sample.points[0].T
    column, row = 600 - 700 * y / x, 180 - 700 * z / x
    assert len(x) > 100
    assert x.min() > 0
    assert 0 <= column.min() < column.max() <= 1200
    assert 0 <= row.min() < row.max() <= 360
    assert not ((column < 300) & (row > 150)).any()


@pytest.mark.parametrize(
    ("range_m", "share", "named"),
    [(30, 1.0, "--real-share"), (30, 0, "--real-share"), (0, 0.2, "--real-range")],
)
def test_a_number_out_of_bounds_is_named(
    folder: Path, range_m: float, share: float, named: str
) -> None:
    with pytest.raises(ConfigError, match=named):
        RealFrames(folder, range_m, share).check()


def test_a_folder_without_clouds_is_refused(tmp_path: Path) -> None:
    for part in ("velodyne", "label_2"):
        (tmp_path / part).mkdir()
    with pytest.raises(ConfigError, match=str(tmp_path)):
        RealFrames(tmp_path, RANGE_M, 0.3).samples()


def test_frames_without_points_and_two_of_one_name_are_refused(folder: Path) -> None:
    with pytest.raises(ConfigError, match=r"one\.npy: no point within 0\.001 m"):
        RealFrames(folder, 1e-3, 0.3).samples()
    cloud = folder / "velodyne" / "one.npy"
    cloud.with_name("one.more.npy").write_bytes(cloud.read_bytes())
    with pytest.raises(ConfigError, match="another cloud is called one"):
        RealFrames(folder, RANGE_M, 0.3).samples()
