"""A dataset as it is written and read."""

import json
import shutil
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from learning.dataset import SPLITS, Dataset, Info, ScanRow, scan_paths, splits
from learning.generate import generate
from learning.scanner import JunctionScanner
from learning.sites import draw_site
from protocol.errors import ConfigError
from protocol.geometry import SE3, wrap_angle
from tests.learning.small_dataset import SPEC


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


@pytest.mark.slow
def test_the_bytes_depend_on_the_arguments_alone(folder, tmp_path):
    generate(tmp_path / "again", SPEC, jobs=1)
    one, other = contents(folder), contents(tmp_path / "again")
    assert one.keys() == other.keys()
    assert [name for name in one if one[name] != other[name]] == []


def test_one_split_alone_has_the_scans_that_it_has_in_the_whole(folder, dataset, tmp_path):
    generate(tmp_path / "part", replace(SPEC, split="test"), jobs=1)
    part = Dataset(tmp_path / "part")
    assert part.networks("test") == dataset.networks("test")
    assert part.networks("train") == []
    rows = [row for row in rows_of(folder) if row.network in part.networks("test")]
    for row, alone in zip(rows, rows_of(tmp_path / "part"), strict=True):
        assert row == alone.model_copy(update={"index": row.index})
        pairs = scan_paths(folder, row.index), scan_paths(tmp_path / "part", alone.index)
        for one, other in zip(*pairs, strict=True):
            assert one.read_bytes() == other.read_bytes()


@pytest.mark.parametrize(("split", "networks"), [("all", 3), ("test", 2)])
def test_a_split_that_there_is_not_is_refused(tmp_path, split, networks):
    with pytest.raises(ConfigError, match=f"--split {split}: "):
        generate(tmp_path / "part", replace(SPEC, split=split, networks=networks), jobs=1)


def test_a_network_is_in_one_split_alone(dataset):
    by_split = [dataset.networks(split) for split in SPLITS]
    assert all(by_split)
    for one, other in combinations(by_split, 2):
        assert not set(one) & set(other)


def rows_of(folder: Path) -> list[ScanRow]:
    lines = (folder / "poses.jsonl").read_text().splitlines()
    return [ScanRow.model_validate_json(line) for line in lines]


@pytest.mark.parametrize(
    ("networks", "sizes"),
    [(1, (1, 0, 0)), (2, (2, 0, 0)), (3, (1, 1, 1)), (20, (14, 3, 3)), (60, (42, 9, 9))],
)
def test_splits_are_70_15_15_with_one_each(networks, sizes):
    assert tuple(splits(networks).count(split) for split in SPLITS) == sizes


def test_a_sample_is_read_as_it_was_seen(dataset):
    scanner = JunctionScanner(draw_site(SPEC.seed, 0), SPEC.samples)
    scans = [scan for scan in scanner.scans() if scan.row.frame == 1]
    sample = dataset.load("network-000", 1)
    assert [scan.agent for scan in sample.scans] == [scan.row.agent for scan in scans]
    vehicles = sorted({label.vehicle for scan in scans for label in scan.labels})
    assert sample.boxes.shape == (len(vehicles), 7)
    for read, scan, points_on in zip(sample.scans, scans, sample.points_on, strict=True):
        np.testing.assert_array_equal(read.points, scan.points[:, :3])
        assert (None if read.own is None else vehicles[read.own]) == scan.row.own
        labelled = {label.vehicle: label.points for label in scan.labels}
        assert points_on.tolist() == [labelled.get(vehicle, 0) for vehicle in vehicles]
        believed = SE3.from_pose(scan.row.map_SE3_sensor.believed)
        np.testing.assert_array_equal(read.map_SE3_sensor.rotation, believed.rotation)
        map_SE3_sensor = SE3.from_pose(scan.row.map_SE3_sensor.true)
        for label in scan.labels:
            box = sample.boxes[vehicles.index(label.vehicle)]
            middle = map_SE3_sensor.apply(np.array(label.box[:3]))
            np.testing.assert_allclose(box[:3], middle, atol=0.005)
            np.testing.assert_allclose(box[3:6], label.box[3:6], atol=0.001)


