"""A run whose scans cannot arrive in time gives a warning, with the numbers."""

from typing import Any

import pytest

from cpnet import scenario as scenarios
from sensing.link_budget import link_warnings


def warnings(**overrides: Any) -> list[str]:
    given = {"mode": "lockstep", **{key.replace("__", "."): v for key, v in overrides.items()}}
    return list(link_warnings(scenarios.load("t_junction", given).model_dump(mode="json")))


def test_a_whole_scan_that_misses_its_deadline_is_named_with_what_would_fit():
    (found,) = warnings(link__profile="3mbit,20ms")
    assert found.startswith(
        "vehicle: a whole scan of about 33.4 kB takes 93 ms at 3 Mbit/s and 10 ms"
    )
    assert "edge.deadline_ms leaves (80 ms)" in found
    assert "What would fit: 4 Mbit/s, 25.3 kB" in found
    assert "a deadline of 103 ms" in found


@pytest.mark.parametrize(
    "fitting",
    [
        {},
        {"link__profile": "10mbit,20ms"},
        {"link__profile": "3mbit,20ms", "edge__deadline_ms": 120},
        {"link__profile": "3mbit,20ms", "upload__filters": ["foreground"]},
        {"link__profile": "3mbit,20ms", "upload__policy": "objects"},
        {"link__profile": "3mbit,20ms", "link__apply": "none"},
    ],
)
def test_nothing_is_said_where_a_scan_arrives_in_time(fitting):
    assert warnings(**fitting) == []


def test_no_rate_helps_where_the_way_alone_is_too_long():
    found = warnings(link__profile="1gbit,200ms", link__roadside_profile="1gbit,200ms")
    assert len(found) == 2
    assert all("No rate helps: the deadline must be longer than 100 ms" in one for one in found)
