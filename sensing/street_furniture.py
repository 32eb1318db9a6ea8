"""Street furniture: walls, fences, hedges, boxes, sheds, roofs, houses and trees beside the road.

A detector that has seen none of them takes them for vehicles, or misses the cars below crowns.
Sizes are those of common ones; of boxes none is as large as a car, and sheds are wider than
lorries, so that no label is ambiguous.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from protocol.geometry import Floats
from sensing.mesh import TriangleMesh, extrude, merge
from sensing.road import Edge, RoadArea
from sensing.terrain import Terrain

_NEAREST_M = 2.8  # to the road's edge: cars may park beside it
_BACK_M = 22.0
_CLEAR_M = 0.3  # of all that is built, to any lane
_SUNK_M = 0.5  # built into the ground, which need not be level
_CROSSWISE = 0.25  # share of what stands across the street, as between plots
_STRAY_RAD = 0.08  # of what stands along the street or across it

Box = tuple[float, float, float, float]
"""In an object's frame: middle along and across, length and width, m."""
Build = Callable[[Floats, float, float], TriangleMesh]
"""Makes an object's mesh from its middle (2,), yaw and ground, m."""


@dataclass(frozen=True, slots=True)
class Built:
    """What an object is made by, its length and width on the ground, and by how much it overhangs.

    It stands up to `back_m` from the road.
    """

    size_m: tuple[float, float]
    build: Build
    back_m: float = _BACK_M
    overhang_m: float = 0.0


def street_furniture(
    edges: Sequence[Edge],
    terrain: Terrain,
    road: RoadArea,
    per_100m: float,
    rng: np.random.Generator,
) -> TriangleMesh:
    """Returns objects beside the road, `per_100m` of its edge on average; none is over a lane."""
    return merge(
        mesh for edge in edges if per_100m for mesh in _along(edge, terrain, road, per_100m, rng)
    )


def _along(
    edge: Edge, terrain: Terrain, road: RoadArea, per_100m: float, rng: np.random.Generator
) -> Iterator[TriangleMesh]:
    length_m = float(np.hypot(*np.diff(edge.points, axis=0).T).sum())
    for _ in range(int(rng.poisson(length_m * per_100m / 100))):
        k = int(rng.integers(len(edge.points)))
        outward = edge.outward[k]
        built = _KINDS[rng.choice(len(_KINDS), p=_SHARES)](rng)
        long_m, wide_m = built.size_m
        crosswise = rng.random() < _CROSSWISE
        yaw = float(np.arctan2(outward[1], outward[0]) + rng.normal(0, _STRAY_RAD))
        yaw += 0.0 if crosswise else np.pi / 2
        half_m = (long_m if crosswise else wide_m) / 2
        back_m = _NEAREST_M + half_m + (built.back_m - _NEAREST_M) * float(rng.random()) ** 2
        middle = edge.points[k] + outward * back_m
        border = _outline(middle, yaw, (0, 0, long_m, wide_m), steps=8)
        if road.clearance_m(border).min() > _CLEAR_M + built.overhang_m:
            yield built.build(middle, yaw, float(terrain.height_m(middle, edge.level_m[k])[0]))


def _outline(middle: Floats, yaw: float, box: Box, steps: int = 1) -> Floats:
    """Returns the border of a box in an object's frame, (4 `steps`, 2)."""
    x, y, long_m, wide_m = box
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * [long_m / 2, wide_m / 2] + [x, y]
    share = np.arange(steps)[:, None] / steps
    sides = np.roll(corners, -1, axis=0) - corners
    border = (corners[:, None] + share * sides[:, None]).reshape(-1, 2)
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.asarray(border @ np.array([[cos, sin], [-sin, cos]]) + middle)


def _solid(box: Box, height_m: float, bottom_m: float = -_SUNK_M) -> Built:
    def build(middle: Floats, yaw: float, ground_m: float) -> TriangleMesh:
        return extrude(_outline(middle, yaw, box), ground_m + bottom_m, ground_m + height_m)

    return Built(box[2:], build)


def _wall(rng: np.random.Generator) -> Built:
    long_m, thick_m = float(rng.uniform(3, 30)), float(rng.uniform(0.12, 0.45))
    return _solid((0, 0, long_m, thick_m), float(rng.uniform(0.5, 3.5)))


def _shed(rng: np.random.Generator) -> Built:
    """A garage or a low house: wider than a lorry."""
    long_m, wide_m = float(rng.uniform(3.5, 20)), float(rng.uniform(2.9, 8))
    return _solid((0, 0, long_m, wide_m), float(rng.uniform(2.3, 5.5)))


