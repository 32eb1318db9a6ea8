import numpy as np
import pytest

from protocol.codec import decode, encode_scan
from protocol.errors import CodecError
from protocol.scans import RangeScan, ScanPattern
from studies.scan_error import ScanError


def lossy(seed: int = 0) -> RangeScan:
    rng = np.random.default_rng(seed)
    pattern = ScanPattern(32, 900, 2.0, -24.9)
    range_m = 15 + rng.normal(0, 0.02, (32, 900))
    range_m[rng.random((32, 900)) < 0.1] = 0
    return RangeScan(pattern, range_m.astype(np.float32), np.zeros((32, 900), np.float32))


def test_a_scan_that_came_back_as_it_was_has_no_error():
    scan = lossy()
    assert ScanError.of(scan, scan.cloud().points) == ScanError(0.0, 0.0, 0)


def test_each_point_is_compared_with_itself_and_each_filled_one_with_a_measured_one_nearby():
    scan = lossy()
    back = decode(encode_scan(scan, 0.2, fill=True)).points
    error = ScanError.of(scan, back)
    assert error.filled == len(back) - np.count_nonzero(scan.range_m) > 1000
    assert 0.1 < error.moved_m <= 0.2
    assert 0.05 < error.added_m <= 0.2
    assert error.worst_m == max(error.moved_m, error.added_m)


def test_a_point_where_nothing_was_measured_is_far_away():
    scan = lossy()
    hole = np.argwhere(scan.range_m == 0)[0]
    ghost = scan.pattern.directions[tuple(hole)][None] * np.float32(20)
    error = ScanError.of(scan, np.concatenate([scan.cloud().points, ghost]))
    assert error.moved_m == 0
    assert error.added_m > 4
    assert error.filled == 1


def test_a_scan_that_lacks_a_point_or_has_one_twice_is_refused():
    points = lossy().cloud().points
    for bad in (points[1:], np.concatenate([points, points[:1]])):
        with pytest.raises(CodecError, match="one point for each beam"):
            ScanError.of(lossy(), bad)
