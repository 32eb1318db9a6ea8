"""Merge by differences of Euler angles, against the exact transform."""

from __future__ import annotations

import numpy as np

from edge_server.placing import by_angle_differences
from protocol.geometry import SE3

POINTS = np.random.default_rng(1).uniform(-40, 40, (500, 3))
SENSOR = np.array([40.0, -8, 1, 0.01, -0.035, -1])


def apart_m(sensor_pose: np.ndarray, reference_pose: np.ndarray) -> float:
    """Returns how far the two methods are apart at most."""
    exact, euler = SE3.from_pose(sensor_pose), by_angle_differences(sensor_pose, reference_pose)
    return float(np.linalg.norm(exact.apply(POINTS) - euler.apply(POINTS), axis=1).max())


def test_angle_differences_are_exact_between_level_sensors() -> None:
    level = np.array([40.0, -8, 1, 0, 0, -1])
    assert apart_m(level, np.array([10.0, 4, 3, 0, 0, 2.0])) < 1e-9


def test_angle_differences_are_off_by_centimetres_on_a_slope() -> None:
    assert apart_m(SENSOR, np.array([0.0, 0, 3, 0, 0, 0])) < 1e-9  # differences are the angles
    assert 0.02 < apart_m(SENSOR, np.array([0.0, 0, 3, 0.03, 0.02, 0.8])) < 5.0


def test_a_reference_agrees_with_itself() -> None:
    assert apart_m(SENSOR, SENSOR) < 1e-9
