"""The static world."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from protocol.roadmap import RoadMap
from sensing.config import SceneConfig
from sensing.mesh import TriangleMesh, overlap
from sensing.road import RoadArea
from sensing.scene import Scene, build_scene
from tests.roads import lane, street
from tests.sensing.solids import SEED

PARTS = ("ground", "kerbs", "buildings", "poles", "trees")
COUNTS = {"ground": 12600, "kerbs": 1902, "buildings": 170, "poles": 496, "trees": 2490}
MOMENTS_M = [1103607.525302, 112009.851187, 15873.194155, 33383.775897, 757980.871977]


def samples(mesh: TriangleMesh) -> np.ndarray:
    """Points in plan on every triangle."""
    share = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [0, 1, 1], [1, 0, 1], [1, 1, 1]])
    share = share / share.sum(axis=1, keepdims=True)
    return np.einsum("sk,tkd->tsd", share, mesh.corners[:, :, :2]).reshape(-1, 2)


def test_every_part_is_there_and_the_whole_is_small(scene: Scene) -> None:
    assert all(len(getattr(scene, part).triangles) for part in PARTS)
    assert len(scene.mesh.triangles) < 40_000


@pytest.mark.parametrize("part", PARTS[1:])
def test_nothing_stands_on_the_road(part: str, scene: Scene, road_map: RoadMap) -> None:
    clearance_m = RoadArea(road_map).clearance_m(samples(getattr(scene, part)))
    assert clearance_m.min() > -1e-3


def test_the_ground_has_no_gaps(scene: Scene) -> None:
    edges = np.sort(scene.ground.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    sides, uses = np.unique(edges, axis=0, return_counts=True)
    assert uses.max() == 2
    border = scene.ground.vertices[sides[uses == 1]].mean(axis=1)[:, :2]
    assert RoadArea(street()).clearance_m(border).min() > 60


def test_ground_near_the_road_is_the_terrain(scene: Scene, road_map: RoadMap) -> None:
    middle = scene.ground.corners.mean(axis=1).astype(np.float64)
    near = RoadArea(road_map).clearance_m(middle[:, :2]) < 10
    error_m = middle[near, 2] - scene.terrain.height_m(middle[near, :2])
    assert np.abs(error_m).max() < 1e-3


def test_faces_of_the_ground_look_up(scene: Scene) -> None:
    a, b, c = scene.ground.corners.astype(np.float64).transpose(1, 0, 2)
    assert np.cross(b - a, c - a)[:, 2].min() > 0


def test_the_same_seed_builds_the_same_scene_and_another_another(road_map: RoadMap) -> None:
    one, same, other = (build_scene(road_map, SceneConfig(), s).mesh for s in (SEED, SEED, 8))
    assert np.array_equal(one.vertices, same.vertices)
    assert np.array_equal(one.triangles, same.triangles)
    assert not np.array_equal(one.vertices[: len(other.vertices)], other.vertices)


def test_a_seed_builds_the_scene_that_it_always_built(scene: Scene) -> None:
    """Recordings and trained models rest on it; a change here changes them all."""
    parts = {part: getattr(scene, part) for part in PARTS}
    assert {part: len(mesh.triangles) for part, mesh in parts.items()} == COUNTS
    moments_m = [np.abs(mesh.vertices.astype(np.float64)).sum() for mesh in parts.values()]
    assert moments_m == pytest.approx(MOMENTS_M, rel=1e-9)


def test_buildings_keep_apart(scene: Scene) -> None:
    outlines = scene.buildings.vertices.reshape(-1, 8, 3)[:, :4, :2].astype(np.float64)
    assert len(outlines) > 5
    assert not any(overlap(one, other) for one, other in combinations(outlines, 2))


def test_an_empty_scene_may_be_asked_for(road_map: RoadMap) -> None:
    bare = SceneConfig(building_density=0, trees_per_100m=0, kerb_height_m=0)
    scene = build_scene(road_map, bare, SEED)
    assert not any(len(getattr(scene, part).triangles) for part in ("kerbs", "buildings", "trees"))


def test_the_users_buildings_replace_those_by_seed(road_map: RoadMap) -> None:
    corner = [(20.0, 20.0), (40.0, 20.0), (40.0, 30.0), (30.0, 30.0), (30.0, 40.0), (20.0, 40.0)]
    across = [(-50.0, -50.0), (200.0, -50.0), (200.0, 50.0), (-50.0, 50.0)]
    scene = build_scene(road_map, SceneConfig(), SEED, ([corner[::-1], across], [9.0, 9.0]))
    vertices = scene.buildings.vertices
    assert len(vertices) == 12  # the one across the road is left out
    top_m = vertices[:, 2].max()
    a, b, c = scene.buildings.corners[(scene.buildings.corners[:, :, 2] == top_m).all(axis=1)][
        :, :, :2
    ].transpose(1, 0, 2)
    roof_m2 = np.sum((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2
    assert roof_m2 == pytest.approx(300.0, rel=1e-4)


def test_kerbs_keep_off_a_road_that_bends() -> None:
    angle = np.linspace(0, 1.5, 9)
    bend = [(40 * float(np.sin(a)), 40 * float(np.cos(a)), 0.0) for a in angle]
    straight = street()
    lanes = [*straight.lanes, lane("bend_0", [(x - 120, y - 46, z) for x, y, z in bend])]
    road_map = straight.model_copy(update={"lanes": lanes})
    kerbs = build_scene(road_map, SceneConfig(), SEED).kerbs
    assert RoadArea(road_map).clearance_m(kerbs.vertices[:, :2]).min() > -0.03
