"""Vehicle shapes: the SUMO wheel's OBJ meshes, brought to unit size."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt

from protocol.errors import ConfigError
from protocol.messages import MeshPart

FILES = {
    "car": "car-normal-citrus.obj",
    "microcargo": "car-microcargo-citrus.obj",
    "minibus": "car-minibus-citrus.obj",
}
BOX = "box"


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Vertices (V, 3) float32 within x, y ±0.5 and z 0..1; triangles (T, 3) int32."""

    vertices: npt.NDArray[np.float32]
    triangles: npt.NDArray[np.int32]


def load_meshes(folder: Path) -> dict[str, Mesh]:
    """Reads the shapes for sensors from the wheel's folder `data/3D`, plus a plain box.

    The wheel's tram is left out: its 30 000 triangles would cost more than a street of cars.

    Raises:
        ConfigError: a file is missing.
    """
    meshes = {name: _unit(*_read_obj(folder / file)) for name, file in FILES.items()}
    meshes[BOX] = _box()
    return meshes


def pack(
    meshes: dict[str, Mesh],
) -> tuple[list[MeshPart], npt.NDArray[np.float32], npt.NDArray[np.int32]]:
    """Returns the parts, all vertices (V, 3) and all triangles (T, 3) in the order of names."""
    names = sorted(meshes)
    parts = [
        MeshPart(
            name=name, vertices=len(meshes[name].vertices), triangles=len(meshes[name].triangles)
        )
        for name in names
    ]
    vertices = np.concatenate([meshes[name].vertices for name in names])
    triangles = np.concatenate([meshes[name].triangles for name in names])
    return parts, vertices, triangles


def _read_obj(path: Path) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int32]]:
    if not path.is_file():
        raise ConfigError(f"vehicle mesh {path} is missing: reinstall the package eclipse-sumo")
    vertices: list[list[float]] = []
    triangles: list[tuple[int, int, int]] = []
    for line in path.read_text(encoding="utf-8").splitlines():
        words = line.split()
        if words[:1] == ["v"]:
            vertices.append([float(word) for word in words[1:4]])
        elif words[:1] == ["f"]:
            corners = [int(word.split("/")[0]) - 1 for word in words[1:]]
            triangles += [(corners[0], b, c) for b, c in pairwise(corners[1:])]
    return np.array(vertices), np.array(triangles, np.int32)


def _unit(vertices: npt.NDArray[np.float64], triangles: npt.NDArray[np.int32]) -> Mesh:
    # In the files z is forward (the headlights lie at its end), x is left and y is up.
    turned = vertices[:, [2, 0, 1]]
    low, high = turned.min(axis=0), turned.max(axis=0)
    scaled = (turned - low) / (high - low) - [0.5, 0.5, 0.0]
    return Mesh(scaled.astype(np.float32), triangles)


def _box() -> Mesh:
    corners = [(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)]
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [t for a, b, c, d in sides for t in ((a, b, c), (a, c, d))]
    return Mesh(np.array(corners, np.float32), np.array(triangles, np.int32))
