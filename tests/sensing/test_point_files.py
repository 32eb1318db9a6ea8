import numpy as np
import pytest

from protocol.errors import ConfigError
from sensing.point_files import point_files, read_points


def test_a_folder_stands_for_all_clouds_under_it_in_order(tmp_path):
    inner = tmp_path / "b"
    inner.mkdir()
    for path in (inner / "2.bin", tmp_path / "a.PCD", inner / "notes.txt", tmp_path / "c.bin"):
        path.write_bytes(b"")
    alone = inner / "2.bin"
    assert point_files([tmp_path, alone]) == [tmp_path / "a.PCD", alone, tmp_path / "c.bin", alone]


def test_a_path_that_holds_no_cloud_is_refused_with_its_name(tmp_path):
    with pytest.raises(ConfigError, match=r"holds no \.bin or \.pcd file"):
        point_files([tmp_path])
    with pytest.raises(ConfigError, match=r"nothing\.bin does not exist"):
        point_files([tmp_path / "nothing.bin"])
    (tmp_path / "notes.txt").write_bytes(b"")
    with pytest.raises(ConfigError, match=r"cannot read \.txt; known are \.bin and \.pcd"):
        read_points(tmp_path / "notes.txt")


def test_rows_of_a_bin_file_are_points_with_reflectance(tmp_path):
    rows = np.array([[1, 2, 3, 0.5], [4, 5, np.nan, 0.1]], np.float32)
    (tmp_path / "one.bin").write_bytes(rows.tobytes())
    cloud = read_points(tmp_path / "one.bin")
    assert cloud.points.tolist() == [[1, 2, 3]]
    assert cloud.intensity.tolist() == [0.5]


def test_a_number_that_signals_is_no_point_and_no_warning(tmp_path):
    row = np.array([0x7F800001, 0, 0, 0], np.uint32)
    (tmp_path / "one.bin").write_bytes(row.tobytes() + np.ones(4, np.float32).tobytes())
    assert read_points(tmp_path / "one.bin").points.tolist() == [[1, 1, 1]]


def test_more_fields_than_anybody_has_are_read_at_once(tmp_path):
    names = " ".join(["x", "y", "z"] + ["a"] * 8000)
    (tmp_path / "many.pcd").write_text(
        f"FIELDS {names}\nSIZE {'4 ' * 3 + '1 ' * 8000}\nTYPE {'F ' * 3 + 'U ' * 8000}\n"
        "POINTS 0\nDATA ascii\n"
    )
    with pytest.raises(ConfigError, match="a point takes 8012 bytes"):
        read_points(tmp_path / "many.pcd")
