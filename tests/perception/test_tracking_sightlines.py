"""Sight lines of sensors: visible ground behind a place shows that it is empty."""

import numpy as np
import pytest

from perception.tracking.sightlines import SightLines

SENSOR = np.array([[0.0, 0.0, 2.5]])
CAR = [20.0, 0.0, 0.75, 4.5, 1.8, 1.5, 0.0]


def of(*ground: tuple[float, float, float], sensor: np.ndarray = SENSOR) -> SightLines:
    return SightLines.of(sensor, [np.array(ground, np.float32).reshape(-1, 3)], np.array([2.5]))


def fan(x: float, height_m: float = 0.0) -> list[tuple[float, float, float]]:
    return [(x, y, height_m) for y in np.arange(-3, 3.1, 0.25)]


@pytest.mark.parametrize(
    ("ground", "is_empty"),
    [
        (fan(28.0), True),  # in its shadow, were it there
        (fan(22.0), True),  # in its rear half
        (fan(17.0), False),  # before it
        (fan(60.0), False),  # seen over its roof
        (fan(28.0, 1.0), False),  # of something behind it
        ([], False),
    ],
)
def test_ground_where_a_car_would_hide_it_says_that_there_is_none(ground, is_empty) -> None:
    share = of(*ground).empty(np.array([CAR]))
    assert share.shape == (1,)
    assert bool(share[0] > 0.9) is is_empty


def test_ground_beside_a_car_that_is_far_away_says_nothing() -> None:
    """It stands in a queue, hidden, and between the lanes the road is seen."""
    beside = [(x, y, 0.0) for x in np.arange(60, 70, 0.5) for y in (-1.2, -1.0, 1.0, 1.2)]
    assert of(*beside).empty(np.array([[60.0, *CAR[1:]]]))[0] == 0


def test_the_sensor_that_saw_most_counts() -> None:
    sensors = np.array([[0, 0, 2.5], [40, 0, 2.5]])
    lowest = [np.zeros((0, 3), np.float32), np.array(fan(13.0), np.float32)]
    both = SightLines.of(sensors, lowest, np.full(2, 2.5))
    assert both.empty(np.array([CAR]))[0] > 0.9


def test_without_a_sensor_nothing_is_empty() -> None:
    nobody = SightLines.of(np.zeros((0, 3)), [], np.zeros(0))
    assert nobody.empty(np.array([CAR, CAR])).tolist() == [0, 0]
