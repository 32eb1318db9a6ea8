"""Which anchors are vehicles."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from learning.examples import targets_of
from perception.boxes import overlaps
from perception.pillars.config import SMALL
from perception.pillars.network import boxes_of, middle_of
from perception.pillars.windows import Window

WINDOW = Window(np.array([-16.0, -16.0]), 128, 128)
SIDE = 64


def car(x: float, y: float, yaw: float) -> list[float]:
    return [x, y, 0.75, 4.4, 1.7, 1.5, yaw]


@given(st.floats(-12, 12), st.floats(-12, 12), st.floats(-3.2, 3.2))
def test_every_sure_vehicle_has_an_anchor_whose_terms_are_its_box(
    x: float, y: float, yaw: float
) -> None:
    boxes = np.array([car(x, y, yaw)])
    targets = targets_of(boxes, np.array([True]), WINDOW, SMALL)
    assert len(targets.place) >= 1
    kind, cell = np.divmod(targets.place.astype(np.int64), SIDE**2)
    said = boxes_of(targets.terms, middle_of(cell, WINDOW, SMALL), kind, SMALL)
    assert overlaps(said, boxes)[1].min() == pytest.approx(1, abs=1e-3)
    assert targets.counts[targets.place].all()


def test_anchors_near_a_vehicle_do_not_count_and_far_ones_are_nothing() -> None:
    targets = targets_of(np.array([car(0.25, 0.25, 0.0)]), np.array([True]), WINDOW, SMALL)
    grid = targets.counts.reshape(2, SIDE, SIDE)
    assert grid[:, 0].all()
    assert 0 < (~grid).sum() < 40


def test_a_faint_vehicle_is_neither_asked_for_nor_denied() -> None:
    boxes = np.array([car(0.25, 0.25, 0.0)])
    targets = targets_of(boxes, np.array([False]), WINDOW, SMALL)
    assert len(targets.place) == 0
    kind, row, column = 0, SIDE // 2, SIDE // 2
    assert not targets.counts.reshape(2, SIDE, SIDE)[kind, row, column]


def test_an_empty_window_is_all_nothing() -> None:
    targets = targets_of(np.zeros((0, 7)), np.zeros(0, np.bool_), WINDOW, SMALL)
    assert not targets.is_vehicle.any()
    assert targets.counts.all()
