"""Detections in KITTI's format are tracked and scored: three cars seen from a moving one."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from perception.tracking.config import TrackingConfig
from protocol.errors import ConfigError
from studies.kitti_files import read_boxes, write_tracks
from studies.kitti_tracking import score_files, track_files

FILES = Path(__file__).parent / "kitti"
"""Made by us: forty frames at 10 Hz; a car ahead that is missed for three, one that comes, one that
is parked, and four false boxes."""


def tracked(out: Path, *, poses: bool) -> Path:
    place = FILES / "poses" if poses else None
    track_files(FILES / "detections", out, place, 10.0, TrackingConfig())
    return out


def test_both_forms_of_a_box_say_the_same() -> None:
    label = read_boxes(FILES / "labels" / "0000.txt")
    detection = read_boxes(FILES / "detections" / "0000.txt")
    for one in (label, detection):
        assert one.types[0] == "Car"
        # 12 m ahead, 3.5 m to the right, heading as the observing car
        assert one.boxes[0] == pytest.approx([12, -3.5, -0.9, 4.2, 1.7, 1.5, 0], abs=0.03)
    assert (label.ids[0], detection.ids[0]) == (1, -1)
    assert (label.scores[0], detection.scores[0]) == (1.0, 4.35)
    assert "DontCare" not in label.types


def test_tracks_are_written_as_they_are_read(tmp_path: Path) -> None:
    boxes = read_boxes(FILES / "labels" / "0000.txt")
    write_tracks(tmp_path / "0000.txt", boxes)
    again = read_boxes(tmp_path / "0000.txt")
    for name in ("frames", "ids", "boxes", "images", "scores"):
        np.testing.assert_allclose(getattr(again, name), getattr(boxes, name), atol=1e-3)
    assert again.types == boxes.types


def test_labels_as_tracks_have_full_marks(tmp_path: Path) -> None:
    write_tracks(tmp_path / "0000.txt", read_boxes(FILES / "labels" / "0000.txt"))
    score = score_files(tmp_path, FILES / "labels").score
    assert (score.idf1, score.mota, score.passages, score.id_switches) == (1, 1, 3, 0)


def test_with_the_cars_poses_every_car_keeps_its_id(tmp_path: Path) -> None:
    found = score_files(tracked(tmp_path / "out", poses=True), FILES / "labels")
    assert found.image_rules
    assert found.score.id_switches == 0
    assert found.score.idf1 is not None
    assert found.score.idf1 > 0.8


def test_without_poses_cars_are_tracked_in_the_cameras_frame(tmp_path: Path) -> None:
    score = score_files(tracked(tmp_path / "out", poses=False), FILES / "labels").score
    assert score.idf1 is not None
    assert 0.4 < score.idf1 < 1


def test_tracks_without_boxes_in_the_image_are_scored_all_the_same(tmp_path: Path) -> None:
    lines = (FILES / "labels" / "0000.txt").read_text().splitlines()
    bare = [line.split() for line in lines if "DontCare" not in line]
    text = "\n".join(" ".join([*one[:6], *["-1"] * 4, *one[10:]]) for one in bare)
    (tmp_path / "0000.txt").write_text(text)
    found = score_files(tmp_path, FILES / "labels")
    assert not found.image_rules
    assert (found.score.mota, found.score.idf1) == (1, 1)
    assert found.as_json()["rules"] == "all boxes"


def changed(folder: Path, change: Callable[[list[str]], list[str]]) -> Path:
    folder.mkdir()
    words = (FILES / "detections" / "0000.txt").read_text().splitlines()[0].split(",")
    (folder / "0000.txt").write_text(",".join(change(words)))
    return folder


@pytest.mark.parametrize(
    ("change", "error_text"),
    [
        (lambda words: words[:-1], "has 14 words, needs 15, 17 or 18"),
        (lambda words: ["x", *words[1:]], "line 1"),
        (lambda words: ["-1", *words[1:]], "frame -1"),
        (lambda words: ["0", "9", *words[2:]], "type 9 must be one of"),
        (lambda words: [*words[:7], "0", *words[8:]], "must have a size"),
    ],
)
def test_a_line_that_is_no_box_is_named(
    tmp_path: Path, change: Callable[[list[str]], list[str]], error_text: str
) -> None:
    with pytest.raises(ConfigError, match=error_text):
        track_files(changed(tmp_path / "in", change), tmp_path / "out", None, 10, TrackingConfig())


def test_too_few_poses_are_refused(tmp_path: Path) -> None:
    poses = tmp_path / "0000.txt"
    poses.write_text((FILES / "poses" / "0000.txt").read_text().splitlines()[0])
    with pytest.raises(ConfigError, match="holds 1 poses for 40 frames"):
        track_files(FILES / "detections", tmp_path / "out", tmp_path, 10, TrackingConfig())


def test_labels_must_be_there_for_every_sequence(tmp_path: Path) -> None:
    write_tracks(tmp_path / "0001.txt", read_boxes(FILES / "labels" / "0000.txt"))
    with pytest.raises(ConfigError, match="has no 0001.txt"):
        score_files(tmp_path, FILES / "labels")
    with pytest.raises(ConfigError, match="must be a folder"):
        score_files(tmp_path / "none", FILES / "labels")
