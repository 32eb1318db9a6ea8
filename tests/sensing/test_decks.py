"""Where a road crosses another at a height, each has its own surface."""

from __future__ import annotations

import numpy as np
import pytest

from sensing.config import SceneConfig
from sensing.embree import Caster
from sensing.scene import build_scene
from sensing.terrain import Terrain
from tests.roads import bridge, street
from tests.sensing.solids import SEED

HIGH_M = 7.0
FLAT = SceneConfig(terrain_amplitude_m=0)
ROADS = bridge(HIGH_M)
TERRAIN = Terrain(ROADS, FLAT, SEED)
ALONG_M = np.linspace(-150.0, 150.0, 121)


def test_the_lower_road_stays_as_flat_as_it_is_mapped() -> None:
    for y in (-3.5, 0.0, 3.5):
        height_m = TERRAIN.height_m(np.column_stack([ALONG_M, np.full(121, y)]), 0.0)
        assert np.abs(height_m).max() < 0.05


def test_the_upper_road_keeps_its_own_height_over_the_lower_one() -> None:
    lane = ROADS.by_id["up_0"].points
    y = np.linspace(lane[1, 1], lane[-2, 1], 100)
    mapped_m = np.interp(y, lane[:, 1], lane[:, 2])
    found_m = TERRAIN.height_m(np.column_stack([np.full(100, 61.75), y]), mapped_m)
    assert np.abs(found_m - mapped_m).max() < 0.3  # where it bends, heights are smoothed
    assert found_m.max() > HIGH_M - 0.1


def test_bodies_stand_on_the_road_that_they_are_on_and_drive_onto_the_deck_without_a_step() -> None:
    lane = ROADS.by_id["up_0"].points
    y = np.linspace(-140.0, 140.0, 561)
    mapped_m = np.interp(y, lane[:, 1], lane[:, 2])
    up = TERRAIN.body_poses(np.full(561, 61.75), y, np.full(561, np.pi / 2), mapped_m)
    assert np.abs(np.diff(up[:, 2])).max() < 0.06  # half a metre ahead, on a grade of 10 %
    below = TERRAIN.body_poses([61.75], [3.0], [0.0], [0.0])
    assert below[0, 2] == pytest.approx(0.0, abs=0.05)


def test_roads_that_do_not_cross_have_no_deck() -> None:
    assert len(Terrain(street(climb_m=8.0), FLAT, SEED).deck_mesh.triangles) == 0
    assert len(TERRAIN.deck_mesh.triangles) > 0


def test_rays_from_below_end_at_the_deck_and_from_above_on_it() -> None:
    scene = build_scene(ROADS, FLAT, SEED)
    caster = Caster(scene.mesh)
    starts = np.array([[61.75, 61.75], [3.0, 3.0], [1.0, HIGH_M + 3.0]], np.float32)
    rays, range_m = np.array([[0, 0], [0, 0], [1, -1]], np.float32), np.full(2, 50, np.float32)
    caster.cast(starts, rays, range_m, np.zeros(2, np.int32))
    assert range_m == pytest.approx([HIGH_M - 0.8 - 1.0, 3.0], abs=0.1)
