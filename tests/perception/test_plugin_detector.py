"""What a detector of a plug-in returns is checked before the edge uses it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from perception.arrays import Floats
from perception.detector import PluginDetector, Vehicles, checked_vehicles
from protocol.errors import ConfigError
from protocol.plugins import Plugin


class _Finds:
    def __init__(self, scores: Floats, classes: list[int]) -> None:
        self._found = Vehicles.from_lidar(
            np.tile([0.0, 0, 0, 4, 2, 1.5, 0], (len(classes), 1)),
            np.asarray(scores, float),
            np.array(classes, np.uint8),
        )

    def detect(self, cloud, rng, stage=None) -> Vehicles:
        return self._found


def detect(scores: list[float], classes: list[int]) -> Vehicles:
    plugin = Plugin("own of package 1.0", None)
    detector = PluginDetector(plugin, _Finds(np.array(scores), classes))
    return detector.detect(None, np.random.default_rng(0))


def test_every_class_and_scores_from_0_to_1_are_taken() -> None:
    assert len(detect([0.0, 0.5, 0.7, 1.0], [0, 1, 2, 3])) == 4


@pytest.mark.parametrize(
    ("scores", "classes", "fault"),
    [
        ([1.5], [0], "a score outside 0 to 1"),
        ([-0.1], [0], "a score outside 0 to 1"),
        ([0.5], [4], r"found classes \[4\]; those of ObjectClass are 0 to 3"),
        ([np.nan], [0], "no finite number"),
    ],
)
def test_other_scores_and_classes_are_refused_by_the_plugins_name(scores, classes, fault) -> None:
    with pytest.raises(ConfigError, match=f"own of package.*{fault}"):
        detect(scores, classes)


@pytest.mark.parametrize(
    ("ends_m", "fault"),
    [
        ([[-2.0, 2.0, 1.0]], r"ends_m \(1, 3\).*must be .*\(N, 2\)"),
        ([[-np.inf, 2.0]], "infinite"),
        ([[2.0, -2.0]], "a rear that is not behind the front"),
    ],
)
def test_ends_that_are_none_are_refused_by_the_plugins_name(ends_m, fault) -> None:
    finds = _Finds(np.array([0.5]), [0])
    for known in ([[np.nan, np.nan]], [[-2.0, np.nan]], [[-2.0, 2.0]]):
        finds._found = replace(finds._found, ends_m=np.array(known))
        assert len(checked_vehicles(Plugin("own of package 1.0", None), finds._found)) == 1
    wrong = replace(finds._found, ends_m=np.array(ends_m))
    with pytest.raises(ConfigError, match=f"own of package.*{fault}"):
        checked_vehicles(Plugin("own of package 1.0", None), wrong)
