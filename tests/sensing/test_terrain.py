"""Heights of the ground, and bodies upon it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.geometry import SE3
from sensing.config import SceneConfig
from sensing.terrain import Terrain, believed_map
from tests.roads import lane, street
from tests.sensing.solids import SEED

FLAT = SceneConfig(terrain_amplitude_m=0)
CLIMB = Terrain(street(climb_m=8.0), FLAT, SEED)
ROUGH = Terrain(street(climb_m=8.0), SceneConfig(), SEED)


def test_the_ground_follows_the_lanes() -> None:
    x = np.linspace(-140, 140, 57)
    height_m = CLIMB.height_m(np.column_stack([x, np.full(57, -1.75)]))
    on_lanes = np.abs(x) > 20
    assert np.abs(height_m - x / 20)[on_lanes].max() < 0.02


def test_the_ground_away_from_the_road_is_smooth() -> None:
    y = np.linspace(5, 120, 400)
    height_m = CLIMB.height_m(np.column_stack([np.full(400, 70.0), y]))
    assert np.abs(np.diff(height_m)).max() < 0.05
    assert np.abs(height_m).max() <= 8.0


def test_undulation_keeps_within_its_amplitude_and_is_not_nothing() -> None:
    change = ROUGH.nodes - CLIMB.nodes
    assert np.abs(change).max() <= 0.12
    assert change.std() > 0.02


def test_the_same_seed_gives_the_same_ground_and_another_seed_another() -> None:
    again = Terrain(street(climb_m=8.0), SceneConfig(), SEED)
    other = Terrain(street(climb_m=8.0), SceneConfig(), SEED + 1)
    assert np.array_equal(ROUGH.nodes, again.nodes)
    assert not np.array_equal(ROUGH.nodes, other.nodes)


@settings(deadline=None, max_examples=50)
@given(st.floats(20, 140), st.floats(-6, 6), st.floats(-10, 10))
def test_a_bodys_wheels_are_on_the_ground(x: float, y: float, yaw: float) -> None:
    pose = ROUGH.body_poses([x], [y], [yaw])[0]
    wheels = np.array([[a, b, 0.0] for a in (1.35, -1.35) for b in (0.75, -0.75)])
    placed = SE3.from_pose(pose).apply(wheels)
    assert np.abs(placed[:, 2] - ROUGH.height_m(placed[:, :2])).max() < 0.02
    assert pose[5] == yaw


def test_uphill_means_nose_up() -> None:
    east, west, north = CLIMB.body_poses([60.0] * 3, [0.0] * 3, [0.0, np.pi, np.pi / 2])
    assert east[4] < -0.04
    assert west[4] > 0.04
    assert north[3] < -0.04  # its left looks west, which is lower


def test_places_beyond_the_grid_have_the_height_of_its_border() -> None:
    assert np.isfinite(CLIMB.height_m([[1e6, -1e6], [-1e6, 0.0]])).all()


def test_no_bodies_need_no_ground() -> None:
    assert CLIMB.body_poses([], [], []).shape == (0, 6)


def test_a_place_may_come_read_only() -> None:
    place = np.array([[1.0, 2.0]])
    place.setflags(write=False)
    assert CLIMB.height_m(place) == CLIMB.height_m([[1.0, 2.0]])


def test_a_citys_ground_is_as_fine_as_a_junctions() -> None:
    reach_m = 1100.0
    lanes = [
        lane("h_0", [(-reach_m, 0, 0), (reach_m, 0, 0)]),
        lane("v_0", [(0, -reach_m, 0), (0, reach_m, 0)]),
    ]
    city = Terrain(street().model_copy(update={"lanes": lanes}), FLAT, SEED)
    assert city.cell_m == CLIMB.cell_m


def test_a_map_with_errors_of_height_is_off_smoothly_and_as_much_as_configured() -> None:
    road = street(climb_m=8.0)
    assert believed_map(road, SceneConfig(), SEED) is road
    config = SceneConfig(map_height_std_m=0.5)
    off_m = []
    for seed in range(200):
        believed = believed_map(road, config, seed)
        points = believed.lanes[0].points
        assert points[:, :2].tolist() == road.lanes[0].points[:, :2].tolist()
        off_m.append(points[0, 2] - road.lanes[0].points[0, 2])
    assert np.std(off_m) == pytest.approx(0.5, rel=0.15)
    assert believed.lanes[0].successors == road.lanes[0].successors
    assert believed.intersections[0].centre[2] != road.intersections[0].centre[2]
