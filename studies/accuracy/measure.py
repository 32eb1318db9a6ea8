"""AP40 at a scenario's junction, over samples some seconds apart."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from edge_server.config import EdgeConfig
from learning.dataset import SceneSample
from learning.scanner import samples_of, scanner_of
from perception.config import DetectorName
from protocol.errors import ConfigError
from studies.evaluate import EvalRow, Site, evaluate

Scenario = dict[str, Any]
MAX_SAMPLES = 500


def measure_accuracy(
    scenario: Scenario, detectors: Sequence[DetectorName], samples: int
) -> list[EvalRow]:
    """Returns all rows of these detectors at the junction of a scenario with all its keys.

    The scenario's seed decides all but `detect_ms`.

    Raises:
        ConfigError: the junction cannot be had, or a detector.
    """
    site, listed = junction_of(scenario, samples)
    return evaluate(((site, sample) for sample in listed), detectors)


def junction_of(scenario: Scenario, samples: int) -> tuple[Site, Iterator[SceneSample]]:
    """Returns a scenario's junction and its samples; fewer samples are the first of more.

    Raises:
        ConfigError: there are too few or too many, or the junction cannot be had.
    """
    if not 1 <= samples <= MAX_SAMPLES:
        raise ConfigError(f"samples {samples}: must be 1 to {MAX_SAMPLES}")
    scanner = scanner_of(scenario, samples)
    site = Site(scanner.road_map, EdgeConfig.model_validate(scenario["edge"]))
    return site, samples_of(scanner)
