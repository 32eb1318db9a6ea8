"""The static scene that sensors see: ground, kerbs, buildings, poles and trees."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from protocol.geometry import Floats
from protocol.messages import Setup
from protocol.roadmap import RoadMap
from sensing.config import SceneConfig
from sensing.mesh import (
    TriangleMesh,
    contains,
    extrude,
    merge,
    overlap,
    regular_polygon,
    signed_area_m2,
    strip,
    triangulate,
)
from sensing.noise import stream
from sensing.reflectivity import Surfaces
from sensing.road import Edge, RoadArea
from sensing.street_furniture import street_furniture
from sensing.terrain import Terrain, ground

_WIDTHS = (1.0, 0.5, 0.1)  # of the pavement's, tried in turn where another lane is near
_SLOPE_M = 0.4  # the pavement falls to the ground over this width
_KERB_SUNK_M = 0.15  # surfaces end this far under the ground, so that no ray slips through


def kerbs(
    edges: Sequence[Edge], terrain: Terrain, road: RoadArea, config: SceneConfig
) -> TriangleMesh:
    """Returns kerbs with pavements; empty where their height is 0."""
    if config.kerb_height_m == 0:
        return merge([])
    return merge(_kerb(edge, terrain, _widths(edge, road, config), config) for edge in edges)


def _widths(edge: Edge, road: RoadArea, config: SceneConfig) -> Floats:
    """Returns a width (K,) for each section: the widest that stays off the road."""
    widths = np.zeros(len(edge.points))
    for share in reversed(_WIDTHS):
        width_m = config.sidewalk_width_m * share
        far = edge.points + edge.outward * (width_m + _SLOPE_M)
        widths[road.clearance_m(far) > 0] = width_m
    return widths


def _kerb(edge: Edge, terrain: Terrain, widths: Floats, config: SceneConfig) -> TriangleMesh:
    """Sweeps the profile: up at the edge, along the pavement, down behind it."""
    wide = widths > 0
    if np.count_nonzero(wide) < 2:
        return merge([])
    points, outward, widths = edge.points[wide], edge.outward[wide], widths[wide]
    level_m = edge.level_m[wide]
    rise_m = config.kerb_height_m
    profile = (
        (np.zeros_like(widths), -_KERB_SUNK_M),
        (np.zeros_like(widths), rise_m),
        (widths, rise_m),
        (widths + _SLOPE_M, -_KERB_SUNK_M),
    )
    sections = np.empty((len(points), len(profile), 3))
    for k, (offset, height_m) in enumerate(profile):
        xy = points + outward * offset[:, None]
        sections[:, k, :2] = xy
        sections[:, k, 2] = terrain.height_m(xy, level_m) + height_m
    return strip(sections)


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
    placed = _Placed()
    meshes: list[TriangleMesh] = []
    for edge in edges:
        for outline in _along(edge, config, rng):
            height_m = float(rng.uniform(*_HEIGHT_M))
            near = _border(outline)
            if road.clearance_m(near).min() < config.building_setback_m * 0.9:
                continue
            if placed.meets(outline):
                continue
            placed.add(outline)
            base_m = float(terrain.height_m(outline).min())
            meshes.append(extrude(outline, base_m - _WALL_SUNK_M, base_m + height_m))
    return meshes


_PLOT_M = 32.0
_APART_M = 1.0  # between boxes whose outlines certainly do not meet


class _Placed:
    """Convex outlines by the square plots that they touch."""

    def __init__(self) -> None:
        self._plots: dict[tuple[int, int], list[Floats]] = {}

    def add(self, outline: Floats) -> None:
        """Keeps an outline (K, 2)."""
        for plot in self._touched(outline):
            self._plots.setdefault(plot, []).append(outline)

    def meets(self, outline: Floats) -> bool:
        """Returns whether an outline (K, 2) meets one that was added."""
        near = (other for plot in self._touched(outline) for other in self._plots.get(plot, ()))
        return any(overlap(outline, other) for other in {id(o): o for o in near}.values())

    def _touched(self, outline: Floats) -> list[tuple[int, int]]:
        low, high = outline.min(axis=0) - _APART_M / 2, outline.max(axis=0) + _APART_M / 2
        (i, j), (k, m) = np.floor(np.stack([low, high]) / _PLOT_M).astype(int).tolist()
        return list(product(range(i, k + 1), range(j, m + 1)))


def from_polygons(
    polygons: Sequence[Sequence[tuple[float, float]]],
    heights_m: Sequence[float],
    terrain: Terrain,
    road_map: RoadMap,
) -> list[TriangleMesh]:
    """Returns the user's buildings; outlines that cover a lane are dropped."""
    on_lanes = np.concatenate([lane.points[:, :2] for lane in road_map.lanes])
    meshes = []
    for corners, height_m in zip(polygons, heights_m, strict=True):
        outline = _cleaned(corners)
        if len(outline) < 3:
            continue
        low, high = outline.min(axis=0), outline.max(axis=0)
        near = ((on_lanes >= low) & (on_lanes <= high)).all(axis=1)
        if contains(outline, on_lanes[near]).any():
            continue
        base_m = float(terrain.height_m(outline).min())
        bottom_m, top_m = base_m - _WALL_SUNK_M, base_m + height_m
        meshes.append(extrude(outline, bottom_m, top_m, roof=triangulate(outline)))
    return meshes


