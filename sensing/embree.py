"""Embree behind one call: how far along each ray the first triangle lies."""

from __future__ import annotations

import numpy as np
from embreex.mesh_construction import TriangleMesh as EmbreeMesh
from embreex.rtcore_scene import EmbreeScene

from perception.arrays import Floats32
from sensing.mesh import TriangleMesh


class Caster:
    """A mesh in Embree, whose search tree is built once, here."""

    def __init__(self, mesh: TriangleMesh) -> None:
        self._scene = EmbreeScene() if len(mesh.triangles) else None
        if self._scene is not None:
            EmbreeMesh(self._scene, mesh.vertices.copy(), mesh.triangles.copy())
            nowhere = np.zeros((1, 3), np.float32)
            self.cast(nowhere, nowhere + 1, np.ones(1, np.float32))

    def cast(self, origins: Floats32, directions: Floats32, limits: Floats32) -> None:
        """Lowers each limit to where its ray first hits; a ray that misses keeps its own.

        Distances count in lengths of the direction, which need not be 1, so that they stay the
        same under any affine map of the ray.

        Args:
            origins: (N, 3), contiguous.
            directions: (N, 3), contiguous.
            limits: (N,), contiguous; overwritten.
        """
        if self._scene is not None and len(limits):
            found = self._scene.run(origins, directions, limits, query="DISTANCE")
            if found is not limits:
                limits[:] = found
