"""Settings of all tests."""

import pytest
from hypothesis import settings

from tests.kernel_links import missing

# How long an example takes says something about the machine's other work, not about the code.
settings.register_profile("cpnet", deadline=None)
settings.load_profile("cpnet")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skips what needs network namespaces where they cannot be, and says why."""
    rooted = [item for item in items if item.get_closest_marker("root")]
    lacks = missing() if rooted else ""
    for item in rooted if lacks else []:
        item.add_marker(pytest.mark.skip(reason=f"network namespaces: missing is {lacks}"))
