"""Boxes of a run as files of KITTI's form and as a table."""

import numpy as np
import pytest

from learning.kitti import into_map
from perception.detector import LIDAR
from protocol.errors import ConfigError
from protocol.geometry import SE3
from recording.tables import DetectionRow
from studies import box_files
from tests.studies.tracked_runs import make_run

BOXES = np.array([[5, 2, -1, 4.5, 1.8, 1.5, 0.3], [-9, 4, 0.2, 9, 2.5, 3.2, 3.0]])


def test_a_box_that_coasts_was_not_found(tmp_path):
    make_run(tmp_path)  # 20 of its 40 frames coast
    assert box_files.count_boxes(tmp_path) == 20


@pytest.fixture
def found(monkeypatch):
    """Has a run of two frames with a box in each."""
    rows = [
        DetectionRow(n, "r0", 0, *box[:6], box[6], 0.5 + n / 4, n, "lane", 1.0, LIDAR)
        for n, box in enumerate(BOXES.tolist())
    ]
    monkeypatch.setattr(box_files, "_rows_of", lambda run_dir: rows)
    return rows


POSES = np.array([[1, 1, 2, 0, 0, 0.5], [2, 1, 2, 0, 0, 1.0]])


def box_of(words: list[str]) -> np.ndarray:
    """Returns the box in the sensor frame of KITTI's 15 fields and the score."""
    height, width, length, right, down, ahead, around = map(float, words[8:15])
    return np.array([ahead, -right, height / 2 - down, length, width, height, -around - np.pi / 2])


def test_labels_are_boxes_in_the_sensors_frame(tmp_path, found):
    assert box_files.write_boxes(tmp_path, tmp_path / "labels", POSES) == 2
    for number, name in enumerate(("Car", "Truck")):
        words = (tmp_path / "labels" / f"{number:06d}.txt").read_text().split()
        assert (words[0], float(words[15])) == (name, 0.5 + number / 4)
        back = into_map(box_of(words)[None], SE3.from_pose(POSES[number]))[0]
        assert np.allclose(back[:6], BOXES[number, :6], atol=2e-3)
        assert np.cos(back[6] - BOXES[number, 6]) == pytest.approx(1)


def test_one_file_of_labels_has_the_frame_before_each(tmp_path, found):
    box_files.write_boxes(tmp_path, tmp_path / "all.txt", POSES)
    lines = (tmp_path / "all.txt").read_text().splitlines()
    assert [line.split()[:3] for line in lines] == [["0", "-1", "Car"], ["1", "-1", "Truck"]]


def test_a_table_has_the_boxes_in_the_map_frame(tmp_path, found):
    pl = pytest.importorskip("polars", reason="needs the extra `study`")
    box_files.write_boxes(tmp_path, tmp_path / "all.parquet", POSES)
    table = pl.read_parquet(tmp_path / "all.parquet")
    assert table["object_class"].to_list() == ["car", "truck"]
    assert table["frame"].to_list() == [0, 1]
    assert np.allclose(table.select("x_m", "y_m", "z_m").to_numpy(), BOXES[:, :3])


@pytest.mark.parametrize(
    ("name", "error_text"),
    [
        ("a.csv", r"ends in \.csv; allowed are \.parquet, \.txt"),
        ("none/a.txt", "the folder .*none does not exist"),
        ("full", "the folder is not empty"),
        ("full/x", "is there already, and is of another kind"),
    ],
)
def test_names_that_boxes_cannot_be_written_to_are_refused(tmp_path, name, error_text):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "x").write_text("")
    with pytest.raises(ConfigError, match=error_text):
        box_files.check_boxes(tmp_path / name)
