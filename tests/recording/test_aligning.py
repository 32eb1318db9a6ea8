"""Extrinsics that are refined by registration of clouds."""

import numpy as np
import pytest

from protocol.errors import ConfigError
from protocol.geometry import SE3
from protocol.scans import PointCloud
from recording.foreign_scans.alignment import refined
from recording.foreign_scans.importer import height_over_ground_m
from tests import places

TOP = SE3.from_pose([0, 0, 1.9, 0.02, -0.01, 0.3])


def clouds(mounts):
    points = places.scene([(8, 4, 0.2), (-9, -5, 1.4)])
    return {name: places.seen(points, TOP @ mount) for name, mount in mounts.items()}


def test_a_guess_that_is_far_off_becomes_the_mount():
    side = SE3.from_pose([0.1, 0.6, -0.4, 0.05, 0.78, 1.6])
    true = {"top": SE3.identity(), "side": side}
    guess = {"top": SE3.identity(), "side": SE3.from_pose([0.4, 0.2, 0, 0, 0, 1.4])}
    found = refined(guess, clouds(true))
    assert found["top"] is guess["top"]
    off = side.inverse() @ found["side"]
    assert np.abs(off.translation).max() < 0.15
    assert np.abs(np.degrees(off.as_pose()[3:])).max() < 1.0


def test_a_sensor_without_ground_is_named():
    air = np.random.default_rng(1).uniform(-15, 15, (500, 3))
    with pytest.raises(ConfigError, match="the sensor side sees no ground"):
        refined(
            {"top": SE3.identity(), "side": SE3.identity()},
            clouds({"top": SE3.identity()}) | {"side": air},
        )


@pytest.mark.parametrize("roll_rad", [0.0, 0.15])
def test_the_ground_below_a_sensor_is_found(roll_rad):
    sensor = SE3.from_pose([3, 4, 2.05, roll_rad, 0, 1])
    points = places.seen(places.scene([(6, 7, 0)]), sensor).astype(np.float32)
    cloud = PointCloud(points, np.zeros(len(points), np.float32))
    assert height_over_ground_m(cloud, sensor) == pytest.approx(2.05, abs=0.02)


def test_over_nothing_the_height_is_0():
    nothing = PointCloud(np.zeros((0, 3), np.float32), np.zeros(0, np.float32))
    assert height_over_ground_m(nothing, SE3.identity()) == 0
