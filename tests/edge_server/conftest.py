"""A small road and what a LiDAR would see of cars on it."""

from collections.abc import Callable

import pytest

from protocol.roadmap import RoadMap
from tests.point_clouds import Floats32, car_shell, ground_points
from tests.roads import junction_road


@pytest.fixture(scope="session")
def road_map() -> RoadMap:
    return junction_road()


@pytest.fixture(scope="session")
def climbing_road() -> RoadMap:
    return junction_road(climb=0.035)


@pytest.fixture(scope="session")
def shell() -> Callable[..., Floats32]:
    return car_shell


@pytest.fixture(scope="session")
def ground() -> Callable[..., Floats32]:
    return ground_points