def _box(rng: np.random.Generator) -> Built:
    """A cabinet, container, kiosk or bench: shorter than a car."""
    long_m, wide_m = float(rng.uniform(0.4, 3.0)), float(rng.uniform(0.3, 2.4))
    return _solid((0, 0, long_m, wide_m), float(rng.uniform(0.5, 2.6)))


def _fence(rng: np.random.Generator) -> Built:
    """Slats with gaps, through which some rays pass."""
    long_m, height_m = float(rng.uniform(4, 30)), float(rng.uniform(0.8, 2.4))
    slat_m = float(rng.uniform(0.03, 0.12))
    at_m = np.arange(-long_m / 2, long_m / 2, slat_m + float(rng.uniform(0.08, 0.35)))

    def build(middle: Floats, yaw: float, ground_m: float) -> TriangleMesh:
        along = np.array([np.cos(yaw), np.sin(yaw)])
        left, right = (middle + (at_m + side * slat_m / 2)[:, None] * along for side in (-1, 1))
        low, high = ground_m - _SUNK_M, ground_m + height_m
        corners = np.stack(
            [_lifted(left, low), _lifted(right, low), _lifted(right, high), _lifted(left, high)], 1
        )
        first = 4 * np.arange(len(at_m))[:, None]
        triangles = np.concatenate([first + np.array(one) for one in ((0, 1, 2), (0, 2, 3))])
        return TriangleMesh.of(corners.reshape(-1, 3), triangles)

    return Built((long_m, 0.2), build)


def _lifted(xy: Floats, height_m: float) -> Floats:
    return np.column_stack([xy, np.full(len(xy), height_m)])


_LEAVES_PER_M2 = (6.0, 18.0)
_LEAF_M = (0.1, 0.25)
_CORE = 0.55  # of a hedge or bush, which no ray passes


def _hedge(rng: np.random.Generator) -> Built:
    long_m, wide_m = float(rng.uniform(2, 25)), float(rng.uniform(0.5, 1.8))
    return _leafy((long_m, wide_m, float(rng.uniform(0.5, 2.8))), np.inf, rng)


def _bush(rng: np.random.Generator) -> Built:
    long_m, wide_m = rng.uniform(0.7, 4.5, 2).tolist()
    return _leafy((long_m, wide_m, float(rng.uniform(0.4, 2.5))), 2.0, rng)


def _leafy(size_m: tuple[float, float, float], norm: float, rng: np.random.Generator) -> Built:
    """Leaves about a core: in a box where the `norm` is infinite, in a dome where it is 2."""
    long_m, wide_m, height_m = size_m
    area_m2 = 2 * height_m * (long_m + wide_m) + long_m * wide_m
    leaves = int(area_m2 * rng.uniform(*_LEAVES_PER_M2)) + 20
    core = _solid((0, 0, _CORE * long_m, _CORE * wide_m), _CORE * height_m).build
    parts = [core, _leaves(size_m, leaves, norm, 0.6, 0.0, rng)]
    return Built((long_m, wide_m), _all_of(parts))


def _leaves(
    size_m: tuple[float, float, float],
    leaves: int,
    norm: float,
    innermost: float,
    from_m: float,
    rng: np.random.Generator,
) -> Build:
    """So many leaves from a share of the way out, from so high on; see `_leafy`."""
    long_m, wide_m, height_m = size_m
    spread = rng.uniform([-1, -1, 0], 1, (leaves, 3))
    length = np.linalg.norm(spread, norm, axis=1, keepdims=True)
    spread *= rng.uniform(innermost, 1.05, (leaves, 1)) / np.maximum(length, 1e-3)
    leaf_m = float(rng.uniform(*_LEAF_M))
    places = spread * [long_m / 2, wide_m / 2, height_m] + [0, 0, from_m]
    corners = places[:, None] + rng.uniform(-leaf_m, leaf_m, (leaves, 3, 3))

    def build(middle: Floats, yaw: float, ground_m: float) -> TriangleMesh:
        cos, sin = np.cos(yaw), np.sin(yaw)
        turned = corners.reshape(-1, 3) @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
        return TriangleMesh.of(turned + np.array([*middle, ground_m]), np.arange(3 * leaves))

    return build


