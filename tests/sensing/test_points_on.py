"""Which vehicle a return came from, beside the same cast without that vehicle."""

import numpy as np
import pytest

from sensing.config import LidarConfig
from sensing.lidar import Lidar, RayHits
from sensing.pose import pose_above

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
    sensor = pose_above(poses[own], 2.4)
    seen = [index for index in range(len(types)) if index != own]
    view = lidar.view(sensor, poses, types, own)
    bare_m = lidar.view(sensor, poses[:0], [], None).distance_m
    for index in seen:
        others = [n for n in seen if n != index]
        without_m = lidar.view(sensor, poses[others], [types[n] for n in others], None).distance_m
        np.testing.assert_array_equal(view.body == index, without_m > view.distance_m)
    assert (view.body[view.distance_m == bare_m] == -1).all()
    assert (view.body != own).all()
    assert np.count_nonzero(view.body >= 0) > 100


def test_only_beams_that_return_are_counted():
    body = np.array([[0, 0, -1], [2, 2, 2]], np.int32)
    range_m = np.array([[5.0, 0.0, 5.0], [5.0, 5.0, 0.0]], np.float32)
    assert RayHits(range_m, body, np.zeros((0, 0), np.float32)).points_on(range_m, 4).tolist() == [
        1,
        0,
        2,
        0,
    ]
