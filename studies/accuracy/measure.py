"""AP40 at a scenario's junction, over moments some seconds apart."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from edge_server.config import EdgeConfig
from learning.moments import Moment
from learning.own_net import observatory_of, seen_by
from perception.config import DetectorName
from protocol.errors import ConfigError
from studies.evaluate import EvalRow, Site, evaluate

Scenario = dict[str, Any]
MOST_MOMENTS = 500


def measure_accuracy(
    scenario: Scenario, detectors: Sequence[DetectorName], moments: int
) -> list[EvalRow]:
    """Returns all rows of these detectors at the junction of a scenario with all its keys.

    The scenario's seed decides all but `detect_ms`.

    Raises:
        ConfigError: the junction cannot be had, or a detector.
    """
    site, listed = junction_of(scenario, moments)
    return evaluate(((site, moment) for moment in listed), detectors)


def junction_of(scenario: Scenario, moments: int) -> tuple[Site, Iterator[Moment]]:
    """Returns a scenario's junction and its moments; fewer moments are the first of more.

    Raises:
        ConfigError: there are too few or too many, or the junction cannot be had.
    """
    if not 1 <= moments <= MOST_MOMENTS:
        raise ConfigError(f"moments {moments}: must be 1 to {MOST_MOMENTS}")
    observatory = observatory_of(scenario, moments)
    site = Site(observatory.road_map, EdgeConfig.model_validate(scenario["edge"]))
    return site, seen_by(observatory)