def test_points_on_a_vehicle_lie_in_its_box(folder, dataset):
    rows = rows_of(folder)
    counted = 0
    for network, frame in dataset.samples("train"):
        sample = dataset.load(network, frame)
        here = [row for row in rows if (row.network, row.frame) == (network, frame)]
        for scan, row, points_on in zip(sample.scans, here, sample.points_on, strict=True):
            points = SE3.from_pose(row.map_SE3_sensor.true).apply(scan.points)
            for box, on in zip(sample.boxes, points_on, strict=True):
                away = points - box[:3]
                c, s = np.cos(box[6]), np.sin(box[6])
                local = away @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
                inside = (np.abs(local) <= box[3:6] / 2 + 0.15).all(axis=1)
                assert on <= np.count_nonzero(inside)
                counted += on
    assert counted > 1000


def test_nobody_sees_the_vehicle_that_carries_the_sensor(dataset):
    carried = 0
    for split in SPLITS:
        for network, frame in dataset.samples(split):
            sample = dataset.load(network, frame)
            for scan, points_on in zip(sample.scans, sample.points_on, strict=True):
                if scan.own is not None:
                    assert points_on[scan.own] == 0
                    place = scan.map_SE3_sensor.translation[:2]
                    assert np.hypot(*(sample.boxes[scan.own, :2] - place)) < 1.0
                    carried += 1
    assert carried


def test_every_scan_has_a_vehicle_or_a_post(folder):
    for row in rows_of(folder):
        poses = row.map_SE3_sensor
        assert (row.kind == "vehicle") == (row.own is not None)
        assert (poses.believed == poses.true) == (row.kind == "roadside")
        off = np.subtract(poses.believed, poses.true)
        assert np.abs(off[:3]).max() < 0.4
        assert np.abs(wrap_angle(off[3:])).max() < 0.02


def test_the_road_map_is_the_networks(dataset):
    for split in SPLITS:
        for network in dataset.networks(split):
            road_map = dataset.road_map(network)
            assert road_map.name == network
            assert road_map.intersections[0].signal.greens


def broken(folder: Path, tmp_path: Path, name: str, text: str | None) -> Path:
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    (copy / name).unlink()
    if text is not None:
        (copy / name).write_text(text)
    return copy


def read_all(folder: Path) -> None:
    dataset = Dataset(folder)
    for split in SPLITS:
        for network, frame in dataset.samples(split):
            dataset.road_map(network)
            dataset.load(network, frame)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("dataset.json", None, "No such file"),
        ("dataset.json", '{"version": 2, "networks": 1, "samples": 1, "seed": 1}', "version 2"),
        ("poses.jsonl", "{}", "poses.jsonl:1: index"),
        ("poses.jsonl", "nonsense", "poses.jsonl:1: Invalid JSON"),
        ("ImageSets/val.txt", "000000\n999999\n", "val.txt:2: 999999 is no scan"),
        ("networks/network-000/road_map.json", "[]", "road_map.json"),
        ("training/label_2/000000.txt", "Car 1\n", "000000.txt:1: needs 17 fields"),
        ("training/velodyne/000000.bin", "abc", "000000.bin: 3 bytes"),
        ("training/velodyne/000000.bin", None, "000000.bin"),
    ],
)
def test_a_broken_file_is_named(folder, tmp_path, name, text, message):
    with pytest.raises(ConfigError, match=message):
        read_all(broken(folder, tmp_path, name, text))


def test_what_is_not_there_is_named(dataset):
    with pytest.raises(ConfigError, match="no scan of network-000, frame 9"):
        dataset.load("network-000", 9)
    with pytest.raises(ConfigError, match="allowed are train, val, test"):
        dataset.samples("training")


def test_the_arguments_stand_in_the_dataset(folder):
    info = json.loads((folder / "dataset.json").read_text())
    numbers = {"version": 1, "networks": 3, "samples": 2, "seed": 7, "furniture_per_100m": 0.0}
    assert info == numbers | {"realism": "paper", "split": None}


def test_a_dataset_that_counts_moments_is_read():
    info = Info.model_validate_json('{"version": 1, "networks": 3, "moments": 2, "seed": 7}')
    assert info.samples == 2
