from dataclasses import replace

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from protocol.codec import decode, encode_cloud, encode_scan
from protocol.codec.payload import PREFIX, Form, Head, read_payload
from protocol.errors import CodecError
from protocol.scans import PointCloud, RangeScan, ScanPattern

PATTERN = ScanPattern(4, 16, 2.0, -24.9)
BOUNDS_M = st.sampled_from([0.001, 0.01, 0.02, 0.1, 1.0])
OWN = ["fast", "default"]
PROFILES = st.sampled_from(OWN)
ranges = hnp.arrays(
    np.float32, (4, 16), elements=st.floats(0, 120, width=32), fill=st.just(np.float32(0))
)
clouds = hnp.arrays(
    np.float32, st.tuples(st.integers(0, 40), st.just(3)), elements=st.floats(-200, 200, width=32)
)


def scan_of(range_m: np.ndarray) -> RangeScan:
    return RangeScan(PATTERN, range_m, np.linspace(0, 1, 64, dtype=np.float32).reshape(4, 16))


def cloud_of(points: np.ndarray) -> PointCloud:
    """Gives the points intensities that tell them apart again."""
    return PointCloud(points, np.arange(len(points), dtype=np.float32) / 255)


def street(seed: int = 1, columns: int = 360) -> RangeScan:
    """A flat street between walls, with noise and losses."""
    rng = np.random.default_rng(seed)
    pattern = ScanPattern(32, columns, 5.0, -25.0)
    down = -pattern.directions[..., 2]
    beside = np.abs(pattern.directions[..., 1])
    clean = np.minimum(2.0 / np.maximum(down, 1e-6), 12.0 / np.maximum(beside, 1e-6))
    noisy = clean + rng.normal(0, 0.02, clean.shape)
    lost = (clean > 100) | (rng.random(clean.shape) < 0.1)
    range_m = np.where(lost, 0, noisy).astype(np.float32)
    return RangeScan(pattern, range_m, rng.random(clean.shape).astype(np.float32))


@settings(deadline=None)  # the machine may be busy
@given(ranges, BOUNDS_M, PROFILES)
def test_every_point_of_a_scan_comes_back_within_the_bound(range_m, bound_m, profile):
    scan = scan_of(range_m)
    back = decode(encode_scan(scan, bound_m, profile=profile))
    want = scan.cloud().points
    assert back.points.shape == want.shape
    assert np.all(np.linalg.norm(back.points.astype(float) - want, axis=1) <= bound_m)


@pytest.mark.parametrize("profile", OWN)
@pytest.mark.parametrize("bound_m", [0.001, 0.01, 0.05, 0.2, 5.0])
def test_every_point_of_a_noisy_street_comes_back_within_the_bound(profile, bound_m):
    scan = street()
    back = decode(encode_scan(scan, bound_m, profile=profile, intensity=True))
    want = scan.cloud()
    error_m = np.linalg.norm(back.points.astype(float) - want.points, axis=1)
    assert error_m.max() <= bound_m
    assert error_m.max() > 0.95 * bound_m  # no shorter steps than the bound asks for
    assert np.allclose(back.intensity, want.intensity, atol=0.5 / 255 + 1e-6)


@pytest.mark.parametrize("columns", [1, 3, 4, 31, 33, 257])
@pytest.mark.parametrize("profile", OWN)
def test_any_number_of_columns_comes_back(columns, profile):
    rng = np.random.default_rng(columns)
    pattern = ScanPattern(3, columns, 0.0, -10.0)
    range_m = (rng.random((3, columns)) * 50 * (rng.random((3, columns)) < 0.7)).astype(np.float32)
    scan = RangeScan(pattern, range_m, np.zeros_like(range_m))
    back = decode(encode_scan(scan, 0.02, profile=profile))
    assert np.linalg.norm(back.points - scan.cloud().points, axis=1).max(initial=0) <= 0.02


@pytest.mark.parametrize("profile", OWN)
def test_a_scan_becomes_the_same_bytes_every_time(profile):
    first = encode_scan(street(), 0.01, profile=profile)
    encode_scan(street(seed=2, columns=500), 0.1, profile=profile)
    assert encode_scan(street(), 0.01, profile=profile) == first


def test_profiles_are_worth_their_time():
    scan = street(columns=1800)
    sizes = [len(encode_scan(scan, 0.02, profile=profile)) for profile in OWN]
    assert sizes[0] > 1.5 * sizes[1]


