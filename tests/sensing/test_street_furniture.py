"""Walls, hedges and such beside the road."""

from __future__ import annotations

import numpy as np
import pytest

from protocol.roadmap import RoadMap
from sensing.config import SceneConfig
from sensing.mesh import TriangleMesh
from sensing.road import RoadArea
from sensing.scene import Scene, build_scene
from sensing.street_furniture import _KINDS
from tests.sensing.solids import SEED
from tests.sensing.test_scene import samples

FURNISHED = SceneConfig(furniture_per_100m=12)


@pytest.fixture(scope="module")
def furnished(road_map: RoadMap) -> Scene:
    return build_scene(road_map, FURNISHED, SEED)


def test_none_stands_where_none_is_asked_for_and_else_nothing_else_changes(
    scene: Scene, furnished: Scene
) -> None:
    assert not len(scene.furniture.triangles)
    assert len(furnished.furniture.triangles)
    before = scene.mesh.vertices
    assert np.array_equal(furnished.mesh.vertices[: len(before)], before)
    assert len(furnished.surfaces().reflectivity) == len(furnished.mesh.triangles)


def test_nothing_hangs_over_a_lane_or_stands_where_cars_park(
    furnished: Scene, road_map: RoadMap
) -> None:
    places = samples(furnished.furniture)
    assert RoadArea(road_map).clearance_m(places).min() > 0


def test_a_seed_draws_the_same_and_another_another(road_map: RoadMap, furnished: Scene) -> None:
    again, other = (build_scene(road_map, FURNISHED, seed) for seed in (SEED, SEED + 1))
    assert np.array_equal(again.furniture.vertices, furnished.furniture.vertices)
    assert not np.array_equal(other.furniture.vertices, furnished.furniture.vertices)


@pytest.mark.parametrize("kind", _KINDS, ids=lambda one: one.__name__)
def test_each_kind_stands_in_the_ground_within_its_outline(kind) -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        built = kind(rng)
        long_m, wide_m = np.array(built.size_m) + 2 * built.overhang_m
        mesh: TriangleMesh = built.build(np.array([5.0, -3.0]), 0.7, 2.0)
        off = mesh.vertices.astype(np.float64) - [5.0, -3.0, 2.0]
        along = off[:, 0] * np.cos(0.7) + off[:, 1] * np.sin(0.7)
        across = off[:, 1] * np.cos(0.7) - off[:, 0] * np.sin(0.7)
        leaf_m = 0.3 + 0.025 * max(long_m, wide_m)  # leaves stick out
        assert np.abs(along).max() < long_m / 2 + leaf_m
        assert np.abs(across).max() < wide_m / 2 + leaf_m
        assert off[:, 2].min() < 0 < off[:, 2].max() < 7.5
