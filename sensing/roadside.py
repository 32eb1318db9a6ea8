"""What stands along the road: street lights, signal posts and trees."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from protocol.geometry import Floats
from protocol.roadmap import RoadMap
from sensing.config import SceneConfig
from sensing.mesh import TriangleMesh, extrude, merge, regular_polygon
from sensing.road import Edge, RoadArea
from sensing.terrain import Terrain

_POLE_OFFSET_M = 0.7
_LIGHT_HEIGHT_M, _LIGHT_RADIUS_M = 8.0, 0.11
_POST_HEIGHT_M, _POST_RADIUS_M = 3.6, 0.09
_TRUNK_RADIUS_M = (0.12, 0.25)
_CROWN_RADIUS_M = (1.3, 2.4)
_LEAVES = 70  # triangles a crown; more of them cost and show little
_LEAF_M = 0.45
_POLE_SUNK_M = 0.3


def street_lights(
    edges: Sequence[Edge], terrain: Terrain, road: RoadArea, config: SceneConfig
) -> TriangleMesh:
    """Returns tapered poles behind the kerb, evenly spaced along each edge."""
    feet = [
        foot
        for edge in edges
        for foot in _feet(edge, config.pole_spacing_m, config.pole_spacing_m / 2, _POLE_OFFSET_M)
    ]
    return merge(
        _pole(foot, terrain, _LIGHT_RADIUS_M, _LIGHT_HEIGHT_M)
        for foot in _off_road(feet, road, _LIGHT_RADIUS_M)
    )


def signal_posts(road_map: RoadMap, terrain: Terrain, road: RoadArea) -> TriangleMesh:
    """Returns a post with a signal head at the right of each approach's stop bar."""
    feet: list[Floats] = []
    for name in road_map.incoming:
        lane = road_map.by_id[name]
        ahead = lane.points[-1, :2] - lane.points[-2, :2]
        ahead /= np.hypot(*ahead)
        right = np.array([ahead[1], -ahead[0]])
        feet.append(lane.points[-1, :2] + right * (lane.width_m / 2 + _POLE_OFFSET_M))
    posts = _off_road(feet, road, _POST_RADIUS_M)
    return merge(mesh for foot in posts for mesh in _signal_post(foot, terrain))


def trees(
    edges: Sequence[Edge],
    terrain: Terrain,
    road: RoadArea,
    config: SceneConfig,
    rng: np.random.Generator,
) -> TriangleMesh:
    """Returns trees behind the pavement; no crown hangs over a lane."""
    meshes = []
    for edge in edges:
        length_m = float(np.hypot(*np.diff(edge.points, axis=0).T).sum())
        for _ in range(int(rng.poisson(length_m * config.trees_per_100m / 100))):
            k = int(rng.integers(len(edge.points)))
            back_m = config.sidewalk_width_m + float(rng.uniform(1.5, 4.5))
            foot = edge.points[k] + edge.outward[k] * back_m
            radius_m = float(rng.uniform(*_CROWN_RADIUS_M))
            tree = _tree(foot, radius_m, terrain, rng)
            if road.clearance_m(foot)[0] > radius_m + _LEAF_M:
                meshes.append(tree)
    return merge(meshes)


def _feet(edge: Edge, spacing_m: float, first_m: float, offset_m: float) -> Iterator[Floats]:
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(edge.points, axis=0).T))])
    for at_m in np.arange(first_m, way[-1], spacing_m):
        k = int(np.searchsorted(way, at_m))
        yield edge.points[k] + edge.outward[k] * offset_m


def _off_road(feet: list[Floats], road: RoadArea, radius_m: float) -> list[Floats]:
    if not feet:
        return []
    clearance = road.clearance_m(np.array(feet))
    return [foot for foot, free_m in zip(feet, clearance, strict=True) if free_m > radius_m]


def _pole(foot: Floats, terrain: Terrain, radius_m: float, height_m: float) -> TriangleMesh:
    ground_m = float(terrain.height_m(foot)[0])
    ring = regular_polygon(foot, radius_m, 6)
    return extrude(ring, ground_m - _POLE_SUNK_M, ground_m + height_m, taper=0.7)


def _signal_post(foot: Floats, terrain: Terrain) -> list[TriangleMesh]:
    top_m = float(terrain.height_m(foot)[0]) + _POST_HEIGHT_M
    head = extrude(regular_polygon(foot, 0.25, 4), top_m - 1.0, top_m)
    return [_pole(foot, terrain, _POST_RADIUS_M, _POST_HEIGHT_M), head]


def _tree(
    foot: Floats, radius_m: float, terrain: Terrain, rng: np.random.Generator
) -> TriangleMesh:
    """A trunk, and a crown of loose leaves, through which some rays pass."""
    ground_m = float(terrain.height_m(foot)[0])
    trunk_m = float(rng.uniform(1.8, 2.8))
    ring = regular_polygon(foot, float(rng.uniform(*_TRUNK_RADIUS_M)), 5)
    trunk = extrude(ring, ground_m - _POLE_SUNK_M, ground_m + trunk_m + radius_m * 0.5, taper=0.6)
    middle = np.array([foot[0], foot[1], ground_m + trunk_m + radius_m * 0.8])
    spread = rng.standard_normal((_LEAVES, 3))
    spread /= np.maximum(np.sqrt((spread**2).sum(axis=1, keepdims=True)), 1e-9)
    spread *= radius_m * np.sqrt(rng.uniform(0.2, 1.0, (_LEAVES, 1)))
    corners = rng.uniform(-_LEAF_M, _LEAF_M, (_LEAVES, 3, 3))
    vertices = (middle + spread)[:, None, :] + corners
    crown = TriangleMesh.of(vertices.reshape(-1, 3), np.arange(_LEAVES * 3))
    return merge([trunk, crown])
