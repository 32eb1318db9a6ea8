"""Settings of all tests."""

from collections.abc import Callable

import pytest
from hypothesis import settings

from protocol.roadmap import RoadMap
from tests.kernel_links import missing
from tests.point_clouds import Floats32, car_shell, ground_points
from tests.roads import junction_road

# How long an example takes says something about the machine's other work, not about the code.
settings.register_profile("cpnet", deadline=None)
settings.load_profile("cpnet")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skips tests that need network namespaces where these are not available, with the reason."""
    rooted = [item for item in items if item.get_closest_marker("root")]
    lacks = missing() if rooted else ""
    for item in rooted if lacks else []:
        item.add_marker(pytest.mark.skip(reason=f"network namespaces: missing is {lacks}"))


@pytest.fixture(scope="session")
def road_map() -> RoadMap:
    return junction_road()


@pytest.fixture(scope="session")
def climbing_road() -> RoadMap:
    return junction_road(climb=0.035)


@pytest.fixture(scope="session", name="car_shell")
def _car_shell() -> Callable[..., Floats32]:
    return car_shell


@pytest.fixture(scope="session")
def ground() -> Callable[..., Floats32]:
    return ground_points
