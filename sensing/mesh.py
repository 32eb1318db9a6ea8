"""Triangle meshes: solids, plane outlines, and the bodies of vehicle types."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from protocol.errors import MessageError
from protocol.geometry import Floats
from protocol.messages import Setup, VehicleType

Vertices = npt.NDArray[np.float32]
Triangles = npt.NDArray[np.int32]
Materials = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class TriangleMesh:
    """Vertices (V, 3) in metres and triangles (T, 3) of indices into them.

    `materials` (T,) are of `Material`; empty means all paint. Arrays that can still be changed from
    elsewhere are copied.
    """

    vertices: Vertices
    triangles: Triangles
    materials: Materials = field(default_factory=lambda: np.zeros(0, np.uint8))

    def __post_init__(self) -> None:
        for name, dtype in (("vertices", np.float32), ("triangles", np.int32)):
            array = np.ascontiguousarray(getattr(self, name), dtype)
            if array.flags.writeable or array.base is not None:
                array = array.copy()
            array = array.reshape(-1, 3)
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        if len(self.materials) == 0:
            object.__setattr__(self, "materials", np.zeros(len(self.triangles), np.uint8))
        if len(self.materials) != len(self.triangles):
            raise ValueError(f"{len(self.materials)} materials, {len(self.triangles)} triangles")
        if self.triangles.size and not (
            self.triangles.min() >= 0 and self.triangles.max() < len(self.vertices)
        ):
            raise ValueError(
                f"a triangle names vertex {self.triangles.max()} or {self.triangles.min()}, "
                f"the mesh has {len(self.vertices)}"
            )

    @classmethod
    def of(cls, vertices: npt.ArrayLike, triangles: npt.ArrayLike) -> TriangleMesh:
        """Builds a mesh from arrays of any number type."""
        return cls(np.asarray(vertices, np.float32), np.asarray(triangles, np.int32))

    @property
    def corners(self) -> Vertices:
        """The triangles' corners (T, 3, 3)."""
        result: Vertices = self.vertices[self.triangles]
        return result


def merge(meshes: Iterable[TriangleMesh]) -> TriangleMesh:
    """Returns all meshes as one."""
    vertices: list[Vertices] = [np.empty((0, 3), np.float32)]
    triangles: list[Triangles] = [np.empty((0, 3), np.int32)]
    offset = 0
    for mesh in meshes:
        vertices.append(mesh.vertices)
        triangles.append(mesh.triangles + np.int32(offset))
        offset += len(mesh.vertices)
    every_vertex, every_triangle = np.concatenate(vertices), np.concatenate(triangles)
    for array in (every_vertex, every_triangle):
        array.setflags(write=False)  # which saves the mesh a copy
    return TriangleMesh(every_vertex, every_triangle)


def extrude(
    outline: npt.ArrayLike,
    bottom_m: float,
    top_m: float,
    *,
    taper: float = 1.0,
    roof: Sequence[tuple[int, int, int]] | None = None,
) -> TriangleMesh:
    """Returns the walls over an outline (K, 2) and the roof upon them.

    Args:
        outline: corners in order.
        bottom_m: where the walls begin.
        top_m: where they end.
        taper: scales the outline at the top about its middle.
        roof: triangles of the outline's corners; without, the outline must be convex.
    """
    base = np.asarray(outline, np.float64)
    count = len(base)
    middle = base.mean(axis=0)
    top = middle + (base - middle) * taper
    here = np.arange(count)
    after = (here + 1) % count
    if roof is None:
        roof = [(0, k, k + 1) for k in range(1, count - 1)]
    triangles = [
        np.stack([here, after, after + count], -1),
        np.stack([here, after + count, here + count], -1),
        np.array(roof, np.int64).reshape(-1, 3) + count,
    ]
    vertices = np.vstack([_at_height(base, bottom_m), _at_height(top, top_m)])
    return TriangleMesh.of(vertices, np.concatenate(triangles))


def regular_polygon(centre: npt.ArrayLike, radius_m: float, sides: int) -> npt.NDArray[np.float64]:
    """Returns the corners (sides, 2) of a regular polygon around a point."""
    angle = np.arange(sides) * (2 * np.pi / sides)
    ring = np.stack([np.cos(angle), np.sin(angle)], -1) * radius_m
    return np.asarray(ring + np.asarray(centre, np.float64)[:2])


def strip(profiles: npt.NDArray[np.float64]) -> TriangleMesh:
    """Returns the surface through profiles (K, P, 3): K cross sections of P points each."""
    sections, points, _ = profiles.shape
    node = np.arange(sections * points).reshape(sections, points)
    a, b = node[:-1, :-1].ravel(), node[1:, :-1].ravel()
    c, d = node[1:, 1:].ravel(), node[:-1, 1:].ravel()
    triangles = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    return TriangleMesh.of(profiles.reshape(-1, 3), triangles)


