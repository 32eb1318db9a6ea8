from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

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
    with pytest.raises(ConfigError, match=r"holds no \.bin, \.feather, \.npy, \.pcd or \.ply file"):
        point_files([tmp_path])
    with pytest.raises(ConfigError, match=r"nothing\.bin does not exist"):
        point_files([tmp_path / "nothing.bin"])
    (tmp_path / "notes.txt").write_bytes(b"")
    with pytest.raises(ConfigError, match=r"cannot read \.txt; known are \.bin, .* and \.ply"):
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


def nuscenes(path, points=5000):
    """Writes a cloud whose size allows rows of four and of five; returns its rows (N, 5)."""
    rng = np.random.default_rng(1)
    rows = np.column_stack(
        [rng.normal(0, 20, (points, 3)), rng.integers(0, 256, points), rng.integers(0, 32, points)]
    ).astype("<f4")
    path.write_bytes(rows.tobytes())
    return rows


@pytest.mark.parametrize("name", ["sweep.pcd.bin", "sweep.bin"])
def test_rows_of_five_are_nuscenes_by_their_name_or_by_their_rings(tmp_path, name):
    rows = nuscenes(tmp_path / name)
    cloud = read_points(tmp_path / name)
    assert np.array_equal(cloud.points, rows[:, :3])
    assert np.allclose(cloud.intensity, rows[:, 3] / 255)


@pytest.mark.parametrize(
    ("name", "rows", "error_text"),
    [
        ("a.pcd.bin", np.ones((4, 4)), "64 bytes are no rows of five float32"),
        ("a.pcd.bin", np.full((4, 5), 0.5), "the last of five float32 in a row must be a ring"),
        ("a.bin", np.full((5, 4), -1.0), "are neither KITTI's rows of four .* nor nuScenes' of"),
        ("a.bin", np.ones((1, 3)), "12 bytes are neither KITTI's rows"),
    ],
)
def test_rows_that_are_of_neither_kind_are_refused(tmp_path, name, rows, error_text):
    (tmp_path / name).write_bytes(rows.astype("<f4").tobytes())
    with pytest.raises(ConfigError, match=rf"{name}: .*{error_text}|{name}: {error_text}"):
        read_points(tmp_path / name)


def ply(path, kind, rows):
    """Writes x, y, z, a byte of intensity and a face, in a kind of .ply."""
    order = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}[kind]
    head = (
        f"ply\nformat {kind} 1.0\ncomment made here\nelement vertex {len(rows)}\n"
        "property float x\nproperty float y\nproperty double z\nproperty uchar intensity\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    )
    if kind == "ascii":
        body = "".join(f"{x} {y} {z} {int(i)}\n" for x, y, z, i in rows.tolist()) + "3 0 1 2\n"
        path.write_bytes((head + body).encode())
        return
    layout = [("x", order + "f4"), ("y", order + "f4"), ("z", order + "f8"), ("i", "u1")]
    table = np.array([tuple(row) for row in rows.tolist()], layout)
    path.write_bytes(head.encode() + table.tobytes() + b"\x03" + bytes(12))


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_vertices_of_a_ply_are_points(tmp_path, kind):
    rows = np.array([[1, 2, 3, 255], [4, 5, -6.5, 51]], np.float64)
    ply(tmp_path / "a.ply", kind, rows)
    cloud = read_points(tmp_path / "a.ply")
    assert cloud.points.tolist() == [[1, 2, 3], [4, 5, -6.5]]
    assert np.allclose(cloud.intensity, [1.0, 0.2])


@pytest.mark.parametrize(
    ("text", "error_text"),
    [
        ("ply\nformat ascii 1.0\n", "no header of a .ply"),
        ("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n", "lacks"),
        ("ply\nelement face 1\nend_header\n", "the element face stands before the vertices"),
        (
            "ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar int x\nend_header\n",
            "is no property of one number",
        ),
        (
            "ply\nformat ascii 1.0\nelement vertex 9\nproperty float x\nproperty float y\n"
            "property float z\nend_header\n1 2 3\n",
            "3 numbers for 9 vertices of 3 each",
        ),
    ],
)
def test_a_ply_that_is_not_what_it_says_is_refused(tmp_path, text, error_text):
    (tmp_path / "a.ply").write_text(text)
    with pytest.raises(ConfigError, match=f"a.ply: .*{error_text}"):
        read_points(tmp_path / "a.ply")


def test_a_table_of_argoverse_and_an_array_are_points(tmp_path):
    pa = pytest.importorskip("pyarrow", reason="needs the extra `view`")
    feather = pytest.importorskip("pyarrow.feather")
    rows = {"x": [1.5, 4.0], "y": [2.0, 5.0], "z": [3.0, 6.0], "offset_ns": [0, 7]}
    halves = {name: np.array(rows[name], np.float16) for name in "xyz"}
    table = pa.table({**rows, **halves, "intensity": np.array([255, 0], np.uint8)})
    feather.write_feather(table, tmp_path / "1.feather", compression="zstd")
    plain = np.array([[1.5, 2, 3, 1], [4, 5, 6, 0]])
    np.save(tmp_path / "1.npy", plain)
    named = np.array(
        [(1.5, 2, 3, 1), (4, 5, 6, 0)], [(name, "f4") for name in "xyz"] + [("i", "f4")]
    )
    named.dtype.names = ("x", "y", "z", "intensity")
    np.save(tmp_path / "2.npy", named)
    for name in ("1.feather", "1.npy", "2.npy"):
        cloud = read_points(tmp_path / name)
        assert cloud.points.tolist() == [[1.5, 2, 3], [4, 5, 6]]
        assert cloud.intensity.tolist() == [1, 0]
    feather.write_feather(table.drop(["z"]), tmp_path / "1.feather")
    with pytest.raises(ConfigError, match="1.feather: no column z of numbers; it has x, y"):
        read_points(tmp_path / "1.feather")
    (tmp_path / "1.feather").write_bytes(b"ARROW1 and no more")
    with pytest.raises(ConfigError, match="1.feather: is no table of Feather"):
        read_points(tmp_path / "1.feather")


def test_an_array_that_is_no_cloud_is_refused(tmp_path):
    for array, error_text in ((np.ones((3, 2)), "an array"), (np.ones(3), "an array")):
        np.save(tmp_path / "a.npy", array)
        with pytest.raises(ConfigError, match=f"a.npy: {error_text}"):
            read_points(tmp_path / "a.npy")
    whole = tmp_path / "a.npy"
    np.save(whole, np.ones((100, 3)))
    whole.write_bytes(whole.read_bytes()[:-8])
    with pytest.raises(ConfigError, match="2392 bytes for an array"):
        read_points(whole)
    whole.write_bytes(b"no array")
    with pytest.raises(ConfigError, match="is no array of NumPy"):
        read_points(whole)


@given(st.binary(max_size=200), st.sampled_from(["a.ply", "a.npy", "a.bin", "a.pcd.bin"]))
def test_any_bytes_are_points_or_refused(tmp_path_factory, data, name):
    path = tmp_path_factory.getbasetemp() / name
    path.write_bytes((b"ply\n" if name == "a.ply" else b"") + data)
    with suppress(ConfigError):
        read_points(path)
