"""Boxes stand where the edge has found the ground, not where the map has it."""

import numpy as np

from perception.pillars.detector import _ground_at
from perception.roadway import Roadway
from recording.foreign_scans.ground import Ground
from recording.foreign_scans.importer import open_ground

LEVEL = Ground(np.zeros((1, 2)), np.zeros((1, 3)), fit=1.0, slope_deg=0.0)
ROADWAY = Roadway.of(open_ground({"way": np.zeros((1, 6))}, LEVEL, width_m=40), margin_m=0.5)
BOXES = np.array([[-10.0, 0, 0.75, 4.5, 1.8, 1.5, 0], [10.0, 0, 0.75, 4.5, 1.8, 1.5, 0]])


def ground_m(off_left_m: float, off_right_m: float) -> list[float]:
    """Returns the ground below both boxes, where points were given a road so far off the map's."""
    x, y = np.meshgrid(np.arange(-15, 15, 0.5), np.arange(-5, 5, 0.5))
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]).astype(np.float32)
    road_m = np.where(points[:, 0] < 0, off_left_m, off_right_m).astype(np.float32)
    return _ground_at(BOXES, points, road_m, ROADWAY).round(3).tolist()


def test_where_the_map_is_right_it_is_taken():
    assert ground_m(0.0, 0.0) == [0.0, 0.0]


def test_where_the_map_is_off_a_box_stands_on_the_ground_that_was_found():
    assert ground_m(-0.8, 0.5) == [-0.8, 0.5]


def test_without_points_or_boxes_the_map_is_taken():
    nothing = np.zeros((0, 3), np.float32)
    assert _ground_at(BOXES, nothing, np.zeros(0, np.float32), ROADWAY).tolist() == [0, 0]
    assert len(_ground_at(BOXES[:0], nothing, np.zeros(0, np.float32), ROADWAY)) == 0
