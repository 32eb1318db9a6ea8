import io
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from protocol.codec import encode_cloud
from protocol.errors import ConfigError
from protocol.scans import PointCloud
from studies.bench_codec import (
    BOUNDS_M,
    BenchCloud,
    BenchRow,
    DracoGrid,
    bench,
    cast_clouds,
    draco_beside,
    draco_error_m,
    print_bench,
)
from studies.bench_scans import Junction, cast_scans


def file_of(folder: Path, rows: list[list[float]]) -> Path:
    path = folder / "cloud.bin"
    np.array(rows, np.float32).tofile(path)
    return path


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([], "no point with finite coordinates"),
        ([[np.nan, 0, 0, 0]], "no point with finite coordinates"),
        ([[0, 0, 0, 0], [1e30, 0, 0, 0]], "cannot be encoded"),
    ],
)
def test_a_file_without_a_cloud_is_refused_with_its_name(tmp_path, rows, message):
    pytest.importorskip("DracoPy")
    with pytest.raises(ConfigError, match=rf"cloud\.bin: .*{message}"):
        BenchCloud.of_file(file_of(tmp_path, rows))


@pytest.mark.parametrize("points", [1, 2])
def test_a_cloud_of_a_point_or_two_is_measured(tmp_path, points):
    pytest.importorskip("DracoPy")
    rows = bench(BenchCloud.of_file(file_of(tmp_path, [[1, 2, 3, 0]] * points)), runs=1)
    assert {row.points for row in rows} == {points}
    assert all(row.max_error_m <= row.bound_m for row in rows)


def test_no_number_of_a_table_is_cut_where_a_file_is_large_and_its_path_long():
    row = BenchRow(
        cloud="/somewhere" * 9 + "/x.bin",
        kind="file",
        codec="float32+zstd",
        points=1,
        bytes=10_432_123_456,
        bits_per_point=123.45,
        encode_ms=12345.67,
        decode_ms=76543.21,
        max_error_m=0.1,
        bound_m=0.1234,
        noise_floor_bits=None,
        loss_floor_bits=None,
    )
    printed = io.StringIO()
    print_bench([row], Console(file=printed, width=80))
    assert "where/somewhere/x.bin, 1 points" in printed.getvalue()
    for number in ("10432123456", "12345.67", "76543.21", "123.45", "10.00", "12.34"):
        assert number in printed.getvalue()


@pytest.fixture(scope="module")
def junction() -> Junction:
    return Junction.in_traffic()


def test_a_scan_takes_less_than_half_of_draco_s_bytes_within_the_same_error(junction):
    pytest.importorskip("DracoPy")
    rows = bench(BenchCloud.of_scan(cast_scans(junction)[0]), runs=1)
    most = {"fast": 1.3, "default": 0.5}  # of Draco's bytes
    compared = 0
    for row in rows:
        draco = draco_beside(row, rows)
        assert row.max_error_m <= row.bound_m * 1.0001
        if draco is not None and row.codec in most:
            compared += 1
            assert row.bytes < most[row.codec] * draco.bytes
    assert compared == 2 * len(BOUNDS_M)
    (floor,) = [row for row in rows if row.codec == "default" and row.bound_m == 0.01]
    assert floor.bits_per_point < 1.45 * (floor.noise_floor_bits + floor.loss_floor_bits)


def test_a_picture_codec_keeps_the_bound_and_takes_more_bytes(junction):
    pytest.importorskip("DracoPy")
    pytest.importorskip("imagecodecs")
    rows = bench(BenchCloud.of_scan(cast_scans(junction)[1]), runs=1)
    for bound_m in BOUNDS_M:
        size = {row.codec: row.bytes for row in rows if row.bound_m == bound_m}
        assert size["default"] < size["jpeg-xl"]
        assert size["default"] < size["jpeg-ls"]


def test_the_cloud_of_every_kind_of_sensor_takes_less_than_draco_s_bytes(junction):
    draco = pytest.importorskip("DracoPy")
    clouds = cast_clouds(junction)
    assert len(clouds) == 12
    for cloud in clouds:
        bare = PointCloud(cloud.points, np.zeros(len(cloud.points), np.float32))
        for bound_m in BOUNDS_M:
            most = 0.95 * len(DracoGrid.of(cloud.points, bound_m).encode(draco, cloud.points))
            assert len(encode_cloud(bare, bound_m)) <= most, (cloud.name, bound_m)


def test_draco_s_error_just_meets_the_bound(junction):
    pytest.importorskip("DracoPy")
    cloud = cast_clouds(junction)[2]
    for bound_m in BOUNDS_M:
        assert 0.98 * bound_m < draco_error_m(cloud.points, bound_m) <= bound_m
