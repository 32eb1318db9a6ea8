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
from protocol.messages import ObjectClass

WINDOW = Window(np.array([-16.0, -16.0]), 128, 128)
SIDE = 64
CARS = np.array([ObjectClass.CAR], np.uint8)


def car(x: float, y: float, yaw: float) -> list[float]:
    return [x, y, 0.75, 4.4, 1.7, 1.5, yaw]


@given(st.floats(-12, 12), st.floats(-12, 12), st.floats(-3.2, 3.2))
def test_every_sure_vehicle_has_an_anchor_whose_terms_are_its_box(
    x: float, y: float, yaw: float
) -> None:
    boxes = np.array([car(x, y, yaw)])
    targets = targets_of(boxes, CARS, np.array([True]), WINDOW, SMALL)
    assert len(targets.place) >= 1
    kind, cell = np.divmod(targets.place.astype(np.int64), SIDE**2)
    decoded = boxes_of(targets.terms, middle_of(cell, WINDOW, SMALL), kind, SMALL)
    assert overlaps(decoded, boxes)[1].min() == pytest.approx(1, abs=1e-3)
    assert targets.counts[targets.place].all()


@pytest.mark.parametrize("yaw_deg", range(0, 91, 15))
def test_a_vehicle_has_as_good_anchors_at_every_yaw(yaw_deg: int) -> None:
    boxes = np.array([car(0.25, 0.25, np.radians(yaw_deg))])
    targets = targets_of(boxes, CARS, np.array([True]), WINDOW, SMALL)
    kinds, counts = np.unique(targets.place // SIDE**2, return_counts=True)
    lying_along = [0] * (yaw_deg < 60) + [1] * (yaw_deg > 30)
    assert kinds.tolist() == lying_along
    assert counts.min() >= 3


def test_anchors_near_a_vehicle_do_not_count_and_far_ones_are_nothing() -> None:
    targets = targets_of(np.array([car(0.25, 0.25, 0.0)]), CARS, np.array([True]), WINDOW, SMALL)
    grid = targets.counts.reshape(SMALL.kinds, SIDE, SIDE)
    assert grid[:, 0].all()
    assert 0 < (~grid).sum() < 40


def test_a_faint_vehicle_is_neither_asked_for_nor_denied() -> None:
    boxes = np.array([car(0.25, 0.25, 0.0)])
    targets = targets_of(boxes, CARS, np.array([False]), WINDOW, SMALL)
    assert len(targets.place) == 0
    kind, row, column = 0, SIDE // 2, SIDE // 2
    assert not targets.counts.reshape(SMALL.kinds, SIDE, SIDE)[kind, row, column]


def test_an_empty_window_is_all_nothing() -> None:
    targets = targets_of(np.zeros((0, 7)), CARS[:0], np.zeros(0, np.bool_), WINDOW, SMALL)
    assert not targets.is_vehicle.any()
    assert targets.counts.all()


@pytest.mark.parametrize("anchor", SMALL.anchors, ids=lambda a: a.object_class.name)
def test_an_object_is_asked_for_by_the_anchors_of_its_class_alone(anchor) -> None:
    boxes = np.array([[1.25, 0.75, anchor.middle_m, *anchor.size_m, 0.0]])
    classes = np.array([anchor.object_class], np.uint8)
    targets = targets_of(boxes, classes, np.array([True]), WINDOW, SMALL)
    kind, cell = np.divmod(targets.place.astype(np.int64), SIDE**2)
    assert len(kind) >= 1
    assert set(SMALL.classes()[kind].tolist()) == {int(anchor.object_class)}
    decoded = boxes_of(targets.terms, middle_of(cell, WINDOW, SMALL), kind, SMALL)
    np.testing.assert_allclose(
        decoded[:, :6], np.repeat(boxes[:, :6], len(kind), axis=0), atol=1e-3
    )
