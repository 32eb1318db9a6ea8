"""Labels as KITTI writes them, and boxes between the map and a tilted sensor."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from learning.kitti import CALIB, Label, into_map, into_sensor
from protocol.geometry import SE3, wrap_angle

places = st.floats(-130, 130)
sizes = st.floats(0.5, 12)
angles = st.floats(-np.pi, np.pi)
boxes = st.tuples(places, places, places, sizes, sizes, sizes, angles)
tilts = st.floats(-0.2, 0.2)
poses = st.tuples(places, places, places, tilts, tilts, angles)


@given(boxes, st.integers(0, 100_000))
def test_a_line_tells_the_box_to_the_millimetre(box, points):
    label = Label("east_in-to-west_out.7", box, points)
    again = Label.of(label.line)
    assert (again.vehicle, again.points) == (label.vehicle, points)
    assert np.abs(np.subtract(again.box, box))[:6].max() <= 0.0011
    assert abs(wrap_angle(again.box[6] - box[6])) <= 0.0001


@given(boxes, poses)
def test_boxes_return_from_a_tilted_sensor_as_they_were(box, pose):
    there = np.array([box])
    map_SE3_sensor = SE3.from_pose(pose)
    again = into_map(into_sensor(there, map_SE3_sensor), map_SE3_sensor)
    np.testing.assert_allclose(again[:, :6], there[:, :6], atol=1e-9)
    np.testing.assert_allclose(wrap_angle(again[:, 6] - there[:, 6]), 0, atol=1e-9)


def test_a_line_has_kittis_fields_in_kittis_camera_frame():
    # A car 20 m ahead and 3 m to the left that drives away, its bottom 1.7 m below the sensor.
    line = Label("a.1", (20, 3, -0.95, 4.5, 1.8, 1.5, 0), 42).line
    words = line.split()
    assert words[0] == "Car"
    height, width, length, right, down, ahead, around = (float(word) for word in words[8:15])
    assert (height, width, length) == (1.5, 1.8, 4.5)
    assert (right, down, ahead) == (-3, 1.7, 20)
    assert around == pytest.approx(-np.pi / 2, abs=1e-4)
    assert words[15:] == ["42", "a.1"]


def test_the_calibration_turns_the_axes_and_no_more():
    rows = dict(line.split(":") for line in CALIB.splitlines())
    cam_T_velo = np.array(rows["Tr_velo_to_cam"].split(), float).reshape(3, 4)
    np.testing.assert_array_equal(cam_T_velo @ [20, 3, -1.7, 1], [-3, 1.7, 20])
    assert set(rows) >= {"P0", "P1", "P2", "P3", "R0_rect"}


@pytest.mark.parametrize(
    "line",
    [
        "",
        "Car 1 2 3",
        "Van -1 0 -10 -1 -1 -1 -1 1.5 1.8 4.5 -3 1.7 20 -1.57 42 a.1",
        "Car -1 0 -10 -1 -1 -1 -1 nan 1.8 4.5 -3 1.7 20 -1.57 42 a.1",
        "Car -1 0 -10 -1 -1 -1 -1 1.5 0 4.5 -3 1.7 20 -1.57 42 a.1",
        "Car -1 0 -10 -1 -1 -1 -1 1.5 1.8 4.5 -3 1.7 20 -1.57 many a.1",
    ],
)
def test_a_line_that_is_no_label_says_so(line):
    with pytest.raises(ValueError, match=r"fields|number|int"):
        Label.of(line)
