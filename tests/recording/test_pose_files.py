"""Poses as people and other programs write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.errors import ConfigError
from protocol.geometry import SE3
from recording.foreign_scans.agents import Source, agents_of
from recording.foreign_scans.poses import read_extrinsics, read_poses, write_extrinsics

numbers = st.floats(-900, 900, allow_subnormal=False)
poses = st.lists(st.tuples(*[numbers] * 6), min_size=1, max_size=6)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Returns what writes a text to a file of this name."""
    folder = tmp_path_factory.mktemp("files")

    def write(text: str, name: str) -> Path:
        (folder / name).write_text(text, "utf-8")
        return folder / name

    return write


@given(poses)
def test_emps_text_is_read_as_it_stands(written, rows):
    text = "\n".join(" ".join(map(repr, row)) for row in rows)
    (track,) = read_poses(written(text, "oxts.txt")).values()
    assert track.poses.tolist() == [list(row) for row in rows]


@given(poses)
def test_a_table_gives_the_same_poses_in_degrees_whatever_the_columns_order(written, rows):
    names = "yaw_deg,x_m,y_m,z_m,roll_deg,pitch_deg"
    lines = [",".join(map(repr, (row[5], *row[:5]))) for row in rows]
    (track,) = read_poses(written("\n".join([names, *lines]), "poses.csv")).values()
    turned = np.concatenate([np.array(rows)[:, :3], np.radians(np.array(rows)[:, 3:])], axis=1)
    assert np.allclose(track.poses, turned)


@given(st.tuples(numbers, numbers, numbers), st.tuples(*[st.floats(-3, 3)] * 3))
def test_a_matrix_is_the_same_transform(written, place, turn):
    made = SE3.from_pose([*place, *turn])
    row = np.column_stack([made.rotation, made.translation]).ravel()
    (track,) = read_poses(written(" ".join(map(repr, row.tolist())), "poses.txt")).values()
    read = SE3.from_pose(track.poses[0])
    assert np.allclose(read.rotation, made.rotation, atol=1e-6)
    assert np.allclose(read.translation, made.translation)


@given(st.text(max_size=200), st.sampled_from(["poses.csv", "poses.txt"]))
def test_no_text_does_more_than_to_be_refused(written, text, name):
    try:
        tracks = read_poses(written(text.encode("utf-8", "ignore").decode(), name))
    except ConfigError:
        return
    assert all(np.isfinite(track.poses).all() for track in tracks.values())


def test_kittis_oxts_begins_at_the_origin_and_goes_east_and_north(written):
    rest = " ".join(["0"] * 24)
    lines = [f"49.0 8.4 112 0.01 0.02 1.5 {rest}", f"49.0001 8.4001 113 0 0 1.5 {rest}"]
    (track,) = read_poses(written("\n".join(lines), "0000.txt")).values()
    assert track.poses[0].tolist() == [0, 0, 0, 0.01, 0.02, 1.5]
    assert track.poses[1, :3] == pytest.approx([7.3, 11.13, 1], abs=0.02)


def test_a_folder_of_files_is_a_track_and_one_of_folders_has_one_of_each(tmp_path):
    for agent in ("ego", "other"):
        (tmp_path / agent / "oxts").mkdir(parents=True)
        for frame in range(2):
            (tmp_path / agent / "oxts" / f"{frame:06}.txt").write_text(f"{frame} 0 0 0 0 0\n")
    tracks = read_poses(tmp_path)
    assert {name: track.poses[:, 0].tolist() for name, track in tracks.items()} == {
        "ego": [0, 1],
        "other": [0, 1],
    }
    assert [*read_poses(tmp_path / "ego")] == [""]


def test_a_table_may_name_agents_and_times(written):
    path = written("agent,time_s,x_m,y_m,z_m\na,1.5,0,0,2\nb,1.5,9,0,2\na,1.6,1,0,2\n", "p.csv")
    tracks = read_poses(path)
    assert tracks["a"].poses[:, 0].tolist() == [0, 1]
    assert tracks["a"].times_s.tolist() == [1.5, 1.6]


@pytest.mark.parametrize(
    ("name", "text", "error_text"),
    [
        ("p.csv", "x_m,y_m\n1,2\n", r"p\.csv: line 1: lacks the column z_m"),
        ("p.csv", "x_m,y_m,z_m,zz\n", r"line 1: unknown column 'zz'; allowed: x_m, y_m"),
        ("p.csv", "x_m,y_m,z_m\n1,2,3\n1,two,3\n", r"line 3: 'two' is no finite number"),
        ("p.csv", "x_m,y_m,z_m\n1,2\n", r"line 2: None is no finite number"),
        ("p.csv", "x_m,y_m,z_m\n", r"line 2: no pose follows"),
        ("p.csv", "x_m,y_m, x_m,z_m\n1,2,3,4\n", r"line 1: has the column x_m twice"),
        ("p.csv", "x_m,y_m,z_m\n1,2,3\n1,2,3,4\n", r"line 3: has more fields than the 3 columns"),
        ("p.csv", "time_s,x_m,y_m,z_m\n2,0,0,0\n1,0,0,0\n", r"line 3: time_s must ascend"),
        (
            "p.txt",
            "1 2 3\n",
            r"p\.txt: line 1: has 3 numbers, needs 6, 8 \(TUM\), 12 \(KITTI\) or 30",
        ),
        ("p.txt", "1 2 3 4 5 6\n" + "0 " * 30, r"line 2: has 30 numbers, needs 6"),
        ("p.txt", "1 2 3 4 5 nan\n", r"line 1: 'nan' is no finite number"),
        ("p.txt", "1e9 0 0 0 0 0\n", r"line 1: a pose lies beyond 1e7 m"),
        ("p.txt", " ".join(["2"] * 12), r"line 1: the 12 numbers are no rows of \[R\|t\]"),
        ("p.txt", "91 0 " + "0 " * 28, r"line 1: latitude 91, longitude 0 deg cannot be"),
        ("p.txt", "# nothing\n", r"line 1: there is no pose"),
    ],
)
def test_what_is_wrong_is_said_with_file_and_line(written, name, text, error_text):
    with pytest.raises(ConfigError, match=error_text):
        read_poses(written(text, name))


