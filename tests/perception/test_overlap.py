"""IoU of boxes, against areas counted point by point."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perception.boxes import overlaps, suppress

box = st.tuples(
    st.floats(-3, 3), st.floats(-3, 3), st.floats(-1, 1),
    st.floats(0.5, 5), st.floats(0.5, 3), st.floats(0.5, 2), st.floats(-4, 4),
)  # fmt: skip


def inside(boxes: np.ndarray, xy: np.ndarray) -> np.ndarray:
    off = xy - boxes[:2]
    cos, sin = np.cos(boxes[6]), np.sin(boxes[6])
    along, across = cos * off[:, 0] + sin * off[:, 1], cos * off[:, 1] - sin * off[:, 0]
    return (np.abs(along) <= boxes[3] / 2) & (np.abs(across) <= boxes[4] / 2)


@settings(max_examples=60, deadline=None)
@given(box, box)
def test_overlap_is_that_of_points_counted(a: tuple[float, ...], b: tuple[float, ...]) -> None:
    first, second = np.array(a), np.array(b)
    share = (np.arange(200) + 0.5) / 200 - 0.5
    along, across = (part.reshape(-1) for part in np.meshgrid(share * a[3], share * a[4]))
    cos, sin = np.cos(a[6]), np.sin(a[6])
    xy = np.stack([a[0] + cos * along - sin * across, a[1] + sin * along + cos * across], -1)
    counted_m2 = inside(second, xy).mean() * a[3] * a[4]
    bev, space = overlaps(first[None], second[None])
    counted = counted_m2 / (a[3] * a[4] + b[3] * b[4] - counted_m2)
    assert bev[0, 0] == pytest.approx(counted, abs=0.03)
    common_m = max(
        min(first[2] + first[5] / 2, second[2] + second[5] / 2)
        - max(first[2] - first[5] / 2, second[2] - second[5] / 2),
        0,
    )
    areas = first[3] * first[4], second[3] * second[4]
    common_m2 = bev[0, 0] * sum(areas) / (1 + bev[0, 0])
    volumes = areas[0] * first[5] + areas[1] * second[5]
    common_m3 = common_m2 * common_m
    assert space[0, 0] == pytest.approx(common_m3 / (volumes - common_m3), abs=1e-9)


@given(box)
def test_a_box_is_itself_and_a_half_turn_changes_nothing(a: tuple[float, ...]) -> None:
    first = np.array([a])
    turned = first + np.array([0, 0, 0, 0, 0, 0, np.pi])
    for other in (first, turned):
        bev, space = overlaps(first, other)
        assert bev[0, 0] == pytest.approx(1)
        assert space[0, 0] == pytest.approx(1)


def test_of_two_that_overlap_the_better_stays_whatever_their_order() -> None:
    boxes = np.array([[0, 0, 0, 4, 2, 1, 0], [0.5, 0, 0, 4, 2, 1, 0], [9, 0, 0, 4, 2, 1, 0]], float)
    scores = np.array([0.5, 0.9, 0.1])
    assert suppress(boxes, scores, iou=0.1).tolist() == [1, 2]
    assert sorted(suppress(boxes[::-1], scores[::-1], iou=0.1).tolist()) == [0, 1]
    assert suppress(np.zeros((0, 7)), np.zeros(0), iou=0.1).size == 0


def test_a_part_of_a_better_box_goes_however_small_their_iou() -> None:
    boxes = np.array([[0, 0, 1.7, 16, 2.5, 3.4, 0.0], [6.5, 0, 1, 2.0, 2.0, 2.0, 0.0]])
    assert suppress(boxes, np.array([0.9, 0.5]), iou=0.5).tolist() == [0]
    beside = boxes + np.array([[0.0] * 7, [0, 3.5, 0, 0, 0, 0, 0]])
    assert suppress(beside, np.array([0.9, 0.5]), iou=0.5).tolist() == [0, 1]
