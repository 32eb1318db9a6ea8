"""From points to windows, pillars and anchors, and back to boxes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perception.pillars.config import SMALL, STRIDE
from perception.pillars.network import boxes_of, middle_of, terms_of
from perception.pillars.windows import HALO_M, LONG_M, STEP_M, Window, cover, pillars_of

CELLS = 64


@settings(max_examples=80)
@given(st.lists(st.tuples(st.floats(-400, 400), st.floats(-400, 400)), min_size=1, max_size=60))
def test_every_point_lies_in_the_core_of_a_window(places: list[tuple[float, float]]) -> None:
    points = np.column_stack([np.array(places), np.zeros(len(places))]).astype(np.float32)
    windows = cover(points, SMALL.cell_m)
    low = np.array([window.low for window in windows])
    side_m = np.array([window.size[::-1] for window in windows]) * SMALL.cell_m
    off = points[:, None, :2] - low[None]
    slack_m = 1e-3
    inside = (off >= HALO_M - slack_m) & (off <= side_m - HALO_M + slack_m)
    assert inside.all(axis=2).any(axis=1).all()
    assert len(windows) <= len(points)
    assert (side_m <= LONG_M + 2 * HALO_M + STEP_M).all()


def area_m2(points: np.ndarray) -> float:
    return sum(w.rows * w.columns for w in cover(points, 0.25)) * 0.25**2


def test_windows_follow_the_road_and_nothing_needs_none() -> None:
    rng = np.random.default_rng(1)
    road = rng.uniform([-200, -10, 0], [200, 10, 0], (5000, 3)).astype(np.float32)
    assert area_m2(road) == area_m2(road[:, [1, 0, 2]].copy())
    assert area_m2(road) <= 2.2 * 400 * 20
    assert cover(road[:0], 0.25) == []


def test_pillars_hold_the_points_inside_once_and_know_where_they_lie() -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform(-12, 12, (4000, 3)).astype(np.float32)
    height_m = rng.uniform(-2, 4, 4000).astype(np.float32)
    window = Window(np.array([-8.0, -8.0]), CELLS, 80)
    pillars = pillars_of(points, height_m, window, SMALL)
    inside = (np.abs(points[:, 0]) < 8) & (points[:, 1] >= -8)
    inside &= (height_m >= SMALL.low_m) & (height_m < SMALL.high_m)
    assert len(pillars.features) == inside.sum() == pillars.starts[-1]
    assert (np.diff(pillars.starts) > 0).all()
    assert len(set(pillars.cell)) == len(pillars.cell)
    np.testing.assert_allclose(np.sort(pillars.features[:, 0]), np.sort(height_m[inside]))
    assert np.abs(pillars.features[:, 4:6]).max() <= SMALL.cell_m / 2 + 1e-5
    means = np.add.reduceat(pillars.features[:, 1:4], pillars.starts[:-1])
    np.testing.assert_allclose(means, 0, atol=1e-3)
    place = np.floor((points[inside, :2] + 8) / SMALL.cell_m).astype(int)
    assert set(pillars.cell) == set((place[:, 1] * CELLS + place[:, 0]).tolist())


@given(
    st.tuples(st.floats(-9, 9), st.floats(-9, 9), st.floats(0, 2)),
    st.tuples(st.floats(2, 8), st.floats(1, 3), st.floats(1, 3)),
    st.floats(-np.pi, np.pi),
    st.integers(0, 1),
)
def test_a_box_written_as_terms_is_the_same_box(
    place: tuple[float, ...], sizes: tuple[float, ...], yaw: float, kind: int
) -> None:
    window = Window(np.array([-8.0, -8.0]), CELLS, 80)
    box = np.array([[*place, *sizes, yaw]])
    cell = np.array([300])
    middle = middle_of(cell, window, SMALL)
    again = boxes_of(
        terms_of(box, middle, np.array([kind]), SMALL), middle, np.array([kind]), SMALL
    )
    np.testing.assert_allclose(again[0, :6], box[0, :6], rtol=1e-5, atol=1e-5)
    assert np.sin(again[0, 6] - yaw) == pytest.approx(0, abs=1e-5)


def test_output_cells_are_numbered_along_x_first() -> None:
    window = Window(np.array([10.0, 20.0]), CELLS, 80)
    step_m = STRIDE * SMALL.cell_m
    middles = middle_of(np.array([0, 1, CELLS // STRIDE]), window, SMALL)
    np.testing.assert_allclose(middles[1] - middles[0], [step_m, 0])
    np.testing.assert_allclose(middles[2] - middles[0], [0, step_m])
