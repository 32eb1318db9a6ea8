"""AP40 and overlap beside a second, plain way to compute each."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perception.boxes import overlaps
from studies.average_precision import (
    FALSE,
    HIT,
    NEITHER,
    Scene,
    Score,
    View,
    average_precision,
    outcomes,
)

Floats = npt.NDArray[np.float64]


def sides(box: Any) -> list[tuple[float, float, float]]:
    """A footprint as half planes a x + b y <= c."""
    x, y, _, length, width, _, yaw = box
    result = []
    for turn, size in ((0, length), (1, width), (2, length), (3, width)):
        a, b = np.cos(yaw + turn * np.pi / 2), np.sin(yaw + turn * np.pi / 2)
        result.append((a, b, a * x + b * y + size / 2))
    return result


def plain_iou(first: Any, second: Any) -> tuple[float, float]:
    """Corners of the intersection are the crossings of any two sides that lie within all sides."""
    lines = sides(first) + sides(second)
    corners = []
    for i, (a, b, c) in enumerate(lines):
        for d, e, f in lines[i + 1 :]:
            det = a * e - b * d
            if abs(det) > 1e-12:
                x, y = (c * e - b * f) / det, (a * f - c * d) / det
                if all(p * x + q * y <= r + 1e-9 for p, q, r in lines):
                    corners.append((x, y))
    area = 0.0
    if len(corners) > 2:
        middle = np.mean(corners, axis=0)
        around = sorted(corners, key=lambda p: np.arctan2(*(p - middle)[::-1]))
        for (x, y), (u, v) in zip(around, around[1:] + around[:1], strict=True):
            area += abs((x - middle[0]) * (v - middle[1]) - (y - middle[1]) * (u - middle[0])) / 2
    high = min(first[2] + first[5] / 2, second[2] + second[5] / 2)
    low = max(first[2] - first[5] / 2, second[2] - second[5] / 2)
    flat = [box[3] * box[4] for box in (first, second)]
    volume = area * max(high - low, 0)
    return (
        area / (sum(flat) - area),
        volume / (flat[0] * first[5] + flat[1] * second[5] - volume),
    )


def plain_ap40(scenes: Any, view: int, least: float) -> tuple[float, float, float | None]:
    """AP40 by its definition: one walk over all detections, one sum over 40 recalls."""
    ranked = sorted(
        ((-score, s, n) for s, scene in enumerate(scenes) for n, score in enumerate(scene[1]))
    )
    total = sum(int(scene[3].sum()) for scene in scenes)
    taken: set[tuple[int, int]] = set()
    verdicts: list[tuple[float, bool]] = []
    for negative, s, n in ranked:
        boxes, _, truth, due = scenes[s]
        best: tuple[bool, float, int] | None = None
        for m in range(len(truth)):
            iou = plain_iou(boxes[n], truth[m])[view]
            if iou > least and (s, m) not in taken:
                option = (bool(due[m]), iou, m)
                best = option if best is None or option[:2] > best[:2] else best
        if best is not None:
            taken.add((s, best[2]))
        if best is None or best[0]:
            verdicts.append((-negative, best is not None))
    points = []
    for threshold in {score for score, _ in verdicts}:
        kept = [hit for score, hit in verdicts if score >= threshold]
        points.append((sum(kept), sum(kept) / len(kept)))
    ap = sum(
        max((p for hits, p in points if 40 * hits >= k * total), default=0.0) for k in range(1, 41)
    )
    hits = sum(hit for _, hit in verdicts)
    return ap / 40, hits / total, hits / len(verdicts) if verdicts else None


def some_boxes(rng: np.random.Generator, count: int, span_m: float) -> Floats:
    low = [-span_m, -span_m, -0.5, 0.5, 0.5, 0.5, -4]
    return rng.uniform(low, [span_m, span_m, 0.5, 6, 3, 2, 4], (count, 7))


def ours(scenes: Any, view: View, least: float, fair: npt.NDArray[np.bool_] | None = None) -> Score:
    compared = [Scene.of(boxes, scores, truth) for boxes, scores, truth, _ in scenes]
    results = [
        outcomes(one, view, least, scene[3], np.ones(len(scene[0]), bool) if fair is None else fair)
        for one, scene in zip(compared, scenes, strict=True)
    ]
    due = sum(int(scene[3].sum()) for scene in scenes)
    return average_precision(results, [one.scores for one in compared], due)


@given(st.integers(0, 2**32), st.sampled_from([0.01, 0.1, 0.3, 0.5]), st.booleans())
@settings(max_examples=60, deadline=None)
def test_average_precision_agrees_with_its_definition(seed: int, least: float, flat: bool) -> None:
    rng = np.random.default_rng(seed)
    scenes = []
    for _ in range(rng.integers(1, 4)):
        truth = some_boxes(rng, rng.integers(0, 7), 9)
        moved = truth[rng.random(len(truth)) < 0.8]
        moved = moved + rng.normal(0, 0.4, moved.shape) * [1, 1, 0.3, 0.5, 0.2, 0.2, 0.2]
        moved[:, 3:6] = np.maximum(moved[:, 3:6], 0.2)
        boxes = np.concatenate([moved, some_boxes(rng, rng.integers(0, 5), 9)])
        scores = rng.integers(0, 8, len(boxes)) / 8  # many are equal
        scenes.append((boxes, scores, truth, rng.random(len(truth)) < 0.8))
    if not any(scene[3].any() for scene in scenes):
        return
    got = ours(scenes, "bev" if flat else "3d", least)
    ap40, recall, precision = plain_ap40(scenes, 0 if flat else 1, least)
    assert got.ap40 == pytest.approx(ap40)
    assert got.recall == pytest.approx(recall)
    assert got.precision == pytest.approx(precision)


@given(st.integers(0, 2**32))
@settings(max_examples=100, deadline=None)
def test_overlap_agrees_with_crossing_half_planes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    first, second = some_boxes(rng, 5, 3), some_boxes(rng, 5, 3)
    second[0] = first[0]
    second[1, 6] = first[1, 6] + np.pi / 2
    bev, volume = overlaps(first, second)
    for i, j in np.ndindex(5, 5):
        want = plain_iou(first[i], second[j])
        assert (bev[i, j], volume[i, j]) == pytest.approx(want, abs=1e-6)
    np.testing.assert_allclose(overlaps(second, first)[0], bev.T, atol=1e-9)


def test_overlap_agrees_with_counting_random_points() -> None:
    rng = np.random.default_rng(3)
    first, second = some_boxes(rng, 20, 2), some_boxes(rng, 20, 2)
    points = rng.uniform(-8, 8, (400_000, 2))
    bev, _ = overlaps(first, second)
    for a, b, iou in zip(first, second, np.diag(bev), strict=True):
        inside = [
            np.all([p * points[:, 0] + q * points[:, 1] <= r for p, q, r in sides(box)], axis=0)
            for box in (a, b)
        ]
        counted = (inside[0] & inside[1]).sum() / max((inside[0] | inside[1]).sum(), 1)
        assert iou == pytest.approx(counted, abs=0.02)


CAR = (0, 0.75, 4.5, 1.8, 1.5, 0)


def cars(*xs: float) -> Floats:
    return np.array([(x, *CAR) for x in xs]).reshape(-1, 7)


def test_half_of_the_vehicles_found_without_mistake_gives_one_half() -> None:
    scene = (cars(0, 10), np.array([0.9, 0.8]), cars(0, 10, 20, 30), np.ones(4, bool))
    assert ours([scene], "bev", 0.5) == Score(4, 0.5, 0.5, 1.0)


def test_a_second_detection_of_a_vehicle_is_false() -> None:
    scene = (cars(0, 0.2), np.array([0.5, 0.9]), cars(0), np.ones(1, bool))
    one = Scene.of(*scene[:3])
    both = np.ones(2, bool)
    assert outcomes(one, "bev", 0.1, both[:1], both).tolist() == [HIT, FALSE]


def test_what_is_not_due_is_neither_missed_nor_wrongly_found() -> None:
    one = Scene.of(cars(0, 10, 50), np.array([0.9, 0.8, 0.7]), cars(0, 10))
    found = outcomes(one, "3d", 0.5, np.array([True, False]), np.array([True, True, False]))
    assert found.tolist() == [HIT, NEITHER, NEITHER]


def test_nothing_to_find_and_nothing_found_have_no_score() -> None:
    assert average_precision([], [], 0) == Score(0, None, None, None)
    assert average_precision([], [], 3) == Score(3, 0.0, 0.0, None)
