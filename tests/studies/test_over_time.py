"""Long series with fewer points."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from studies.over_time import INTERVALS, MAX_POINTS, thinned_series, thinning_note


def test_a_peak_of_one_point_is_kept() -> None:
    y = [0.0] * 36_000
    y[12_345], y[12_347] = 9.0, -9.0
    thin = thinned_series("s", range(36_000), y)
    assert len(thin.x) == INTERVALS
    assert (max(thin.high or ()), min(thin.low or ())) == (9.0, -9.0)
    assert thinning_note((thin,))


def test_a_short_series_is_as_it_was() -> None:
    thin = thinned_series("s", range(MAX_POINTS), [None, *range(1, MAX_POINTS)])
    assert thin.y == (None, *range(1, MAX_POINTS))
    assert thin.low is None
    assert not thinning_note((thin,))


def test_a_long_gap_stays_a_gap() -> None:
    y = [None if 5_000 <= i < 9_000 else 1.0 for i in range(20_000)]
    thin = thinned_series("s", range(20_000), y)
    gap = [x for x, value in zip(thin.x, thin.y, strict=True) if value is None]
    assert 5_000 <= gap[0] < 5_100
    assert 8_850 < gap[-1] < 9_000


@given(st.integers(MAX_POINTS + 1, 5_000), st.integers(0, 100))
def test_the_mean_lies_between_the_extremes(length: int, seed: int) -> None:
    y = np.random.default_rng(seed).normal(size=length)
    thin = thinned_series("s", range(length), y.tolist())
    assert thin.low is not None
    assert thin.high is not None
    rows = zip(thin.low, thin.y, thin.high, strict=True)
    assert all(low <= mean <= high for low, mean, high in rows)
    assert (min(thin.low), max(thin.high)) == (y.min(), y.max())
