"""Long series with fewer points."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from studies.thin import MOST_POINTS, kept_points, line


def test_a_peak_of_one_point_is_kept() -> None:
    y = [0.0] * 36_000
    y[12_345], y[12_347] = 9.0, -9.0
    thin = line("s", range(36_000), y)
    assert len(thin.x) <= MOST_POINTS
    assert {12_345.0, 12_347.0, 0.0, 35_999.0} <= set(thin.x)
    assert (max(thin.y), min(thin.y)) == (9.0, -9.0)


def test_a_gap_stays_a_gap() -> None:
    y = [None if 5_000 <= i < 5_002 else 1.0 for i in range(20_000)]
    assert None in line("s", range(20_000), y).y


@given(
    st.lists(st.floats(-1e6, 1e6) | st.just(float("nan")), min_size=1, max_size=200),
    st.integers(5, 60),
)
def test_extremes_are_kept_in_order(values: list[float], most: int) -> None:
    array = np.array(values)
    kept = kept_points(array, most)
    assert kept == sorted(set(kept))
    assert len(kept) <= most
    if not np.isnan(array).all():
        assert np.nanmax(array[kept]) == np.nanmax(array)
        assert np.nanmin(array[kept]) == np.nanmin(array)
