"""Buildings: boxes along the road drawn by seed, or the user's own outlines."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from protocol.geometry import Floats
from protocol.roadmap import RoadMap
from sensing.config import SceneConfig
from sensing.mesh import TriangleMesh, extrude
from sensing.outline import contains, overlap, signed_area_m2, triangulate
from sensing.road import Edge, RoadArea
from sensing.terrain import Terrain

_FRONT_M = (12.0, 32.0)
_DEPTH_M = (10.0, 18.0)
_HEIGHT_M = (6.0, 22.0)
_JITTER_M = 3.0  # fronts do not form one line
_WALL_SUNK_M = 2.0  # walls begin under the ground, which need not be level


def buildings(
    edges: Sequence[Edge],
    terrain: Terrain,
    road: RoadArea,
    config: SceneConfig,
    rng: np.random.Generator,
) -> list[TriangleMesh]:
    """Returns one mesh a building; none stands nearer to the road than the setback."""
    placed: list[Floats] = []
    meshes: list[TriangleMesh] = []
    for edge in edges:
        for outline in _along(edge, config, rng):
            height_m = float(rng.uniform(*_HEIGHT_M))
            near = _border(outline)
            if road.clearance_m(near).min() < config.building_setback_m * 0.9:
                continue
            if any(overlap(outline, other) for other in placed):
                continue
            placed.append(outline)
            base_m = float(terrain.height_m(outline).min())
            meshes.append(extrude(outline, base_m - _WALL_SUNK_M, base_m + height_m))
    return meshes


def from_polygons(
    polygons: Sequence[Sequence[tuple[float, float]]],
    heights_m: Sequence[float],
    terrain: Terrain,
    road_map: RoadMap,
) -> list[TriangleMesh]:
    """Returns the user's buildings; an outline that covers a lane is no building, and left out."""
    on_lanes = np.concatenate([lane.points[:, :2] for lane in road_map.lanes])
    meshes = []
    for corners, height_m in zip(polygons, heights_m, strict=True):
        outline = _cleaned(corners)
        if len(outline) < 3 or contains(outline, on_lanes).any():
            continue
        base_m = float(terrain.height_m(outline).min())
        bottom_m, top_m = base_m - _WALL_SUNK_M, base_m + height_m
        meshes.append(extrude(outline, bottom_m, top_m, roof=triangulate(outline)))
    return meshes


def _along(edge: Edge, config: SceneConfig, rng: np.random.Generator) -> Iterator[Floats]:
    """Walks along an edge and yields outlines (4, 2), with gaps according to the density."""
    step = np.hypot(*np.diff(edge.points, axis=0).T)
    way = np.concatenate([[0.0], np.cumsum(step)])
    at_m = float(rng.uniform(0, _FRONT_M[0]))
    while at_m < way[-1]:
        front_m, depth_m = float(rng.uniform(*_FRONT_M)), float(rng.uniform(*_DEPTH_M))
        back_m = config.building_setback_m + float(rng.uniform(0, _JITTER_M))
        built = rng.random() < config.building_density
        k = int(np.searchsorted(way, min(at_m + front_m / 2, way[-1])))
        if built:
            yield _box(edge.points[k], edge.outward[k], front_m, (back_m, back_m + depth_m))
        at_m += front_m + float(rng.uniform(2.0, 8.0))


def _box(foot: Floats, outward: Floats, front_m: float, reach_m: tuple[float, float]) -> Floats:
    along = np.array([outward[1], -outward[0]]) * (front_m / 2)
    near, far = foot + outward * reach_m[0], foot + outward * reach_m[1]
    return np.array([near - along, near + along, far + along, far - along])


def _border(outline: Floats) -> Floats:
    share = np.linspace(0, 1, 5, endpoint=False)[:, None, None]
    after = np.roll(outline, -1, axis=0)
    return np.asarray((outline + (after - outline) * share).reshape(-1, 2))


def _cleaned(corners: Sequence[tuple[float, float]]) -> Floats:
    """Returns a counter-clockwise outline (K, 2) that names no corner twice in a row."""
    outline = np.array(corners, np.float64).reshape(-1, 2)
    differs = np.abs(outline - np.roll(outline, -1, axis=0)).max(axis=1, initial=0) > 1e-3
    outline = outline[differs]
    return np.asarray(outline[::-1] if signed_area_m2(outline) < 0 else outline)