def _roof(rng: np.random.Generator) -> Built:
    """A roof on posts, as of a bus stop or over pumps, perhaps with a wall and boxes below it."""
    long_m, wide_m = float(rng.uniform(2.5, 14)), float(rng.uniform(1.4, 9))
    under_m, thick_m = float(rng.uniform(2.2, 5.0)), float(rng.uniform(0.1, 0.7))
    post_m = float(rng.uniform(0.1, 0.4))
    inset = [(long_m - post_m) / 2, (wide_m - post_m) / 2]
    parts = [_solid((0, 0, long_m, wide_m), under_m + thick_m, under_m).build]
    parts += [
        _solid((a * inset[0], b * inset[1], post_m, post_m), under_m).build
        for a in (-1, 1)
        for b in (-1, 1)
    ]
    if rng.random() < 0.4:
        parts.append(_solid((0, -inset[1], long_m, 0.1), under_m).build)
    for _ in range(int(rng.integers(0, 4))):
        at = rng.uniform(-0.4, 0.4, 2) * [long_m, wide_m]
        size = rng.uniform([0.4, 0.3], [1.4, 1.0])
        parts.append(_solid((*at, *size), float(rng.uniform(0.4, 1.9))).build)

    return Built((long_m, wide_m), _all_of(parts))


_SILL_M, _LINTEL_M = (0.3, 1.2), (1.9, 2.6)  # of windows, over the ground
_GLASS = 0.6  # share of a front's panes that rays pass, as they do at steep angles
_THICK_M = 0.2


def _house(rng: np.random.Generator) -> Built:
    """A shop or a house, into which one sees: a front of panes, walls, and what stands inside."""
    long_m, deep_m = float(rng.uniform(5, 18)), float(rng.uniform(3, 9))
    height_m = float(rng.uniform(2.8, 6))
    sill_m, lintel_m = float(rng.uniform(*_SILL_M)), float(rng.uniform(*_LINTEL_M))
    front_m, panes = (deep_m - _THICK_M) / 2, int(long_m / rng.uniform(1.2, 3.0)) + 1
    pane_m = long_m / panes
    parts = []
    for side in (-1, 1):  # which side faces the road, nobody knows
        whole = (0, side * front_m, long_m, _THICK_M)
        parts += [_solid(whole, sill_m).build, _solid(whole, height_m, lintel_m).build]
        parts.append(_solid((side * long_m / 2, 0, _THICK_M, deep_m), height_m).build)
        for pane in range(panes):
            is_open = rng.random() < _GLASS
            wide_m = 0.25 if is_open else pane_m
            at_m = (pane + 0.5) * pane_m - long_m / 2 - (pane_m - wide_m) / 2
            parts.append(_solid((at_m, side * front_m, wide_m, _THICK_M), lintel_m).build)
    for _ in range(int(rng.integers(1, 7))):
        size = rng.uniform([0.4, 0.3], [2.6, 0.9])
        at = rng.uniform(-0.45, 0.45, 2) * [long_m - size[0], deep_m - size[1]]
        parts.append(_solid((*at, *size), float(rng.uniform(0.7, 2.2))).build)
    return Built((long_m, deep_m), _all_of(parts))


_TRUNK_M, _CROWN_FROM_M = (0.15, 0.5), (1.9, 3.2)
_CROWN_M = (1.2, 3.6)  # its radius: that of a tree at the kerb reaches over parked cars
_TREE_LEAVES_PER_M3 = (2.0, 8.0)
_TREE_BACK_M = 6.0


def _street_tree(rng: np.random.Generator) -> Built:
    """A tree whose crown begins over the roofs of cars."""
    radius_m, from_m = float(rng.uniform(*_CROWN_M)), float(rng.uniform(*_CROWN_FROM_M))
    trunk_m = float(rng.uniform(*_TRUNK_M))
    size_m = (2 * radius_m, 2 * radius_m, float(rng.uniform(1.5, 4)))
    leaves = int(np.prod(size_m) * rng.uniform(*_TREE_LEAVES_PER_M3)) + 20
    trunk = _solid((0, 0, trunk_m, trunk_m), from_m + size_m[2] / 2).build
    crown = _leaves(size_m, leaves, 2.0, 0.2, from_m, rng)
    parts = [trunk, crown]
    return Built((trunk_m, trunk_m), _all_of(parts), _TREE_BACK_M, 1.05 * radius_m)


def _all_of(parts: Sequence[Build]) -> Build:
    def build(middle: Floats, yaw: float, ground_m: float) -> TriangleMesh:
        return merge(part(middle, yaw, ground_m) for part in parts)

    return build


_KINDS: tuple[Callable[[np.random.Generator], Built], ...]
_KINDS = (_wall, _shed, _box, _fence, _hedge, _bush, _roof, _house, _street_tree)
_SHARES = (0.1, 0.07, 0.1, 0.06, 0.09, 0.1, 0.03, 0.07, 0.38)
