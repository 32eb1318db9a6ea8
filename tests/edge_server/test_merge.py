"""Points of all agents in one frame."""

from __future__ import annotations

import numpy as np

from edge_server.frame import Piece
from edge_server.merge import merge
from protocol.geometry import SE3

POINTS = np.random.default_rng(1).uniform(-40, 40, (500, 3)).astype(np.float32)


def piece(agent: str, pose: list[float]) -> Piece:
    return Piece(0, 0, agent, 0, 1, np.array(pose), POINTS, 0, 0, 0)


def test_exact_transforms_are_applied_piece_by_piece() -> None:
    poses = [[10.0, 4, 3, 0.02, -0.05, 2.0], [400.0, -80, 1, 0, 0, -1]]
    merged = merge([piece("a", poses[0]), piece("b", poses[1])], method="se3")
    expected = np.concatenate([SE3.from_pose(pose).apply(POINTS) for pose in poses])
    np.testing.assert_allclose(merged, expected, atol=1e-4)


def test_angle_differences_are_exact_between_level_sensors() -> None:
    pieces = [piece("a", [10, 4, 3, 0, 0, 2.0]), piece("b", [40, -8, 1, 0, 0, -1])]
    np.testing.assert_allclose(
        merge(pieces, method="euler"), merge(pieces, method="se3"), atol=1e-4
    )


def test_angle_differences_are_off_by_centimetres_on_a_slope() -> None:
    roadside = [0.0, 0, 3, 0, 0, 0.8]
    pieces = [piece("b", [40, -8, 1, 0.01, -0.035, -1])]
    apart = merge(pieces, method="euler", reference_pose=np.array(roadside)) - merge(pieces)
    worst_m = float(np.linalg.norm(apart, axis=1).max())
    assert worst_m < 1e-4  # a level reference: the differences are the angles themselves
    tilted = np.array([0.0, 0, 3, 0.03, 0.02, 0.8])
    apart = merge(pieces, method="euler", reference_pose=tilted) - merge(pieces)
    worst_m = float(np.linalg.norm(apart, axis=1).max())
    assert 0.02 < worst_m < 5.0


def test_no_pieces_give_no_points() -> None:
    assert merge([]).shape == (0, 3)