def _along(edge: Edge, config: SceneConfig, rng: np.random.Generator) -> Iterator[Floats]:
    """Walks along an edge and yields outlines (4, 2), with gaps according to the density."""
    step = np.hypot(*np.diff(edge.points, axis=0).T)
    along_m = np.concatenate([[0.0], np.cumsum(step)])
    at_m = float(rng.uniform(0, _FRONT_M[0]))
    while at_m < along_m[-1]:
        front_m, depth_m = float(rng.uniform(*_FRONT_M)), float(rng.uniform(*_DEPTH_M))
        back_m = config.building_setback_m + float(rng.uniform(0, _JITTER_M))
        built = rng.random() < config.building_density
        k = int(np.searchsorted(along_m, min(at_m + front_m / 2, along_m[-1])))
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
    feet = street_light_feet(edges, road, config)
    return merge(_pole(foot, terrain, _LIGHT_RADIUS_M, _LIGHT_HEIGHT_M) for foot in feet)


def street_light_feet(edges: Sequence[Edge], road: RoadArea, config: SceneConfig) -> Floats:
    """Returns where street lights stand (N, 2), and the height of the lane beside (N, 3)."""
    feet = [
        foot
        for edge in edges
        for foot in _feet(edge, config.pole_spacing_m, config.pole_spacing_m / 2, _POLE_OFFSET_M)
    ]
    return np.array(_off_road(feet, road, _LIGHT_RADIUS_M)).reshape(-1, 3)


def signal_posts(road_map: RoadMap, terrain: Terrain, road: RoadArea) -> TriangleMesh:
    """Returns a post with a signal head at the right of each approach's stop bar."""
    feet: list[Floats] = []
    for name in road_map.incoming:
        lane = road_map.by_id[name]
        ahead = lane.points[-1, :2] - lane.points[-2, :2]
        ahead /= np.hypot(*ahead)
        right = np.array([ahead[1], -ahead[0]])
        aside = right * (lane.width_m / 2 + _POLE_OFFSET_M)
        feet.append(lane.points[-1] + [*aside, 0.0])
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
    feet: list[Floats] = []
    radii_m: list[float] = []
    grown: list[TriangleMesh] = []
    for edge in edges:
        length_m = float(np.hypot(*np.diff(edge.points, axis=0).T).sum())
        for _ in range(int(rng.poisson(length_m * config.trees_per_100m / 100))):
            k = int(rng.integers(len(edge.points)))
            back_m = config.sidewalk_width_m + float(rng.uniform(1.5, 4.5))
            feet.append(edge.points[k] + edge.outward[k] * back_m)
            radii_m.append(float(rng.uniform(*_CROWN_RADIUS_M)))
            grown.append(_tree(feet[-1], radii_m[-1], terrain, rng))
    free = road.clearance_m(np.array(feet)) > np.array(radii_m) + _LEAF_M
    return merge(tree for tree, is_free in zip(grown, free, strict=True) if is_free)


