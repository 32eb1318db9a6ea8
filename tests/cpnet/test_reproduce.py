"""The command that makes a recorded run again."""

import shlex

import pytest

from cpnet import scenario as scenarios
from cpnet.cli_options import assigned
from cpnet.reproduce import command_of


def recorded(**changes: object) -> dict:
    return scenarios.load("t_junction", changes).model_dump(mode="json")


def test_a_built_in_scenario_is_named_without_its_defaults() -> None:
    assert command_of(recorded()) == "cpnet up t_junction"


def test_what_differs_from_the_defaults_is_given() -> None:
    scenario = recorded(seed=7, duration_s=30, **{"edge.merge": "euler", "traffic.cav_rate": 0.2})
    assert command_of(scenario) == (
        "cpnet up t_junction --seed 7 --duration 30 --cav-rate 0.2 --set edge.merge=euler"
    )


@pytest.mark.parametrize(
    "changes",
    [
        {"name": "own-net", "traffic.net": "/a b/$(rm).net.xml", "junctions": ["no"]},
        {"roadside_mounts": [{"id": "a", "x_m": 3.0}, {"id": "b"}], "regions": {"1.5": ["no"]}},
        {"link.profile": "5mbit,20ms"},
        {"traffic.demand_vph_per_lane": {"north.in": 300.0}},
    ],
)
def test_the_command_gives_the_same_scenario(changes: dict) -> None:
    scenario = recorded(**changes)
    words = shlex.split(command_of(scenario))
    assert words[:3] == ["cpnet", "up", "t_junction"]
    given = assigned([word for word in words[3:] if word != "--set"])
    assert scenarios.load("t_junction", given).model_dump(mode="json") == scenario


@pytest.mark.parametrize("scenario", [{}, {"name": "t_junction"}, {"name": 5}, {"colour": "red"}])
def test_a_scenario_of_another_version_has_no_command(scenario: dict) -> None:
    assert command_of(scenario) == ""
