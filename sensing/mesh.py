"""Triangle meshes and the few solids that scenes are built of."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Vertices = npt.NDArray[np.float32]
Triangles = npt.NDArray[np.int32]


@dataclass(frozen=True, slots=True, eq=False)
class TriangleMesh:
    """Vertices (V, 3) in metres and triangles (T, 3) of indices into them."""

    vertices: Vertices
    triangles: Triangles

    def __post_init__(self) -> None:
        for name, dtype in (("vertices", np.float32), ("triangles", np.int32)):
            array = np.array(getattr(self, name), dtype).reshape(-1, 3)
            array.setflags(write=False)
            object.__setattr__(self, name, array)
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
    return TriangleMesh(np.concatenate(vertices), np.concatenate(triangles))


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
        roof: triangles of the outline's corners; left out, the outline must be convex.
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