def _feet(edge: Edge, spacing_m: float, first_m: float, offset_m: float) -> Iterator[Floats]:
    along_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(edge.points, axis=0).T))])
    for at_m in np.arange(first_m, along_m[-1], spacing_m):
        k = int(np.searchsorted(along_m, at_m))
        yield np.array([*(edge.points[k] + edge.outward[k] * offset_m), edge.level_m[k]])


def _off_road(feet: list[Floats], road: RoadArea, radius_m: float) -> list[Floats]:
    if not feet:
        return []
    clearance = road.clearance_m(np.array(feet)[:, :2])
    return [foot for foot, free_m in zip(feet, clearance, strict=True) if free_m > radius_m]


def _pole(foot: Floats, terrain: Terrain, radius_m: float, height_m: float) -> TriangleMesh:
    ground_m = float(terrain.height_m(foot[:2], foot[2])[0])
    ring = regular_polygon(foot, radius_m, 6)
    return extrude(ring, ground_m - _POLE_SUNK_M, ground_m + height_m, taper=0.7)


def _signal_post(foot: Floats, terrain: Terrain) -> list[TriangleMesh]:
    top_m = float(terrain.height_m(foot[:2], foot[2])[0]) + _POST_HEIGHT_M
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


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """The parts of the static world, in the map frame, and the terrain that they stand on."""

    terrain: Terrain
    ground: TriangleMesh
    kerbs: TriangleMesh
    buildings: TriangleMesh
    poles: TriangleMesh
    trees: TriangleMesh
    furniture: TriangleMesh

    @property
    def mesh(self) -> TriangleMesh:
        """All parts as one mesh."""
        return merge(self._parts())

    def surfaces(self) -> Surfaces:
        """Returns how the triangles of `mesh` reflect."""
        lengths = [len(part.triangles) for part in self._parts()]
        reflectivity, smooth = np.repeat(np.array(_OF_PARTS, np.float32), lengths, axis=0).T.copy()
        return Surfaces(self.mesh, reflectivity, smooth)

    def _parts(self) -> list[TriangleMesh]:
        return [self.ground, self.kerbs, self.buildings, self.poles, self.trees, self.furniture]


# Reflectivity at 905 nm and whether Lambert's law holds: asphalt, concrete, walls, painted metal,
# leaves, a mean of walls and leaves; ours, of what is usual.
_OF_PARTS = ((0.15, 0), (0.25, 0), (0.4, 1), (0.4, 1), (0.5, 0), (0.45, 0))


Outlines = list[list[tuple[float, float]]]


def build_scene(
    road_map: RoadMap,
    config: SceneConfig,
    seed: int,
    polygons: tuple[Outlines, list[float]] | None = None,
) -> Scene:
    """Builds the world around the road; nothing but ground lies on a lane or in the junction.

    Args:
        road_map: the lanes, in the map frame.
        config: what to build.
        seed: the scenario's; the same seed gives the same scene in every process.
        polygons: outlines and heights of the user's buildings, which replace those by seed.
    """
    terrain, road = Terrain(road_map, config, seed), RoadArea(road_map)
    edges = road.edges()
    if polygons is None:
        houses = buildings(edges, terrain, road, config, stream(seed, "buildings"))
    else:
        houses = from_polygons(*polygons, terrain, road_map)
    return Scene(
        terrain,
        ground(terrain, road),
        kerbs(edges, terrain, road, config),
        merge(houses),
        merge(
            [
                street_lights(edges, terrain, road, config),
                signal_posts(road_map, terrain, road),
            ]
        ),
        trees(edges, terrain, road, config, stream(seed, "trees")),
        street_furniture(
            edges, terrain, road, config.furniture_per_100m, stream(seed, "furniture")
        ),
    )


def scene_of(setup: Setup, config: SceneConfig, seed: int) -> Scene:
    """Builds the scene that a run's set-up describes."""
    polygons = None
    if config.polygons is not None:
        polygons = (setup.polygons, setup.polygon_heights_m)
    return build_scene(setup.road_map, config, seed, polygons)
