"""The bodies that sensors see: each vehicle type's mesh, scaled to its size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from protocol.errors import MessageError
from protocol.geometry import Floats
from protocol.messages import Setup, VehicleType
from sensing.mesh import TriangleMesh


@dataclass(frozen=True, slots=True, eq=False)
class Bodies:
    """What a frame's bodies look like: index of the mesh (N,) and size (N, 3) in m."""

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
        """Cuts the meshes out of a run's set-up.

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
                    setup.mesh_vertices[vertex : ends[0]], setup.mesh_triangles[triangle : ends[1]]
                )
            except ValueError as error:
                raise MessageError(f"mesh {part.name}: {error}") from None
            vertex, triangle = ends
        return cls(setup.vehicle_types, meshes)

    def bodies(self, types: Sequence[str]) -> Bodies:
        """Looks up a frame's types.

        Raises:
            MessageError: a type that the set-up did not announce.
        """
        try:
            found = [self._types[name] for name in types]
        except KeyError as error:
            raise MessageError(f"body type {error} is not in the set-up") from None
        mesh = np.array([index for index, _ in found], np.int64)
        return Bodies(mesh, np.array([size for _, size in found], np.float64).reshape(-1, 3))
