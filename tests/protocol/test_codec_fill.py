import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.codec import decode, encode_scan
from protocol.scans import RangeScan, ScanPattern

OWN = ["fast", "default", "compact"]
PROFILES = st.sampled_from(OWN)
BOUNDS_M = st.sampled_from([0.001, 0.01, 0.05, 0.2, 1.0, 5.0])


@st.composite
def scans(draw) -> RangeScan:
    """Surfaces with noise and steps, seen by any number of beams, many of them lost."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    channels, columns = draw(st.integers(1, 6)), draw(st.integers(1, 90))
    pattern = ScanPattern(channels, columns, 5.0, draw(st.sampled_from([-5.0, -25.0])))
    shape = (channels, columns)
    farthest_m = draw(st.sampled_from([0.5, 5.0, 120.0]))
    range_m = np.cumsum(rng.normal(0, draw(st.sampled_from([0.0, 0.02, 0.3])), shape), axis=1)
    range_m += farthest_m * (0.1 + np.round(rng.random(shape) * draw(st.sampled_from([0.6, 0.9]))))
    lost = rng.random(shape) < draw(st.sampled_from([0.05, 0.3, 0.7, 1.0]))
    lost |= np.arange(columns) < columns * draw(st.sampled_from([0.0, 0.4]))
    range_m = np.where(lost, 0, np.abs(range_m).clip(0, 120)).astype(np.float32)
    return RangeScan(pattern, range_m, np.full(shape, 0.5, np.float32))


def opened(scan: RangeScan, bound_m: float, profile: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns the decoded points, and which of them were measured."""
    back = decode(encode_scan(scan, bound_m, profile=profile, intensity=True, fill=True))
    return back.points.astype(float), back.intensity > 0


def farthest_m(found: np.ndarray, points: np.ndarray) -> float:
    """Returns how far a found point may lie from the nearest of the points."""
    away = np.linalg.norm(found[:, None] - points[None].astype(float), axis=2)
    return float(away.min(axis=1, initial=np.inf).max(initial=0))


def wall(lost: np.ndarray, away_m: float = 20.0) -> RangeScan:
    pattern = ScanPattern(*lost.shape, 5.0, -5.0)
    range_m = np.where(lost, 0, away_m).astype(np.float32)
    return RangeScan(pattern, range_m, np.ones(lost.shape, np.float32))


@settings(deadline=None, max_examples=300)  # the machine may be busy
@given(scans(), BOUNDS_M, PROFILES)
def test_a_filled_scan_keeps_the_bound_both_ways(scan, bound_m, profile):
    points, measured = opened(scan, bound_m, profile)
    want = scan.cloud().points
    assert np.count_nonzero(measured) == len(want)
    assert np.linalg.norm(points[measured] - want, axis=1).max(initial=0) <= bound_m
    assert farthest_m(points[~measured], want) <= bound_m


@settings(deadline=None, max_examples=200)
@given(scans(), BOUNDS_M, PROFILES)
def test_only_holes_of_a_beam_or_two_between_returns_are_filled(scan, bound_m, profile):
    points, measured = opened(scan, bound_m, profile)
    hit = scan.range_m > 0
    near, far = (np.stack([np.roll(hit, n, 1), np.roll(hit, -n, 1)]) for n in (1, 2))
    may = ~hit & near.any(axis=0) & (near | far).all(axis=0)
    along = points[~measured] @ scan.pattern.directions.reshape(-1, 3).T.astype(float)
    beams = along.argmax(axis=1)
    assert may.ravel()[beams].all()
    assert len(set(beams)) == len(beams)


@settings(deadline=None)
@given(scans(), BOUNDS_M, PROFILES)
def test_by_default_exactly_the_beams_that_returned_come_back(scan, bound_m, profile):
    back = decode(encode_scan(scan, bound_m, profile=profile))
    assert len(back.points) == np.count_nonzero(scan.range_m)


@settings(deadline=None)
@given(scans(), BOUNDS_M, PROFILES)
def test_a_filled_scan_becomes_the_same_bytes_with_and_without_others_before_it(
    scan, bound_m, profile
):
    first = encode_scan(scan, bound_m, profile=profile, fill=True)
    encode_scan(wall(np.zeros((8, 300), bool)), 0.5, profile=profile, fill=True)
    assert encode_scan(scan, bound_m, profile=profile, fill=True) == first


@pytest.mark.parametrize("profile", OWN)
@pytest.mark.parametrize(
    ("lost", "filled"),
    [
        ([5], 1),
        ([5, 6], 2),
        ([5, 6, 7], 0),  # too wide
        ([1], 1),
        ([719], 1),
        ([*range(300, 720)], 0),  # sky
        ([1, 3, 5, 7], 4),
    ],
)
def test_a_hole_in_a_wall_is_filled_where_it_is_no_wider_than_two_beams(profile, lost, filled):
    mask = np.zeros((16, 720), bool)
    mask[7, lost] = True
    points, measured = opened(wall(mask), 0.5, profile)
    assert np.count_nonzero(~measured) == filled
    assert np.allclose(np.linalg.norm(points[~measured], axis=1), 20, atol=0.5)


@pytest.mark.parametrize("profile", OWN)
def test_where_the_next_beam_passes_farther_away_than_the_bound_nothing_is_filled(profile):
    mask = np.zeros((16, 720), bool)
    mask[:, ::7] = True
    for away_m, filled in ((10.0, True), (40.0, False)):  # beams are 0.5 degrees apart
        assert np.any(~opened(wall(mask, away_m), 0.2, profile)[1]) == filled


@pytest.mark.parametrize("profile", OWN)
def test_where_rings_are_empty_holes_of_the_others_are_filled(profile):
    mask = np.zeros((16, 720), bool)
    mask[:9], mask[:, 100:103], mask[12, ::5] = True, True, True
    points, measured = opened(wall(mask), 0.5, profile)
    assert np.count_nonzero(~measured) >= 100
    assert farthest_m(points[~measured], wall(mask).cloud().points) <= 0.5


@pytest.mark.parametrize("profile", OWN)
def test_a_lossy_scan_takes_fewer_bytes_when_filled(profile):
    scan = wall(np.random.default_rng(0).random((32, 1800)) < 0.1)
    exact = encode_scan(scan, 0.2, profile=profile)
    assert len(encode_scan(scan, 0.2, profile=profile, fill=True)) < 0.5 * len(exact)