def _at_height(outline: npt.NDArray[np.float64], height_m: float) -> npt.NDArray[np.float64]:
    return np.column_stack([outline, np.full(len(outline), height_m)])


def signed_area_m2(outline: Floats) -> float:
    """Returns the area within an outline (K, 2), positive if it runs counter-clockwise."""
    after = np.roll(outline, -1, axis=0)
    return float(np.sum(outline[:, 0] * after[:, 1] - after[:, 0] * outline[:, 1]) / 2)


def triangulate(outline: Floats) -> list[tuple[int, int, int]]:
    """Cuts the ears off a counter-clockwise outline (K, 2); indices are into it.

    An outline that crosses itself yields the triangles found until no ear is left.
    """
    left = list(range(len(outline)))
    found: list[tuple[int, int, int]] = []
    while len(left) > 3:
        ear = next((k for k in range(len(left)) if _is_ear(outline, left, k)), None)
        if ear is None:
            return found
        found.append((left[ear - 1], left[ear], left[(ear + 1) % len(left)]))
        del left[ear]
    return [*found, (left[0], left[1], left[2])]


def contains(outline: Floats, places: Floats) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Returns for places (N, 2) whether they lie within an outline (K, 2)."""
    x, y = places[:, 0], places[:, 1]
    inside = np.zeros(len(places), np.bool_)
    for (x0, y0), (x1, y1) in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        if y0 != y1:
            crosses = (y0 > y) != (y1 > y)
            inside ^= crosses & (x < (x1 - x0) * (y - y0) / (y1 - y0) + x0)
    return inside


def overlap(one: Floats, other: Floats) -> bool:
    """Returns whether two convex outlines meet: no side of either separates them."""
    for outline in (one, other):
        side = np.roll(outline, -1, axis=0) - outline
        for normal in np.column_stack([-side[:, 1], side[:, 0]]):
            a = one[:, 0] * normal[0] + one[:, 1] * normal[1]
            b = other[:, 0] * normal[0] + other[:, 1] * normal[1]
            if a.max() < b.min() or b.max() < a.min():
                return False
    return True


def _is_ear(outline: Floats, left: list[int], k: int) -> bool:
    ear = [left[k - 1], left[k], left[(k + 1) % len(left)]]
    corners = outline[ear]
    if signed_area_m2(corners) <= 0:
        return False
    others = [i for i in left if i not in ear]
    return not contains(corners, outline[others]).any()


@dataclass(frozen=True, slots=True, eq=False)
class BodyShapes:
    """Shapes of a frame's bodies: index of the mesh (N,) and size (N, 3) in m."""

    mesh: npt.NDArray[np.int64]
    size_m: Floats


class VehicleShapes:
    """Unit-sized meshes and the types that use them.

    Attributes:
        meshes: footprint's centre at the origin on the ground, x forward, extent 1 on each axis.
    """

    def __init__(self, types: Sequence[VehicleType], meshes: Mapping[str, TriangleMesh]) -> None:
        names = sorted(meshes)
        self.meshes = [meshes[name] for name in names]
        self._types: dict[str, tuple[int, tuple[float, float, float]]] = {}
        for kind in types:
            if kind.mesh not in meshes:
                raise MessageError(f"type {kind.name} has mesh {kind.mesh!r}; there are {names}")
            size_m = (kind.length_m, kind.width_m, kind.height_m)
            if min(size_m) <= 0:
                raise MessageError(f"type {kind.name} has size {size_m} m; each must be positive")
            self._types[kind.name] = (names.index(kind.mesh), size_m)

    @classmethod
    def from_setup(cls, setup: Setup) -> VehicleShapes:
        """Extracts the meshes from a run's setup.

        Raises:
            MessageError: a part lies outside the arrays, or a type names no part.
        """
        meshes: dict[str, TriangleMesh] = {}
        vertex = triangle = 0
        for part in setup.meshes:
            ends = vertex + part.vertices, triangle + part.triangles
            if ends[0] > len(setup.mesh_vertices) or ends[1] > len(setup.mesh_triangles):
                raise MessageError(f"mesh {part.name} ends beyond the set-up's arrays, at {ends}")
            try:
                meshes[part.name] = TriangleMesh(
                    setup.mesh_vertices[vertex : ends[0]],
                    setup.mesh_triangles[triangle : ends[1]],
                    setup.mesh_materials[triangle : ends[1]],
                )
            except ValueError as error:
                raise MessageError(f"mesh {part.name}: {error}") from None
            vertex, triangle = ends
        return cls(setup.vehicle_types, meshes)

    def bodies(self, types: Sequence[str]) -> BodyShapes:
        """Looks up a frame's types.

        Raises:
            MessageError: a type that the setup does not contain.
        """
        try:
            found = [self._types[name] for name in types]
        except KeyError as error:
            raise MessageError(f"body type {error} is not in the set-up") from None
        mesh = np.array([index for index, _ in found], np.int64)
        return BodyShapes(mesh, np.array([size for _, size in found], np.float64).reshape(-1, 3))
