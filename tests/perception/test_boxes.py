"""Boxes around clusters."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from perception.boxes import fit_boxes
from perception.clusters import Clusters
from perception.detector import Vehicles
from perception.roadway import Roadway
from protocol.roadmap import RoadMap


@pytest.fixture(scope="module")
def roadway(road_map: RoadMap) -> Roadway:
    return Roadway.of(road_map, margin_m=0.5)


def fit(
    roadway: Roadway,
    *clusters: Any,
    sensor: tuple[float, float] = (0, 0),
    completed: bool = True,
) -> Vehicles:
    points = np.concatenate(clusters).astype(np.float32)
    labels = np.repeat(np.arange(len(clusters)), [len(c) for c in clusters]).astype(np.int32)
    return fit_boxes(
        points,
        np.zeros(len(points), np.float32),
        Clusters.of(labels),
        roadway=roadway,
        sensors=np.array([sensor] * len(clusters), np.float64),
        completed=completed,
    )


@pytest.mark.parametrize("turn_deg", [0, 4, -20])
@pytest.mark.parametrize("x", [-60.0, -20.0, 45.0])
def test_a_car_seen_from_the_junction_gets_its_own_box(
    roadway: Roadway, car_shell: Callable[..., Any], x: float, turn_deg: float
) -> None:
    yaw = np.radians(turn_deg)
    car = car_shell([x, 1.75, 0, 0, 0, yaw], (0.0, 0.0), np.random.default_rng(1), points=900)
    found = fit(roadway, car[car[:, 2] > 0.2])
    assert len(found) == 1
    np.testing.assert_allclose(found.boxes[0, :2], [x, 1.75], atol=0.25)
    np.testing.assert_allclose(found.boxes[0, 2:6], [0.75, 4.5, 1.8, 1.5], atol=0.4)
    assert abs(found.boxes[0, 6] - yaw) < np.radians(5)


@pytest.mark.parametrize(
    ("wide_m", "x", "lowest_m", "points", "length_m"),
    [
        *((1.7, 30, 0.3, 900, 3.9), (1.9, 30, 0.3, 900, 4.5)),
        *((1.4, 30, 0.3, 900, 4.5), (1.6, 30, 0.3, 900, 3.93)),  # a part, or nearly
        *((1.7, 60, 0.3, 900, 4.5), (1.7, 30, 0.3, 20, 4.5), (1.7, 30, 0.9, 900, 4.5)),
    ],
)
def test_a_narrow_car_near_by_is_short(
    roadway: Roadway, wide_m: float, x: float, lowest_m: float, points: int, length_m: float
) -> None:
    rng = np.random.default_rng(1)
    seen_m = wide_m - 0.0043 * x  # no point lies on the very edge
    low = [x, 1.75 - seen_m / 2, lowest_m]
    rear = rng.uniform(low, [x + 0.1, 1.75 + seen_m / 2, 1.45], (points, 3))
    found = fit(roadway, rear)
    assert len(found) == 1
    assert found.boxes[0, 3] == pytest.approx(length_m, abs=0.1)


def test_a_rear_alone_is_completed_away_from_the_sensor(roadway: Roadway) -> None:
    rng = np.random.default_rng(1)
    rear = rng.uniform([30, 0.85, 0.3], [30.1, 2.65, 1.5], (40, 3))
    found = fit(roadway, rear)
    np.testing.assert_allclose(found.boxes[0, :2], [32.25, 1.75], atol=0.15)


@pytest.mark.parametrize(("x", "rear_m", "front_m"), [(30, -2.2, None), (-30, None, 2.3)])
def test_of_a_bumper_alone_one_end_is_known(
    roadway: Roadway, x: float, rear_m: float | None, front_m: float | None
) -> None:
    """The points reach 10 cm into the vehicle, the rear of one that goes on from the sensor."""
    rng = np.random.default_rng(1)
    bumper = rng.uniform([x, 0.85, 0.3], [x + 0.1, 2.65, 1.5], (40, 3))
    found = fit(roadway, bumper)
    known = [np.nan if end_m is None else end_m for end_m in (rear_m, front_m)]
    np.testing.assert_allclose(found.ends_m, [known], atol=0.1)
    window = bumper[bumper[:, 2] < 0.9] + np.array([0, 0, 0.6])
    assert fit(roadway, window).ends_m.tolist() == [[pytest.approx(np.nan, nan_ok=True)] * 2]
    assert np.isnan(fit(roadway, bumper, completed=False).ends_m).tolist() == [[True, True]]


@pytest.mark.parametrize(("x", "rear_is_known"), [(10.0, True), (60.0, True), (-60.0, False)])
def test_both_ends_are_known_of_a_car_that_is_seen_whole_near_by(
    roadway: Roadway, car_shell: Callable[..., Any], x: float, rear_is_known: bool
) -> None:
    car = car_shell([x, 1.75, 0, 0, 0, 0], (0.0, 0.0), np.random.default_rng(1), points=900)
    (ends_m,) = fit(roadway, car[car[:, 2] > 0.2]).ends_m
    known = [rear_is_known, not rear_is_known or x < 18]
    assert (~np.isnan(ends_m)).tolist() == known
    np.testing.assert_allclose(ends_m[known], np.array([-2.25, 2.25])[known], atol=0.2)


def test_a_bare_box_holds_its_points_and_no_more(roadway: Roadway) -> None:
    rng = np.random.default_rng(1)
    rear = rng.uniform([30, 0.85, 0.3], [30.1, 2.65, 1.5], (40, 3))
    (box,) = fit(roadway, rear, completed=False).boxes
    np.testing.assert_allclose(box[:2], [30.05, 1.75], atol=0.1)
    assert sorted(box[3:5]) == pytest.approx([0.1, 1.8], abs=0.15)
    assert box[5] == pytest.approx(np.ptp(rear[:, 2]), abs=1e-3)


def test_poles_walls_trunks_and_tree_crowns_are_no_vehicles(roadway: Roadway) -> None:
    rng = np.random.default_rng(1)
    pole = rng.uniform([-40, 0, 0.2], [-39.8, 0.2, 1.9], (60, 3))
    wall = rng.uniform([-40, 3, 0.2], [-30, 3.1, 1.9], (60, 3))
    tree = rng.uniform([-40, 0, 0.2], [-39.7, 0.3, 4.2], (60, 3))
    kerb = rng.uniform([-40, 0, 0.2], [-36, 1.8, 0.25], (60, 3))
    crown = rng.uniform([-30, 0, 2.6], [-27, 1.8, 3.9], (60, 3))
    assert len(fit(roadway, pole, wall, tree, kerb, crown)) == 0


def test_noise_is_left_out(roadway: Roadway) -> None:
    points = np.zeros((5, 3), np.float32)
    labels = np.full(5, -1, np.int32)
    found = fit_boxes(
        points,
        points[:, 2],
        Clusters.of(labels),
        roadway=roadway,
        sensors=np.zeros((0, 2)),
    )
    assert len(found) == 0


def line(length_m: float, height_m: float) -> Any:
    """What one ring hits of a vehicle's rear, far away: five points of one height."""
    across = np.linspace(-length_m / 2, length_m / 2, 5)
    return np.column_stack([np.full(5, -95.0), 1.75 + across, np.full(5, height_m)])