@settings(deadline=None)  # the machine may be busy
@given(clouds, st.sampled_from([0.01, 0.02, 0.1]), PROFILES)
def test_every_point_of_a_cloud_comes_back_within_the_bound(points, bound_m, profile):
    back = decode(encode_cloud(cloud_of(points), bound_m, profile=profile, intensity=True))
    assert back.points.shape == points.shape
    named = np.round(back.intensity * 255).astype(int)
    assert sorted(named) == list(range(len(points)))
    error_m = np.linalg.norm(back.points.astype(float) - points[named].astype(float), axis=1)
    assert np.all(error_m <= bound_m)


@settings(deadline=None)  # the machine may be busy
@given(clouds)
def test_the_fast_profile_keeps_the_order_of_a_cloud(points):
    back = decode(encode_cloud(cloud_of(points), 0.05, profile="fast"))
    assert np.all(np.linalg.norm(back.points.astype(float) - points.astype(float), axis=1) <= 0.05)


def test_points_that_coincide_all_come_back():
    points = np.repeat(np.array([[1, 2, 3], [4, 5, 6]], np.float32), [1000, 7], axis=0)
    back = decode(encode_cloud(cloud_of(points), 0.02)).points
    assert np.sum(np.abs(back - [1, 2, 3]).max(axis=1) < 0.02) == 1000
    assert np.sum(np.abs(back - [4, 5, 6]).max(axis=1) < 0.02) == 7


@settings(deadline=None)  # the machine may be busy
@given(ranges, PROFILES)
def test_intensity_comes_back_within_half_a_byte_step(range_m, profile):
    scan = scan_of(range_m)
    back = decode(encode_scan(scan, 0.02, profile=profile, intensity=True))
    assert np.allclose(back.intensity, scan.cloud().intensity, atol=0.5 / 255 + 1e-6)


@pytest.mark.parametrize("profile", OWN)
def test_an_empty_scan_and_an_empty_cloud_have_no_points(profile):
    scan = scan_of(np.zeros((4, 16), np.float32))
    cloud = cloud_of(np.zeros((0, 3), np.float32))
    assert decode(encode_scan(scan, 0.02, profile=profile)).points.shape == (0, 3)
    assert decode(encode_cloud(cloud, 0.02, profile=profile)).points.shape == (0, 3)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1.0])
def test_a_range_that_is_no_distance_is_refused(bad):
    range_m = np.ones((4, 16), np.float32)
    range_m[1, 3] = bad
    with pytest.raises(CodecError, match=r"finite|range"):
        encode_scan(scan_of(range_m), 0.02)


@pytest.mark.parametrize("profile", OWN)
@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e9])
def test_a_coordinate_out_of_reach_is_refused(bad, profile):
    points = np.ones((5, 3), np.float32)
    points[2, 1] = bad
    with pytest.raises(CodecError, match="coordinate"):
        encode_cloud(cloud_of(points), 0.02, profile=profile)


def test_a_distance_that_float32_cannot_hold_within_the_bound_is_refused_with_the_limit():
    with pytest.raises(CodecError, match=r"float32 ends at 209\.7 m"):
        encode_scan(scan_of(np.full((4, 16), 300, np.float32)), 0.0001)
    with pytest.raises(CodecError, match=r"profile fast ends at 11\.5 m"):
        encode_scan(scan_of(np.full((4, 16), 50, np.float32)), 0.0001, profile="fast")


@pytest.mark.parametrize("bound_m", [0.0, -1.0, np.nan, 11.0, 1e-5])
def test_a_bound_that_makes_no_sense_is_refused(bound_m):
    with pytest.raises(CodecError, match=r"needs 0\.0001 to 10"):
        encode_scan(scan_of(np.ones((4, 16), np.float32)), bound_m)


def test_a_payload_of_draco_is_refused_by_its_prefix_before_anything_decodes_it():
    payload = bytearray(encode_scan(scan_of(np.ones((4, 16), np.float32)), 0.02))
    payload[4] = 6  # as version 1 of the protocol had it
    with pytest.raises(CodecError, match="form 6"):
        decode(bytes(payload))


def test_an_unknown_profile_is_refused_with_the_known_ones():
    with pytest.raises(CodecError, match="'tiny': must be one of fast, default$"):
        encode_scan(scan_of(np.ones((4, 16), np.float32)), 0.02, profile="tiny")


@settings(deadline=None)  # the machine may be busy
@given(st.binary(max_size=200))
def test_random_bytes_raise_one_kind_of_error(data):
    with pytest.raises(CodecError):
        decode(data)


@settings(deadline=None)  # the machine may be busy
@given(st.sampled_from(list(Form)), st.binary(max_size=300), st.integers(0, 70))
def test_random_sections_raise_one_kind_of_error(form, data, points):
    body = Head(form, points, 0.02, 4, 16, 2.0, -24.9).seal(*[data[n::7] for n in range(7)])
    try:
        decode(body)
    except CodecError:
        return
    assert points == 0


