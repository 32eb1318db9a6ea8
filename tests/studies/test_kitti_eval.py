"""Detectors on files with labels in KITTI's form; clouds and labels are of our own making."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from cpnet.cli import app
from edge_server.config import EdgeConfig
from learning.kitti import line_of
from learning.kitti_object import Calibration, kitti_frames
from protocol.errors import ConfigError
from protocol.geometry import SE3
from protocol.messages import ObjectClass
from studies.kitti_eval import evaluate_kitti
from tests import places

AHEAD, BESIDE, BEHIND = (12.0, 3.0, 0.1), (14.0, -5.0, 0.0), (-9.0, 4.0, 0.0)
HEIGHT_M = 1.73
CALIB = (
    "P2: 700 0 600 45 0 700 180 -0.3 0 0 1 0.005\n"
    "R0_rect: 1 0 0 0 1 0 0 0 1\n"
    "Tr_velo_to_cam: 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27\n"
)


def box(car):
    x, y, yaw = car
    return np.array([x, y, places.CAR_M[2] / 2 - HEIGHT_M, *places.CAR_M, yaw])


def frame(folder, cars, lines, calib=None):
    """Writes a frame 000007 with cars on level ground, and its labels."""
    points = places.seen(places.scene(cars, walls=False), SE3.from_pose([0, 0, HEIGHT_M, 0, 0, 0]))
    places.write_bin(folder / "velodyne" / "000007.bin", points)
    (folder / "label_2").mkdir(exist_ok=True)
    (folder / "label_2" / "000007.txt").write_text("\n".join(lines) + "\n")
    if calib is not None:
        (folder / "calib").mkdir(exist_ok=True)
        (folder / "calib" / "000007.txt").write_text(calib)


def label(car, kind="Car", **fields):
    """Returns a label's line in the LiDAR's frame, with some of its fields changed by number."""
    words = line_of(box(car), ObjectClass.CAR).split()
    words[0] = kind
    for name, value in fields.items():
        words[{"truncated": 1, "occluded": 2}[name]] = str(value)
    return " ".join(words)


def rows(folder, range_m=50.0, **wanted):
    wanted = {"view": "bev", "iou": 0.5, "part": "all", "truth": "all", "objects": "car"} | wanted
    found = evaluate_kitti(kitti_frames(folder), ["fast"], EdgeConfig(), range_m)
    (row,) = [
        row for row in found if all(getattr(row, name) == value for name, value in wanted.items())
    ]
    return row.vehicles, row.recall, row.precision


def test_cars_that_are_labelled_are_found_and_others_are_wrong(tmp_path):
    frame(tmp_path, [AHEAD, BESIDE, BEHIND], [label(AHEAD), label(BESIDE)])
    assert rows(tmp_path) == (2, 1.0, 2 / 3)
    assert rows(tmp_path, view="3d", iou=0.3) == (2, 1.0, 2 / 3)


def test_vans_and_what_nobody_cares_for_are_neither_right_nor_wrong(tmp_path):
    labels = [label(AHEAD), label(BESIDE, "Van"), label(BEHIND, "DontCare")]
    frame(tmp_path, [AHEAD, BESIDE, BEHIND], labels)
    assert rows(tmp_path) == (1, 1.0, 1.0)
    assert rows(tmp_path, objects="vehicle") == (2, 1.0, 1.0)


def test_what_is_harder_or_beyond_the_range_need_not_be_found(tmp_path):
    labels = [label(AHEAD), label(BESIDE, occluded=2), label(BEHIND, truncated=0.4)]
    frame(tmp_path, [AHEAD, BESIDE, BEHIND], labels)
    for level, vehicles in (("easy", 1), ("moderate", 1), ("hard", 3), ("all", 3)):
        assert rows(tmp_path, part=level) == (vehicles, 1.0, 1.0)
    assert rows(tmp_path, range_m=10.5) == (1, 1.0, 1.0)


def camera_label(car, calibration, kind="Car"):
    """Returns a label's line in the camera's frame, with its place in the image."""
    middle = calibration.camera_T_lidar @ [*box(car)[:3], 1.0]
    image = calibration.image_of(box(car)[None])[0][0]
    length, width, height = places.CAR_M
    down = middle[1] + height / 2
    place = f"{middle[0]:.3f} {down:.3f} {middle[2]:.3f} {-car[2] - np.pi / 2:.4f}"
    edges = " ".join(f"{edge:.1f}" for edge in image)
    return f"{kind} 0 0 0 {edges} {height} {width} {length} {place}"


def test_with_a_camera_what_is_out_of_its_image_is_neither(tmp_path):
    frame(tmp_path, [AHEAD, BESIDE, BEHIND], [], CALIB)
    (empty,) = kitti_frames(tmp_path)
    region = empty.calibration.image_of(box(BESIDE)[None])[0][0] + [-5, -5, 5, 5]
    edges = " ".join(f"{edge:.1f}" for edge in region)
    lines = [
        camera_label(AHEAD, empty.calibration),
        f"DontCare -1 -1 -10 {edges} -1 -1 -1 -1000 -1000 -1000 -10",
    ]
    frame(tmp_path, [AHEAD, BESIDE, BEHIND], lines, CALIB)
    (read,) = kitti_frames(tmp_path)
    assert np.allclose(read.objects[0].box, box(AHEAD), atol=2e-3)
    assert rows(tmp_path, part="moderate") == (1, 1.0, 1.0)
    frame(tmp_path, [AHEAD, BESIDE, BEHIND], lines[:1], CALIB)
    assert rows(tmp_path) == (1, 1.0, 0.5)


def test_the_image_of_a_box_is_where_the_camera_sees_it():
    motion = Calibration.without_camera().camera_T_lidar
    camera = Calibration(motion, np.array([[700.0, 0, 600, 0], [0, 700, 180, 0], [0, 0, 1, 0]]))
    image, inside = camera.image_of(np.array([[10.5, 0, 0, 1, 2, 2, 0], [-9, 0, 0, 1, 2, 2, 0]]))
    assert inside.tolist() == [True, False]
    assert np.allclose(image[0], [530, 110, 670, 250])


@pytest.mark.parametrize(
    ("line", "calib", "error_text"),
    [
        ("Car 0 0", None, r"000007\.txt:1: needs 15 fields or more, the first one of Car, Van"),
        ("Lorry" + " 1" * 14, None, r"000007\.txt:1: needs 15 fields"),
        ("Car 0 0 0 1 1 2 2 1 1 x 5 0 5 0", None, r"000007\.txt:1: could not convert"),
        ("Car 0 0 0 1 1 2 2 1 0 1 5 0 5 0", None, r"000007\.txt:1: a size must be above 0"),
        ("", "P2: 1 2\n", r"calib/000007\.txt: needs a line P2: with 12 numbers"),
        ("", CALIB.replace("R0_rect: 1", "R0_rect: 3"), "are no motion of a solid body"),
    ],
)
def test_labels_that_are_wrong_are_refused_with_file_and_line(tmp_path, line, calib, error_text):
    frame(tmp_path, [AHEAD], [line], calib)
    with pytest.raises(ConfigError, match=error_text):
        kitti_frames(tmp_path)


def test_the_command_prints_a_table_or_json_and_refuses_what_does_not_fit(tmp_path):
    labels = [label(AHEAD), label(BESIDE, occluded=1)]
    frame(tmp_path / "training", [AHEAD, BESIDE], labels)
    asked = ["eval", "--kitti", str(tmp_path)]
    shown = CliRunner().invoke(app, asked, env={"COLUMNS": "80"})
    assert shown.exit_code == 0, shown.output
    lines = [line.split() for line in shown.output.splitlines()]
    assert ["car", "all", "2", *["100"] * 5] in lines
    assert ["car", "easy", "1", *["100"] * 5] in lines
    assert not any(line[:2] == ["car", "moderate"] for line in lines)  # as easy as all
    listed = json.loads(CliRunner().invoke(app, [*asked, "--json", "--range=50"]).stdout)
    assert {row["part"] for row in listed} == {"all", "easy", "moderate", "hard"}
    for options, error_text in (
        (["eval", "--range=50", str(tmp_path)], "--range is for --kitti DIR"),
        ([*asked, "--range=500"], "--range 500: must be 5 to 90 m"),
        ([*asked, "--net=x"], "give a dataset, --net or --kitti, one of them"),
        (["eval", "--kitti", str(tmp_path / "none")], "does not exist"),
    ):
        assert error_text in str(CliRunner().invoke(app, options).exception)
