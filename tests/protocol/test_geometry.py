import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.geometry import SE3, euler_rotation, wrap_angle

metres = st.floats(-500, 500)
angles = st.floats(-3.1, 3.1)
poses = st.tuples(metres, metres, metres, angles, st.floats(-1.5, 1.5), angles).map(np.array)


@given(poses)
def test_a_transform_and_its_inverse_cancel(pose):
    a_SE3_b = SE3.from_pose(pose)
    points = np.array([[1.0, 2.0, 3.0], [-40.0, 0.5, 7.0]])
    assert np.allclose(a_SE3_b.inverse().apply(a_SE3_b.apply(points)), points, atol=1e-9)


@given(poses, poses)
def test_composition_is_applying_one_after_the_other(first, second):
    a_SE3_b, b_SE3_c = SE3.from_pose(first), SE3.from_pose(second)
    points = np.array([[1.0, 2.0, 3.0], [-40.0, 0.5, 7.0]])
    assert np.allclose((a_SE3_b @ b_SE3_c).apply(points), a_SE3_b.apply(b_SE3_c.apply(points)))


@given(poses)
def test_a_pose_survives_the_way_through_a_transform(pose):
    again = SE3.from_pose(SE3.from_pose(pose).as_pose())
    assert np.allclose(again.rotation, euler_rotation(*pose[3:]), atol=1e-7)
    assert np.allclose(again.translation, pose[:3])


def test_yaw_turns_counterclockwise_and_positive_pitch_lowers_the_nose():
    assert np.allclose(SE3.from_pose([0, 0, 0, 0, 0, np.pi / 2]).apply(np.eye(3)[:1]), [[0, 1, 0]])
    assert SE3.from_pose([0, 0, 0, 0, 0.1, 0]).apply(np.eye(3)[:1])[0, 2] < 0


def test_a_transform_of_the_wrong_shape_cannot_be_built():
    with pytest.raises(ValueError, match=r"shape \(2,\), needs \(3,\)"):
        SE3(np.eye(3), np.zeros(2))


def test_a_transform_cannot_be_changed():
    with pytest.raises(ValueError, match="read-only"):
        SE3.identity().translation[0] = 1


@given(st.floats(-100, 100))
def test_wrapped_angles_point_the_same_way(angle):
    wrapped = float(wrap_angle(angle))
    assert -np.pi <= wrapped < np.pi + 1e-12
    assert np.isclose(np.cos(wrapped), np.cos(angle))
    assert np.isclose(np.sin(wrapped), np.sin(angle))
