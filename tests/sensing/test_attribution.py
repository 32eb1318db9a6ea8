"""Which vehicle a return came from, beside the same cast without that vehicle."""

import numpy as np
import pytest

from sensing.attribution import counts, owners
from sensing.config import LidarConfig
from sensing.lidar import Lidar
from sensing.mounting import above

CONFIG = LidarConfig(channels=48, points_per_second=48 * 900 * 10)


def apart(poses: np.ndarray, types: list[str]) -> tuple[np.ndarray, list[str]]:
    """Leaves out vehicles that stand within others."""
    kept: list[int] = []
    for index, (x, y) in enumerate(poses[:, :2]):
        if all(abs(x - poses[k, 0]) > 13 or abs(y - poses[k, 1]) > 3 for k in kept):
            kept.append(index)
    return poses[kept], [types[index] for index in kept]


@pytest.mark.parametrize("own", [0, 3])
def test_beams_end_on_the_vehicle_without_which_they_go_farther(scene, shapes, traffic, own):
    poses, types = apart(*traffic)
    lidar = Lidar(CONFIG, scene, shapes)
    sensor = above(poses[own], 2.4)
    seen = [index for index in range(len(types)) if index != own]
    all_m = lidar.distances(sensor, poses, types, own)
    bare_m = lidar.distances(sensor, poses[:0], [], None)
    boxes = poses, shapes.bodies(types).size_m
    owner = owners(all_m, bare_m, CONFIG.pattern, sensor, boxes)
    for index in seen:
        others = [n for n in seen if n != index]
        without_m = lidar.distances(sensor, poses[others], [types[n] for n in others], None)
        np.testing.assert_array_equal(owner == index, without_m > all_m)
    assert (owner[all_m == bare_m] == -1).all()
    assert (owner != own).all()
    assert np.count_nonzero(owner >= 0) > 100


def test_only_beams_that_return_are_counted():
    owner = np.array([[0, 0, -1], [2, 2, 2]])
    range_m = np.array([[5.0, 0.0, 5.0], [5.0, 5.0, 0.0]], np.float32)
    assert counts(owner, range_m, 4).tolist() == [1, 0, 2, 0]
