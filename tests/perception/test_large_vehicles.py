"""Lorries and buses in clusters: parts joined, vehicles kept apart."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from perception.arrays import Floats32
from perception.boxes import fit_boxes, main_sensors
from perception.clusters import Clusters
from perception.detector import Vehicles
from perception.large_vehicles import join_parts
from perception.roadway import Roadway
from protocol.messages import ObjectClass
from protocol.roadmap import RoadMap

RNG = np.random.default_rng(1)


@pytest.fixture(scope="module")
def roadway(road_map: RoadMap) -> Roadway:
    return Roadway.of(road_map, margin_m=0.5)


def solid(x_m: tuple[float, float], z_m: tuple[float, float], width_m: float = 2.5) -> Floats32:
    """Returns points in the lane at y = 1.75, between these bounds."""
    low, high = (x_m[0], 1.75 - width_m / 2, z_m[0]), (x_m[1], 1.75 + width_m / 2, z_m[1])
    return RNG.uniform(low, high, (300, 3)).astype(np.float32)


def joined(roadway: Roadway, *clusters: Any) -> tuple[Vehicles, int]:
    points = np.concatenate(clusters)
    labels = np.repeat(np.arange(len(clusters)), [len(c) for c in clusters]).astype(np.int32)
    ground_m = np.zeros(len(points), np.float32)
    whole = join_parts(points, ground_m, Clusters.of(labels), roadway=roadway)
    sensors = main_sensors(whole, np.array([len(points)]), np.array([[0.0, 0.0, 3.0]]))
    found = fit_boxes(points, ground_m, whole, roadway=roadway, sensors=sensors)
    return found, whole.count


def test_a_tractor_and_its_trailer_are_one_truck(roadway: Roadway) -> None:
    trailer, cab = solid((-60, -46.4), (1.2, 4.0)), solid((-45.7, -43.5), (0.5, 3.7))
    found, clusters = joined(roadway, trailer, cab)
    assert clusters == 1
    assert found.boxes[0, 3] == pytest.approx(16.5, abs=0.3)
    assert found.classes.tolist() == [ObjectClass.TRUCK]


def test_a_car_that_queues_behind_a_lorry_stays_a_car(roadway: Roadway) -> None:
    lorry, car = solid((-60, -51.5), (0.6, 3.4)), solid((-49.5, -45.0), (0.3, 1.5), 1.8)
    found, clusters = joined(roadway, lorry, car)
    assert clusters == 2
    assert sorted(found.classes.tolist()) == [ObjectClass.CAR, ObjectClass.TRUCK]


def test_two_lorries_in_a_queue_stay_two(roadway: Roadway) -> None:
    lorries = [solid((x, x + 8.5), (0.6, 3.4)) for x in (-60.0, -49.0)]
    assert joined(roadway, *lorries)[1] == 2


def test_cars_are_never_joined(roadway: Roadway) -> None:
    cars = [solid((x, x + 2.0), (0.3, 1.5), 1.8) for x in (-60.0, -57.5, -55.0)]
    assert joined(roadway, *cars)[1] == 3


def test_noise_stays_noise_and_nothing_stays_nothing(roadway: Roadway) -> None:
    none, nothing = np.zeros((0, 3), np.float32), Clusters.of(np.zeros(0, np.int32))
    assert join_parts(none, none[:, 0], nothing, roadway=roadway).count == 0
    points = np.concatenate([solid((-60, -50), (0.6, 3.4)), solid((-49, -45), (0.6, 3.4))])
    labels = np.repeat([0, 1], 300).astype(np.int32)
    labels[::7] = -1
    parts = Clusters.of(labels)
    found = join_parts(points, np.zeros(600, np.float32), parts, roadway=roadway).labels(600)
    assert (found[::7] == -1).all()
    assert set(found.tolist()) == {-1, 0}


def test_a_cluster_is_seen_from_where_most_of_its_points_were() -> None:
    labels = np.array([0, 0, 1, -1, 1, 1, 0], np.int32)  # of the first sensor four
    sensors = np.array([[1.0, 2, 3], [4, 5, 6]])
    places = main_sensors(Clusters.of(labels), np.array([4, 3]), sensors)
    np.testing.assert_array_equal(places, [[1, 2], [4, 5]])
    nothing = Clusters.of(np.zeros(0, np.int32))
    assert main_sensors(nothing, np.zeros(0, np.int64), sensors[:0]).shape == (0, 2)