def test_what_one_ring_hits_of_a_vehicle_is_a_vehicle(roadway: Roadway) -> None:
    found = fit(roadway, line(1.7, 0.8))
    assert len(found) == 1
    np.testing.assert_allclose(found.boxes[0, 2:6], [0.75, 4.5, 1.8, 1.5], atol=0.1)


@pytest.mark.parametrize(("length_m", "height_m"), [(0.6, 0.8), (1.7, 0.25), (1.7, 4.8)])
def test_what_is_too_short_low_or_high_for_that_is_none(
    roadway: Roadway, length_m: float, height_m: float
) -> None:
    assert len(fit(roadway, line(length_m, height_m))) == 0


@pytest.mark.parametrize("x", [-32.0, 32.0])
@pytest.mark.parametrize(
    ("lowest_m", "top_m", "rear_m", "front_m", "length_m"),
    [
        *((0.4, 1.5, 0, 0, 4.5), (1.0, 1.5, 0.6, 1.5, 4.5)),
        *((1.0, 1.95, 0, 0, 4.9), (1.3, 1.95, 0.1, 1.1, 4.9)),  # a van
    ],
)
def test_before_a_window_lie_a_bonnet_or_a_boot_that_nobody_sees(
    roadway: Roadway,
    x: float,
    lowest_m: float,
    top_m: float,
    rear_m: float,
    front_m: float,
    length_m: float,
) -> None:
    """Rear and front of a lane's vehicles are distinguished by the lane's direction."""
    rng = np.random.default_rng(1)
    for y in (-1.75, 1.75):
        seen = rng.uniform([x - 1, y - 0.85, lowest_m], [x + 1, y + 0.85, top_m], (400, 3))
        (box,) = fit(roadway, seen).boxes
        ahead = np.sign(np.cos(box[6]))
        towards = -np.sign(x)
        before_m = front_m if ahead == towards else rear_m
        end = box[0] + towards * box[3] / 2
        assert end == pytest.approx(x + towards * (1 + before_m), abs=0.1)
        assert box[3] == pytest.approx(length_m, abs=0.1)


def test_no_hidden_end_makes_a_car_longer_than_5_m(roadway: Roadway) -> None:
    rng = np.random.default_rng(1)
    seen = rng.uniform([30, 0.9, 1.0], [34.4, 2.6, 1.5], (400, 3))
    (box,) = fit(roadway, seen).boxes
    assert box[3] == pytest.approx(5.0, abs=0.1)


def test_what_is_seen_of_a_van_over_another_vehicle_is_in_the_middle_of_its_box(
    roadway: Roadway,
) -> None:
    rng = np.random.default_rng(1)
    roof = rng.uniform([31, 0.9, 1.0], [33, 2.6, 2.5], (60, 3))
    found = fit(roadway, roof)
    np.testing.assert_allclose(found.boxes[0, :2], [32, 1.75], atol=0.15)
    np.testing.assert_allclose(found.boxes[0, 3], 5.6, atol=0.1)


def test_a_vehicle_seen_in_two_parts_gets_one_box(roadway: Roadway) -> None:
    rng = np.random.default_rng(1)
    side = rng.uniform([30, 0.85, 0.3], [34, 2.65, 1.5], (200, 3))
    roof = rng.uniform([33, 0.85, 1.6], [34, 2.65, 1.7], (20, 3))
    apart = rng.uniform([41, 0.85, 0.3], [42, 2.65, 1.3], (20, 3))
    found = fit(roadway, side, roof, apart)
    assert len(found) == 2
    assert found.scores[0] > found.scores[1]


def test_a_mast_with_signals_is_no_lorry(roadway: Roadway) -> None:
    rng = np.random.default_rng(1)
    mast = rng.uniform([-40, 1, 0.2], [-38.8, 2, 3.6], (80, 3))
    assert len(fit(roadway, mast)) == 0