@given(
    st.dictionaries(st.sampled_from(["top", "left", "right"]), st.tuples(*[st.floats(-1, 1)] * 6))
)
def test_extrinsics_are_read_as_they_were_written(written, mounts):
    made = {name: SE3.from_pose(pose) for name, pose in mounts.items()}
    path = written("", "extrinsics.csv")
    write_extrinsics(path, made)
    if not made:
        with pytest.raises(ConfigError, match="no sensor follows"):
            read_extrinsics(path, [])
        return
    read = read_extrinsics(path, [])
    assert [*read] == [*made]
    for name, mount in made.items():
        assert np.allclose(read[name].rotation, mount.rotation, atol=1e-5)
        assert np.allclose(read[name].translation, mount.translation, atol=1e-4)


OPENCALIB = """device_id: 0
(Roll,Pitch,Yaw,tx,ty,tz): 0 0 0 0 0 0

device_id: 1
(Roll,Pitch,Yaw,tx,ty,tz): 0 0 90 -0.1 0.6 -0.35
"""


def test_opencalibs_devices_get_the_names_that_are_told(written):
    read = read_extrinsics(written(OPENCALIB, "e.txt"), ["top", "left"])
    assert [*read] == ["top", "left"]
    assert read["left"].as_pose() == pytest.approx([-0.1, 0.6, -0.35, 0, 0, np.pi / 2])


@pytest.mark.parametrize(
    ("text", "names", "error_text"),
    [
        (OPENCALIB, ["top"], r"e\.txt: line 4: device '1' has no name: give --sensors"),
        (OPENCALIB, ["a", "b", "c"], r"has 2 devices, --sensors names 3"),
        ("device_id: 0\nroll 1\n", ["a"], r"line 2: 'roll 1' is neither device_id"),
        ("(Roll,Pitch,Yaw,tx,ty,tz): 0 0 0 0 0 0\n", ["a"], r"line 1: needs six numbers, once"),
    ],
)
def test_what_is_wrong_with_extrinsics_is_said(written, text, names, error_text):
    with pytest.raises(ConfigError, match=error_text):
        read_extrinsics(written(text, "e.txt"), names)


def test_lines_of_tum_and_a_table_of_argoverse_are_the_same_poses(tmp_path):
    pa = pytest.importorskip("pyarrow", reason="needs the extra `view`")
    feather = pytest.importorskip("pyarrow.feather")
    half = np.sqrt(0.5)
    tum = tmp_path / "tum.txt"
    tum.write_text(f"# time\n5.0 1 2 3 0 0 {half} {half}\n5.1 2 2 3 0 0 0 1\n")
    table = tmp_path / "city_SE3_egovehicle.feather"
    rows = {"qw": [half, 1.0], "qx": [0.0, 0.0], "qy": [0.0, 0.0], "qz": [half, 0.0]}
    rows |= {"tx_m": [1.0, 2.0], "ty_m": [2.0, 2.0], "tz_m": [3.0, 3.0]}
    whole = pa.table({"timestamp_ns": [5_000_000_000, 5_100_000_000], **rows})
    feather.write_feather(whole, table)
    for path in (tum, table):
        track = read_poses(path)[""]
        assert np.allclose(track.poses, [[1, 2, 3, 0, 0, np.pi / 2], [2, 2, 3, 0, 0, 0]])
        assert track.times_s == pytest.approx([5.0, 5.1])
    feather.write_feather(whole.drop(["qz"]), table)
    with pytest.raises(ConfigError, match="lacks a column qz of numbers; needs timestamp_ns, qw"):
        read_poses(table)
    tum.write_text("5.0 1 2 3 0 0 1 1\n")
    with pytest.raises(ConfigError, match=r"line 1: the quaternion's length is 1.41421, must be 1"):
        read_poses(tum)
    tum.write_text("5.0 1 2 3 0 0 0 1\n4.0 1 2 3 0 0 0 1\n")
    with pytest.raises(ConfigError, match="times must ascend"):
        read_poses(tum)


def test_of_poses_with_times_those_of_the_files_names_are_taken(tmp_path):
    scans = tmp_path / "lidar"
    scans.mkdir()
    for stamp in ("1500000000100000000", "1500000000300000000"):
        (scans / f"{stamp}.bin").write_bytes(np.ones(4, "<f4").tobytes())
    tum = tmp_path / "tum.txt"
    tum.write_text("".join(f"{1_500_000_000 + n / 10:.1f} {n} 0 0 0 0 0 1\n" for n in range(5)))
    (agent,) = agents_of(Source(scans, tum))
    assert [agent.pose(n)[0] for n in range(2)] == [1, 3]
    assert np.diff(agent.times_s) == pytest.approx([0.2])
    tum.write_text("1400000000 0 0 0 0 0 0 1\n1400000001 0 0 0 0 0 0 1\n1400000002 0 0 0 0 0 0 1\n")
    with pytest.raises(ConfigError, match="3 poses for the 2 scans .* within 0.05 s"):
        agents_of(Source(scans, tum))
