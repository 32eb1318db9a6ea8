import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from protocol import codec
from protocol.codec import PointCloud, RangeScan, ScanPattern, decode, encode_cloud, encode_scan
from protocol.errors import CodecError

PATTERN = ScanPattern(4, 16, 2.0, -24.9)
BOUNDS_M = st.sampled_from([0.001, 0.01, 0.02, 0.1, 1.0])
ranges = hnp.arrays(
    np.float32, (4, 16), elements=st.floats(0, 120, width=32), fill=st.just(np.float32(0))
)
clouds = hnp.arrays(
    np.float32, st.tuples(st.integers(0, 40), st.just(3)), elements=st.floats(-200, 200, width=32)
)


def scan_of(range_m: np.ndarray) -> RangeScan:
    return RangeScan(PATTERN, range_m, np.linspace(0, 1, 64, dtype=np.float32).reshape(4, 16))


def cloud_of(points: np.ndarray) -> PointCloud:
    return PointCloud(points, np.linspace(0, 1, len(points), dtype=np.float32))


@given(ranges, BOUNDS_M)
def test_every_point_of_a_scan_comes_back_within_the_bound(range_m, bound_m):
    scan = scan_of(range_m)
    back = decode(encode_scan(scan, bound_m))
    want = scan.cloud().points
    assert back.points.shape == want.shape
    assert np.all(np.linalg.norm(back.points.astype(float) - want, axis=1) <= bound_m)


@given(clouds, st.sampled_from([0.01, 0.02, 0.1]))
def test_every_point_of_a_cloud_comes_back_in_order_within_the_bound(points, bound_m):
    back = decode(encode_cloud(cloud_of(points), bound_m))
    assert back.points.shape == points.shape
    error_m = np.linalg.norm(back.points.astype(float) - points.astype(float), axis=1)
    assert np.all(error_m <= bound_m)


@given(ranges)
def test_intensity_comes_back_within_half_a_byte_step(range_m):
    scan = scan_of(range_m)
    back = decode(encode_scan(scan, 0.02, intensity=True))
    assert np.allclose(back.intensity, scan.cloud().intensity, atol=0.5 / 255 + 1e-6)


def test_intensity_of_a_cloud_comes_back_within_half_a_byte_step():
    cloud = cloud_of(np.ones((9, 3), np.float32))
    back = decode(encode_cloud(cloud, 0.02, intensity=True))
    assert np.allclose(back.intensity, cloud.intensity, atol=0.5 / 255 + 1e-6)


def test_an_empty_scan_and_an_empty_cloud_have_no_points():
    assert len(decode(encode_scan(scan_of(np.zeros((4, 16), np.float32)), 0.02)).points) == 0
    assert len(decode(encode_cloud(cloud_of(np.zeros((0, 3), np.float32)), 0.02)).points) == 0


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1.0])
def test_a_range_that_is_no_distance_is_refused(bad):
    range_m = np.ones((4, 16), np.float32)
    range_m[1, 3] = bad
    with pytest.raises(CodecError, match=r"finite|range"):
        encode_scan(scan_of(range_m), 0.02)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e9])
def test_a_coordinate_out_of_reach_is_refused(bad):
    points = np.ones((5, 3), np.float32)
    points[2, 1] = bad
    with pytest.raises(CodecError, match="coordinate"):
        encode_cloud(cloud_of(points), 0.02)


def test_a_range_beyond_the_steps_of_the_form_is_refused_with_the_limit():
    with pytest.raises(CodecError, match="the form ends at 13.0 m"):
        encode_scan(scan_of(np.full((4, 16), 50, np.float32)), 0.0001)


@given(st.binary(max_size=200))
def test_random_bytes_raise_one_kind_of_error(data):
    with pytest.raises(CodecError):
        decode(data)


@settings(max_examples=300)
@given(st.data())
def test_a_damaged_payload_decodes_or_raises_one_kind_of_error(data):
    forms = [encode_scan(scan_of(np.full((4, 16), 30, np.float32)), 0.02)]
    forms.append(encode_cloud(cloud_of(np.ones((7, 3), np.float32)), 0.02))
    payload = bytearray(data.draw(st.sampled_from(forms)))
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(payload)))
    for damaged in (bytes(payload), bytes(payload[:cut])):
        try:
            decode(damaged)
        except CodecError:
            continue


def test_a_payload_that_claims_more_than_the_limit_is_refused_before_allocation():
    head = codec.PREFIX.pack(b"SCAN", 1, 0, 0, 0, 0.0, 0.0, 0.02, 2**32 - 1, 2**32 - 1)
    with pytest.raises(CodecError, match="limit 4194304"):
        decode(head + b"x")
    head = codec.PREFIX.pack(b"SCAN", 0, 0, 65535, 2**31, 0.0, 0.0, 0.02, 1, 1)
    with pytest.raises(CodecError, match="beams"):
        decode(head + b"x")


def test_a_frame_that_decompresses_to_more_than_it_claims_is_refused():
    honest = encode_scan(scan_of(np.ones((4, 16), np.float32)), 0.02)
    bomb = codec.zstandard.ZstdCompressor().compress(bytes(50_000_000))
    with pytest.raises(CodecError, match="claims 50000000"):
        decode(honest[: codec.PREFIX.size] + bomb)
    silent = codec.zstandard.ZstdCompressor(write_content_size=False).compress(bytes(50_000_000))
    with pytest.raises(CodecError):
        decode(honest[: codec.PREFIX.size] + silent)


def test_directions_follow_the_pattern():
    directions = ScanPattern(3, 4, 10.0, -30.0).directions
    assert np.allclose(np.linalg.norm(directions, axis=-1), 1)
    assert np.allclose(np.degrees(np.arcsin(directions[:, 0, 2])), [10, -10, -30], atol=1e-4)
    assert np.allclose(directions[1, 1, :2], [0, np.cos(np.radians(10))], atol=1e-6)


def test_a_pattern_without_beams_is_refused():
    with pytest.raises(CodecError, match="beams"):
        ScanPattern(0, 1800, 2, -24.9)
    with pytest.raises(CodecError, match="field of view"):
        ScanPattern(64, 1800, -30, 10)
