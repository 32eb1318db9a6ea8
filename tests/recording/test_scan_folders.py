"""Which file is whose scan."""

import pytest

from protocol.errors import ConfigError
from recording.foreign_scans.folder import scans_in, sensors_in


def touch(folder, *names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"")


def test_files_of_a_folder_are_the_frames_of_one_agent(tmp_path):
    touch(tmp_path / "car", "data/2.bin", "data/1.bin", "notes.txt")
    found = scans_in(tmp_path / "car")
    assert {name: [f.name for f in files] for name, files in found.items()} == {
        "car": ["1.bin", "2.bin"]
    }


def test_folders_below_are_agents(tmp_path):
    touch(tmp_path, "ego/velodyne/1.bin", "left/velodyne/1.bin")
    assert [*scans_in(tmp_path)] == ["ego", "left"]
    touch(tmp_path, "left/top/1.bin")
    assert [*scans_in(tmp_path)] == ["ego-velodyne", "left-top", "left-velodyne"]


def test_sensors_are_told_by_names_of_files_or_folders(tmp_path):
    touch(tmp_path / "a", "top.pcd", "left.pcd")
    touch(tmp_path / "b", "top-01.pcd", "top-02.pcd", "left-01.pcd", "left-02.pcd")
    touch(tmp_path / "c", "top/1.bin", "left/1.bin")
    for folder, frames in (("a", 1), ("b", 2), ("c", 1)):
        found = sensors_in(tmp_path / folder, ["top", "left"])
        assert {name: len(files) for name, files in found.items()} == {
            "top": frames,
            "left": frames,
        }


@pytest.mark.parametrize(
    ("files", "error_text"),
    [
        (
            ["top.pcd", "topmost.pcd", "left.pcd"],
            "topmost.pcd: is of none of the sensors top, left",
        ),
        (["top-1.pcd", "top-2.pcd", "left-1.pcd"], r"not equally many files \(top: 2, left: 1\)"),
        (["top.pcd"], r"not equally many files \(top: 1, left: 0\)"),
    ],
)
def test_what_does_not_fit_is_said(tmp_path, files, error_text):
    touch(tmp_path, *files)
    with pytest.raises(ConfigError, match=error_text):
        sensors_in(tmp_path, ["top", "left"])
