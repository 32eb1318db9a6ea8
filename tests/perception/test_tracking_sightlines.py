"""Sight lines of sensors: ground just before a place shows that a vehicle there would be seen."""

import numpy as np
import pytest

from perception.tracking.sightlines import SightLines

SENSOR = np.array([[0.0, 0.0, 2.5]])
CAR = [20.0, 0.0, 0.75, 4.5, 1.8, 1.5, 0.0]


def of(*ground: tuple[float, float, float], sensor: np.ndarray = SENSOR) -> SightLines:
    return SightLines.of(sensor, [np.array(ground, np.float32).reshape(-1, 3)])


def fan(x: float, height_m: float = 0.0) -> list[tuple[float, float, float]]:
    return [(x, y, height_m) for y in np.arange(-3, 3.1, 0.25)]


@pytest.mark.parametrize(
    ("ground", "is_plain"),
    [
        (fan(16.0), True),  # its rear would be hit
        (fan(10.0), False),  # something may stand behind that
        (fan(18.5), False),  # of its own footprint
        (fan(28.0), False),  # seen beneath it
        (fan(60.0), False),  # seen over its roof
        (fan(16.0, 1.0), False),  # of something before it
        ([], False),
    ],
)
def test_ground_just_before_a_car_says_that_it_would_be_seen(ground, is_plain) -> None:
    share = of(*ground).plain(np.array([CAR]))
    assert share.shape == (1,)
    assert bool(share[0] > 0.9) is is_plain


@pytest.mark.parametrize("yaw", [0.0, 0.6, np.pi / 2, 2.0, np.pi])
@pytest.mark.parametrize("bearing", [0.0, 1.0, np.pi / 2, 3.0, -2.0])
def test_what_is_just_before_it_goes_by_its_near_side_however_it_stands(yaw, bearing) -> None:
    """Along the ray through its middle."""
    askew = abs((yaw - bearing + np.pi / 2) % np.pi - np.pi / 2)
    near_m = 30 - min(2.25 / np.cos(askew), 0.9 / max(np.sin(askew), 1e-9))
    cos, sin = np.cos(bearing), np.sin(bearing)
    car = np.array([[30 * cos, 30 * sin, 0.75, 4.5, 1.8, 1.5, yaw]])

    def seen_at(range_m: float) -> float:
        ring = [(range_m, y, 0.0) for y in np.arange(-3, 3.1, 0.1)]
        turned = [(cos * x - sin * y, sin * x + cos * y, z) for x, y, z in ring]
        return float(of(*turned).plain(car)[0])

    assert seen_at(near_m - 1.6) > 0.9
    assert seen_at(near_m - 7) == 0


def test_ground_beside_a_car_that_is_far_away_says_nothing() -> None:
    """It stands in a queue, hidden, and between the lanes the road is seen."""
    beside = [(x, y, 0.0) for x in np.arange(50, 70, 0.5) for y in (-1.2, -1.0, 1.0, 1.2)]
    assert of(*beside).plain(np.array([[60.0, *CAR[1:]]]))[0] == 0


def test_the_sensor_that_saw_most_counts() -> None:
    sensors = np.array([[0, 0, 2.5], [40, 0, 2.5]])
    lowest = [np.zeros((0, 3), np.float32), np.array(fan(24.0), np.float32)]
    assert SightLines.of(sensors, lowest).plain(np.array([CAR]))[0] > 0.9


def test_without_a_sensor_nothing_is_in_plain_view() -> None:
    nobody = SightLines.of(np.zeros((0, 3)), [])
    assert nobody.plain(np.array([CAR, CAR])).tolist() == [0, 0]