def part_of(scan: RangeScan, rings: slice, columns: slice) -> RangeScan:
    range_m = np.zeros_like(scan.range_m)
    range_m[rings, columns] = scan.range_m[rings, columns]
    return RangeScan(scan.pattern, range_m, scan.intensity)


@settings(deadline=None)
@given(st.integers(0, 31), st.integers(1, 32), st.integers(0, 357), st.integers(1, 200), PROFILES)
def test_a_part_of_a_scan_takes_the_place_of_its_own_points(ring, rings, column, columns, profile):
    part = part_of(street(), slice(ring, ring + rings), slice(column, column + columns))
    payload = encode_scan(part, 0.02, profile=profile, intensity=True)
    back, sent = decode(payload), part.cloud()
    assert back.points.shape == sent.points.shape
    assert np.linalg.norm(back.points - sent.points, axis=1).max(initial=0) <= 0.02
    assert np.allclose(back.intensity, sent.intensity, atol=0.5 / 255 + 1e-6)


def test_empty_rings_and_columns_cost_next_to_nothing():
    part = part_of(street(columns=1800), slice(3, 5), slice(20, 41))
    assert len(encode_scan(part, 0.02)) < 350


def payloads() -> list[bytes]:
    scan, ringed = street(columns=64), street(columns=64).cloud()
    loose = cloud_of(np.random.default_rng(0).normal(0, 9, (200, 3)).astype(np.float32))
    made = [encode_scan(scan, 0.02, profile=profile) for profile in OWN]
    part = part_of(scan, slice(3, 9), slice(20, 41))
    made += [encode_scan(part, 0.02, profile=profile) for profile in OWN[1:]]
    made += [encode_cloud(loose, 0.02, profile=profile) for profile in OWN]
    made += [encode_cloud(ringed, 0.02, profile=profile) for profile in OWN[1:]]
    return made


PAYLOADS = payloads()


def test_the_payloads_to_be_damaged_have_all_forms():
    assert {Form(payload[4]) for payload in PAYLOADS} == set(Form)


@settings(max_examples=1000, deadline=None)
@given(st.data())
def test_a_damaged_payload_decodes_or_raises_one_kind_of_error(data):
    payload = bytearray(data.draw(st.sampled_from(PAYLOADS)))
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(payload)))
    for damaged in (bytes(payload), bytes(payload[:cut])):
        try:
            decode(damaged)
        except CodecError:
            continue


@pytest.mark.parametrize("form", list(Form))
def test_a_payload_that_claims_more_than_the_limit_is_refused_before_allocation(form):
    head = PREFIX.pack(b"SCAN", form, 0, 4, 16, 2**32 - 1, 2.0, -24.9, 0.02, 1, 0)
    with pytest.raises(CodecError, match="limit 1048576"):
        decode(head + b"x")


@pytest.mark.parametrize("form", [Form.PLANES, Form.IMAGE, Form.RINGS])
def test_a_pattern_beyond_the_limit_is_refused_before_allocation(form):
    head = PREFIX.pack(b"SCAN", form, 0, 65535, 2**31, 1, 2.0, -24.9, 0.02, 1, 0)
    with pytest.raises(CodecError, match="beams"):
        decode(head + b"x")


def test_a_frame_that_decompresses_to_more_than_it_claims_is_refused():
    head = Head(Form.PLANES, 64, 0.02, 4, 16, 2.0, -24.9)
    with pytest.raises(CodecError, match="claims 50000000"):
        decode(head.seal(zstandard.ZstdCompressor().compress(bytes(50_000_000))))
    silent = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(50_000_000))
    with pytest.raises(CodecError):
        decode(head.seal(silent))


def test_bytes_behind_a_payload_are_refused():
    with pytest.raises(CodecError, match="claims"):
        decode(PAYLOADS[1] + b"\0")


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


@pytest.mark.parametrize("bound_m", [0.0001, 10.0])
def test_the_least_and_the_largest_bound_are_allowed(bound_m):
    scan = scan_of(np.full((4, 16), 20.0, np.float32))
    assert len(decode(encode_scan(scan, bound_m)).points) == 64


@pytest.mark.parametrize("profile", OWN)
def test_intensity_is_sent_only_if_asked_for(profile):
    scan = scan_of(np.ones((4, 16), np.float32))
    assert decode(encode_scan(scan, 0.02, profile=profile)).intensity.max() == 0
    assert decode(encode_cloud(scan.cloud(), 0.02, profile=profile)).intensity.max() == 0


