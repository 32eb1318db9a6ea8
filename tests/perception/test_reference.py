"""The paper's detector by Open3D beside the fast one."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from perception.config import DetectionConfig
from perception.detector import Cloud
from perception.registry import detector_of
from perception.roadway import Placed, Roadway
from protocol.errors import ConfigError
from protocol.roadmap import RoadMap

CARS = [(-60.0, -1.75, 0.0), (-35.0, 1.75, 0.0), (-14.0, 1.75, 4.0), (28.0, 1.75, 0.0)]
WHOLE = {"ground": {"tile_m": None}}


@pytest.fixture(scope="module")
def roadway(road_map: RoadMap) -> Roadway:
    return Roadway.of(road_map, margin_m=0.5)


@pytest.fixture(scope="module")
def cloud(car_shell: Callable[..., Any], ground: Callable[..., Any]) -> Cloud:
    """Four cars on flat ground, seen from the junction's centre."""
    rng = np.random.default_rng(5)
    cars = [
        car_shell([x, y, 0, 0, 0, np.radians(yaw)], (0.0, 0.0), rng, points=1200)
        for x, y, yaw in CARS
    ]
    points = np.concatenate([ground(rng, count=20_000), *cars])
    points = points[np.abs(points[:, 1]) < 4]  # what lies beside the road is fenced off
    placed = Placed.of(points, np.zeros(len(points), np.float32))
    return Cloud([placed], [], np.array([[0, 0, 3.0]]))


def need_open3d() -> None:
    pytest.importorskip("open3d", exc_type=ImportError)


def test_both_find_the_same_cars_within_20_cm_and_5_degrees(cloud: Cloud, roadway: Roadway) -> None:
    """From above; `fast` completes their heights, the reference's planes cut them."""
    need_open3d()
    boxes = []
    for name in ("fast", "reference"):
        config = DetectionConfig.model_validate({"detector": name, **WHOLE})
        found = detector_of(config, roadway).detect(cloud, np.random.default_rng(1)).boxes
        boxes.append(found[np.argsort(found[:, 0])])
    fast, reference = boxes
    assert len(fast) == len(reference) == len(CARS)
    np.testing.assert_allclose(fast[:, [0, 1, 3, 4]], reference[:, [0, 1, 3, 4]], atol=0.2)
    turn = (fast[:, 6] - reference[:, 6] + np.pi / 2) % np.pi - np.pi / 2
    np.testing.assert_allclose(turn, 0, atol=np.radians(5))
    np.testing.assert_allclose(reference[:, :2], np.array(CARS)[:, :2], atol=0.4)


def test_the_reference_takes_clouds_of_few_points(roadway: Roadway) -> None:
    need_open3d()
    detector = detector_of(DetectionConfig(detector="reference"), roadway)
    for count in (0, 2, 5):
        placed = Placed.of(np.zeros((count, 3), np.float32), np.zeros(count, np.float32))
        found = detector.detect(
            Cloud([placed], [placed], np.zeros((1, 3))), np.random.default_rng(1)
        )
        assert len(found) == 0


def test_without_open3d_it_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, roadway: Roadway
) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(ConfigError, match=r"extra `reference`.*libusb-1.0-0 libgl1 libgomp1"):
        detector_of(DetectionConfig(detector="reference"), roadway)


def test_an_unknown_detector_is_refused_with_the_names_of_all() -> None:
    with pytest.raises(ValidationError, match="fast, reference, pointpillars"):
        DetectionConfig.model_validate({"detector": "slow"})
