"""Thinning leaves no gap wider than the spacing, and removes only dense beams."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from perception.thin import thin

SHAPE = (4, 720)
COLUMN_RAD = 2 * math.pi / 720


def kept(range_m: np.ndarray, spacing_m: float) -> np.ndarray:
    keep = np.ones(range_m.shape, np.uint8)
    thin(range_m.astype(np.float32), spacing_m, keep)
    return keep


@given(st.floats(0.5, 100), st.floats(0, 2))
def test_on_a_wall_all_round_neighbours_are_as_close_as_asked_or_none_is_left_out(
    metres, spacing_m
):
    columns = np.flatnonzero(kept(np.full(SHAPE, metres), spacing_m)[0])
    gap_m = float(np.diff(columns, append=columns[0] + 720).max()) * metres * COLUMN_RAD
    assert gap_m <= spacing_m * 1.001 or len(columns) == 720


def test_nearer_walls_lose_more_beams():
    left = [int(kept(np.full(SHAPE, metres), 0.4).sum()) for metres in (1, 4, 16, 64)]
    assert left == sorted(left)
    assert left[0] < left[-1] == 4 * 720


@given(st.integers(0, 2**32 - 1))
def test_what_is_kept_at_a_wide_spacing_is_kept_at_a_narrow_one(seed):
    range_m = np.random.default_rng(seed).uniform(0, 60, SHAPE)
    assert not (kept(range_m, 0.4) > kept(range_m, 0.1)).any()


@pytest.mark.parametrize("already", [0, 1])
def test_beams_without_a_return_stay_as_they_are(already):
    keep = np.full(SHAPE, already, np.uint8)
    thin(np.zeros(SHAPE, np.float32), 1.0, keep)
    assert (keep == already).all()