@pytest.mark.parametrize("profile", OWN)
def test_ranges_of_double_precision_become_the_same_bytes(profile):
    single = street().range_m
    double = RangeScan(street().pattern, single.astype(np.float64), street().intensity)
    assert encode_scan(double, 0.02, profile=profile) == encode_scan(
        street(), 0.02, profile=profile
    )


def test_a_payload_may_be_an_array_of_bytes():
    payload = encode_scan(street(), 0.02)
    back = decode(np.frombuffer(payload, np.uint8))
    assert np.array_equal(back.points, decode(payload).points)


def test_a_cloud_has_at_most_as_many_points_as_the_limit(monkeypatch):
    monkeypatch.setattr("protocol.codec.forms.MAX_POINTS", 5)
    assert len(decode(encode_cloud(cloud_of(np.ones((5, 3), np.float32)), 0.02)).points) == 5
    with pytest.raises(CodecError, match="cloud has 6 points, limit 5"):
        encode_cloud(cloud_of(np.ones((6, 3), np.float32)), 0.02)


def test_the_limit_of_a_cloud_is_that_of_its_farthest_corner():
    corner = cloud_of(np.full((3, 3), 150, np.float32))
    with pytest.raises(CodecError, match=r"coordinate 259\.8 m at .* float32 ends at 209\.7 m"):
        encode_cloud(corner, 0.0001)


def test_float32_may_take_half_of_the_bound_and_no_more():
    scan = scan_of(np.full((4, 16), 209, np.float32))
    assert len(decode(encode_scan(scan, 0.0001)).points) == 64
    with pytest.raises(CodecError, match="range 211.0 m at"):
        encode_scan(scan_of(np.full((4, 16), 211, np.float32)), 0.0001)


@pytest.mark.parametrize("points", [0, 63])
def test_a_scan_that_holds_another_number_of_points_than_it_claims_is_refused(points):
    payload = encode_scan(scan_of(np.ones((4, 16), np.float32)), 0.02, profile="fast")
    head, reader = read_payload(payload)
    with pytest.raises(CodecError, match=f"claims {points} points, holds 64"):
        decode(replace(head, points=points).seal(reader.section()))


@settings(deadline=None)  # the machine may be busy
@given(
    st.lists(st.integers(-9000, 9000), min_size=1, max_size=12, unique=True),
    st.booleans(),
    PROFILES,
)
def test_rings_of_any_spacing_come_back(units, with_intensity, profile):
    pattern = ScanPattern.of_rings([one / 100 for one in sorted(units, reverse=True)], 8)
    range_m = np.full((len(units), 8), 30, np.float32)
    scan = RangeScan(pattern, range_m, np.full_like(range_m, 0.5))
    back = decode(encode_scan(scan, 0.02, profile=profile, intensity=with_intensity))
    assert np.linalg.norm(back.points - scan.cloud().points, axis=1).max() <= 0.02


@pytest.mark.parametrize("rings", [[], [1.0, 1.0], [-1.0, 1.0], [91.0, 0.0]])
def test_rings_that_do_not_go_down_are_refused(rings):
    with pytest.raises(CodecError):
        ScanPattern.of_rings(rings, 8)


def test_elevations_that_are_not_one_a_ring_are_refused():
    pattern = ScanPattern.of_rings([1.0, 0.0, -3.0], 8)
    range_m = np.full((3, 8), 30, np.float32)
    payload = bytearray(encode_scan(RangeScan(pattern, range_m, range_m), 0.02, profile="fast"))
    payload[6:8] = (4).to_bytes(2, "little")  # channels
    with pytest.raises(CodecError, match="elevations of 4 rings take 6 bytes"):
        decode(bytes(payload))


def test_elevations_that_go_up_are_refused_on_the_wire():
    pattern = ScanPattern.of_rings([1.0, 0.0, -3.0], 8)
    range_m = np.full((3, 8), 30, np.float32)
    payload = bytearray(encode_scan(RangeScan(pattern, range_m, range_m), 0.02, profile="fast"))
    at = PREFIX.size + 4
    payload[at : at + 6] = np.array([100, 200, -300], "<i2").tobytes()
    with pytest.raises(CodecError, match="each must lie below the one before"):
        decode(bytes(payload))


def test_a_cloud_that_claims_elevations_is_refused():
    payload = bytearray(encode_cloud(cloud_of(np.zeros((3, 3), np.float32)), 0.02, profile="fast"))
    payload[5] |= 2
    with pytest.raises(CodecError, match="claims elevations"):
        decode(bytes(payload))
