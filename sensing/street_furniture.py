"""Street furniture: walls, fences, hedges, cabinets, sheds and roofs beside the road.

A detector that has seen none of them takes them for vehicles. Sizes are those of common ones; of
boxes none is as large as a car, and sheds are wider than lorries, so that no label is ambiguous.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

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
Built = tuple[tuple[float, float], Callable[[Floats, float, float], TriangleMesh]]
"""Length and width of an object, and what makes its mesh from middle (2,), yaw and ground, m."""


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
        (long_m, wide_m), build = _KINDS[rng.choice(len(_KINDS), p=_SHARES)](rng)
        crosswise = rng.random() < _CROSSWISE
        yaw = float(np.arctan2(outward[1], outward[0]) + rng.normal(0, _STRAY_RAD))
        yaw += 0.0 if crosswise else np.pi / 2
        half_m = (long_m if crosswise else wide_m) / 2
        back_m = _NEAREST_M + half_m + (_BACK_M - _NEAREST_M) * float(rng.random()) ** 2
        middle = edge.points[k] + outward * back_m
        border = _outline(middle, yaw, (0, 0, long_m, wide_m), steps=8)
        if road.clearance_m(border).min() > _CLEAR_M:
            yield build(middle, yaw, float(terrain.height_m(middle, edge.level_m[k])[0]))


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

    return box[2:], build


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

    return (long_m, 0.2), build


def _lifted(xy: Floats, height_m: float) -> Floats:
    return np.column_stack([xy, np.full(len(xy), height_m)])


_LEAVES_PER_M2 = (6.0, 18.0)
_LEAF_M = (0.1, 0.25)
_CORE = 0.55  # of a hedge or bush, which no ray passes


def _hedge(rng: np.random.Generator) -> Built:
    long_m, wide_m = float(rng.uniform(2, 25)), float(rng.uniform(0.5, 1.8))
    return _leafy((long_m, wide_m, float(rng.uniform(0.5, 2.8))), np.inf, rng)


def _bush(rng: np.random.Generator) -> Built:
    long_m, wide_m = rng.uniform(0.7, 3.5, 2).tolist()
    return _leafy((long_m, wide_m, float(rng.uniform(0.4, 2.5))), 2.0, rng)


def _leafy(size_m: tuple[float, float, float], norm: float, rng: np.random.Generator) -> Built:
    """Leaves about a core: in a box where the `norm` is infinite, in a dome where it is 2."""
    long_m, wide_m, height_m = size_m
    area_m2 = 2 * height_m * (long_m + wide_m) + long_m * wide_m
    leaves = int(area_m2 * rng.uniform(*_LEAVES_PER_M2)) + 20
    spread = rng.uniform([-1, -1, 0], 1, (leaves, 3))
    length = np.linalg.norm(spread, norm, axis=1, keepdims=True)
    spread *= rng.uniform(0.6, 1.05, (leaves, 1)) / np.maximum(length, 1e-3)
    leaf_m = float(rng.uniform(*_LEAF_M))
    places = spread * [long_m / 2, wide_m / 2, height_m]
    corners = places[:, None] + rng.uniform(-leaf_m, leaf_m, (leaves, 3, 3))

    def build(middle: Floats, yaw: float, ground_m: float) -> TriangleMesh:
        cos, sin = np.cos(yaw), np.sin(yaw)
        turned = corners.reshape(-1, 3) @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
        crown = TriangleMesh.of(turned + np.array([*middle, ground_m]), np.arange(3 * leaves))
        core = _solid((0, 0, _CORE * long_m, _CORE * wide_m), _CORE * height_m)[1]
        return merge([core(middle, yaw, ground_m), crown])

    return (long_m, wide_m), build


def _roof(rng: np.random.Generator) -> Built:
    """A roof on posts, as of a bus stop or over pumps, perhaps with a wall and boxes below it."""
    long_m, wide_m = float(rng.uniform(2.5, 14)), float(rng.uniform(1.4, 9))
    under_m, thick_m = float(rng.uniform(2.2, 5.0)), float(rng.uniform(0.1, 0.7))
    post_m = float(rng.uniform(0.1, 0.4))
    inset = [(long_m - post_m) / 2, (wide_m - post_m) / 2]
    parts = [_solid((0, 0, long_m, wide_m), under_m + thick_m, under_m)[1]]
    parts += [
        _solid((a * inset[0], b * inset[1], post_m, post_m), under_m)[1]
        for a in (-1, 1)
        for b in (-1, 1)
    ]
    if rng.random() < 0.4:
        parts.append(_solid((0, -inset[1], long_m, 0.1), under_m)[1])
    for _ in range(int(rng.integers(0, 4))):
        at = rng.uniform(-0.4, 0.4, 2) * [long_m, wide_m]
        size = rng.uniform([0.4, 0.3], [1.4, 1.0])
        parts.append(_solid((*at, *size), float(rng.uniform(0.4, 1.9)))[1])

    def build(middle: Floats, yaw: float, ground_m: float) -> TriangleMesh:
        return merge(part(middle, yaw, ground_m) for part in parts)

    return (long_m, wide_m), build


_KINDS: tuple[Callable[[np.random.Generator], Built], ...]
_KINDS = (_wall, _shed, _box, _fence, _hedge, _bush, _roof)
_SHARES = (0.2, 0.12, 0.2, 0.12, 0.16, 0.14, 0.06)
