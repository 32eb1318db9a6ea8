"""Detectors on scans that this project did not make: what one can see in them is kept as facts.

Labels were made by hand on pictures from above and from the side: centre, size and yaw in the
frame of the first LiDAR. The real car's scans show a road between hedges, trees and walls, and no
vehicle. That of CARLA shows five cars within 50 m; two of them hover a metre over its ground.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from edge_server.config import EdgeConfig
from learning.kitti import line_of
from learning.kitti_object import KittiFrame, kitti_frames
from protocol.messages import ObjectClass
from recording.foreign_scans.agents import Source, agents_of
from studies.kitti_eval import hits_of, judge

pytest.importorskip("torch", reason="needs the extra `learn`")

SHARED = Path(__file__).parents[3] / "shared" / "data" / "lidar"
RANGE_M = 50.0
pytestmark = pytest.mark.skipif(
    not SHARED.is_dir(), reason="the scans of others are not on this machine"
)

SENSORS = {
    "car_three_lidars": ("top", "left", "right"),
    "carla_five_lidars": ("top", "front", "back", "left", "right"),
}
CARS = {
    "car_three_lidars": [],
    "carla_five_lidars": [
        [-16.7, 26.85, -2.30, 4.7, 1.9, 1.5, np.pi / 2],
        [-16.6, 33.40, -2.25, 4.5, 1.9, 1.6, np.pi / 2],
        [-16.7, 44.00, -2.30, 4.6, 1.9, 1.5, np.pi / 2],
        [10.75, 3.55, -1.30, 4.6, 1.9, 1.5, 0.0],
        [5.95, -3.55, -1.30, 4.7, 1.9, 1.5, 0.0],
    ],
}


VIEWS = (1, -1)
"""Sign of x and y: the frame, and turned by half a turn.

Scores near the threshold move by several hundredths with the view, and with the arithmetic that a
CPU has (`perception.pillars.detector.computes_in_half`): one view alone says little.
"""


def frames_of(name: str, folder: Path) -> list[KittiFrame]:
    """Returns each view of a frame, its sensors merged, with the labels."""
    poses = folder / "poses.csv"
    poses.write_text("x_m,y_m,z_m\n0,0,0\n")
    extrinsics = SHARED / name / "initial_extrinsic.txt"
    (agent,) = agents_of(Source(SHARED / name, poses, extrinsics, SENSORS[name], refine=True))
    points = agent.cloud(0).points
    (folder / "velodyne").mkdir()
    (folder / "label_2").mkdir()
    for number, sign in enumerate(VIEWS):
        turned = points * np.array([sign, sign, 1], np.float32)
        np.save(folder / "velodyne" / f"{number}.npy", turned)
        cars = [[sign * car[0], sign * car[1], *car[2:]] for car in CARS[name]]
        lines = [line_of(car, ObjectClass.CAR) for car in cars]
        (folder / "label_2" / f"{number}.txt").write_text("\n".join(lines) + "\n")
    return kitti_frames(folder)


# Of the first view alone, before boxes were asked whether they are solid, on level ground: 50, 7,
# 25 and 15. Before they were asked whether what they hold goes on beyond their ends: 41, 1, 10 and
# 13. Before training saw walls, hedges and sheds beside the road: 35, 3, 7 and 9. Before it saw
# rows of parked cars below trees, and boxes were asked how much of them was seen: 35, 1, 7 and 5.
# Before they were asked whether one looks deep into them: 7, 0, 5 and 2. Before they were asked
# whether their points scatter: 6, 0, 2 and 1.
MOST_WRONG = {
    "car_three_lidars": {"fast": 6, "pointpillars": 4},
    "carla_five_lidars": {"fast": 1, "pointpillars": 2},
}
"""In the first view by `fast`, in both by the network: 3 and 0 in single precision."""
MOST_MISSED = {"fast": 0, "pointpillars": 1}
"""In each view: in one of them the network misses a car that hovers, in single precision."""


@pytest.mark.parametrize("name", SENSORS)
def test_cars_are_found_and_few_boxes_are_on_trees_and_walls(name: str, tmp_path: Path) -> None:
    frames = frames_of(name, tmp_path)
    judged = {"fast": frames[:1], "pointpillars": frames}
    for detector, views in judged.items():
        found = [judge(one, [detector], EdgeConfig(), RANGE_M)[detector] for one in views]
        hits = [hits_of(one, RANGE_M) for one in found]
        wrong, cars = sum(one.boxes - one.right for one in hits), len(views) * len(CARS[name])
        assert sum(one.vehicles for one in hits) == cars
        assert all(points >= 90 for one in found for points in one.points)
        assert all(one.vehicles - one.found <= MOST_MISSED[detector] for one in hits)
        assert wrong <= MOST_WRONG[name][detector], wrong
