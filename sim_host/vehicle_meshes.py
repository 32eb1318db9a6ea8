"""Meshes of vehicles and people: those of SUMO's wheel, and some composed of plain solids.

Composed ones are drawn in metres, x forward from the rear bumper, y to the left of the middle, z up
from the road, and scaled to unit size as all others are.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt

from protocol.errors import ConfigError
from protocol.messages import Material, MeshPart

FILES = {
    "car": "car-normal-citrus.obj",
    "microcargo": "car-microcargo-citrus.obj",
    "minibus": "car-minibus-citrus.obj",
    "pedestrian": "humanResting.obj",
}
BOX = "box"

# Of the files' materials; others are paint.
_MATERIALS = {
    "windows": Material.GLASS,
    "tires": Material.RUBBER,
    "lights": Material.RETROREFLECTOR,
    "lights.red": Material.RETROREFLECTOR,
    "lights.orange": Material.RETROREFLECTOR,
    "metal": Material.METAL,
    "Figur": Material.CLOTH,
}

Point = tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Vertices (V, 3) within x, y ±0.5 and z 0..1; triangles (T, 3), materials (T,)."""

    vertices: npt.NDArray[np.float32]
    triangles: npt.NDArray[np.int32]
    materials: npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class PackedMeshes:
    """All meshes' vertices (V, 3), triangles (T, 3) and materials (T,), and where each lies."""

    parts: list[MeshPart]
    vertices: npt.NDArray[np.float32]
    triangles: npt.NDArray[np.int32]
    materials: npt.NDArray[np.uint8]

    @classmethod
    def of(cls, meshes: dict[str, Mesh]) -> PackedMeshes:
        """Joins meshes in the order of their names."""
        names = sorted(meshes)
        return cls(
            [
                MeshPart(
                    name=name,
                    vertices=len(meshes[name].vertices),
                    triangles=len(meshes[name].triangles),
                )
                for name in names
            ],
            np.concatenate([meshes[name].vertices for name in names]),
            np.concatenate([meshes[name].triangles for name in names]),
            np.concatenate([meshes[name].materials for name in names]),
        )


def load_meshes(folder: Path) -> dict[str, Mesh]:
    """Reads the shapes for sensors from the wheel's folder `data/3D`, and composes the others.

    The wheel's tram is not used: its 30 000 triangles would cost more than a street of cars.

    Raises:
        ConfigError: a file is missing.
    """
    read = {name: _read_obj(folder / file) for name, file in FILES.items()}
    return read | {name: _unit(merge(solids())) for name, solids in _COMPOSED.items()}


def _read_obj(path: Path) -> Mesh:
    if not path.is_file():
        raise ConfigError(f"vehicle mesh {path} is missing: reinstall the package eclipse-sumo")
    vertices: list[list[float]] = []
    triangles: list[tuple[int, int, int]] = []
    materials: list[int] = []
    material = Material.PAINT
    for line in path.read_text(encoding="utf-8").splitlines():
        words = line.split()
        if words[:1] == ["v"]:
            vertices.append([float(word) for word in words[1:4]])
        elif words[:1] == ["usemtl"]:
            material = _MATERIALS.get(words[1], Material.PAINT)
        elif words[:1] == ["f"]:
            corners = [int(word.split("/")[0]) - 1 for word in words[1:]]
            triangles += [(corners[0], b, c) for b, c in pairwise(corners[1:])]
            materials += [material] * (len(corners) - 2)
    # In the files z is forward (the headlights lie at its end), x is left and y is up.
    turned = np.array(vertices)[:, [2, 0, 1]]
    return _unit(Solid(turned, np.array(triangles, np.int32), np.array(materials, np.uint8)))


@dataclass(frozen=True, slots=True, eq=False)
class Solid:
    """Vertices (V, 3) in m, triangles (T, 3), materials (T,)."""

    vertices: npt.NDArray[np.float64]
    triangles: npt.NDArray[np.int32]
    materials: npt.NDArray[np.uint8]


def merge(solids: Iterable[Solid]) -> Solid:
    """Returns all solids as one."""
    every = list(solids)
    offsets = np.cumsum([0, *(len(solid.vertices) for solid in every[:-1])])
    return Solid(
        np.concatenate([solid.vertices for solid in every]),
        np.concatenate(
            [solid.triangles + np.int32(n) for solid, n in zip(every, offsets, strict=True)]
        ),
        np.concatenate([solid.materials for solid in every]),
    )


def _unit(solid: Solid) -> Mesh:
    low, high = solid.vertices.min(axis=0), solid.vertices.max(axis=0)
    scaled = (solid.vertices - low) / (high - low) - [0.5, 0.5, 0.0]
    return Mesh(scaled.astype(np.float32), solid.triangles, solid.materials)


def prism(profile: Sequence[Point], y_m: Point, material: Material = Material.PAINT) -> Solid:
    """Returns a convex outline in x and z (K, 2), drawn out across y.

    It runs counter-clockwise, x to the right and z up: then all faces look outwards.
    """
    count = len(profile)
    outline = np.array(profile, np.float64)
    sides = [np.column_stack([outline[:, 0], np.full(count, y), outline[:, 1]]) for y in y_m]
    here, after = np.arange(count), np.roll(np.arange(count), -1)
    caps = np.array([(0, k, k + 1) for k in range(1, count - 1)])
    triangles = np.concatenate(
        [
            caps,
            caps[:, ::-1] + count,
            np.stack([here, after + count, after], -1),
            np.stack([here, here + count, after + count], -1),
        ]
    ).astype(np.int32)
    materials = np.full(len(triangles), material, np.uint8)
    return Solid(np.concatenate(sides), triangles, materials)


def block(x_m: Point, y_m: Point, z_m: Point, material: Material = Material.PAINT) -> Solid:
    """Returns a box between these bounds."""
    (x0, x1), (z0, z1) = x_m, z_m
    return prism([(x0, z0), (x1, z0), (x1, z1), (x0, z1)], y_m, material)


_SIDES = 10


def wheel(x_m: float, y_m: Point, radius_m: float) -> Solid:
    """Returns a wheel that stands on the road."""
    angles = np.arange(_SIDES) * (2 * np.pi / _SIDES)
    rim = [(x_m + radius_m * np.cos(a), radius_m * (1 + np.sin(a))) for a in angles]
    return prism(rim, y_m, Material.RUBBER)


def _axle(x_m: float, half_m: float, radius_m: float, wide_m: float) -> list[Solid]:
    return [
        wheel(x_m, (half_m - wide_m, half_m), radius_m),
        wheel(x_m, (-half_m, wide_m - half_m), radius_m),
    ]


def _lights(x_m: Point, half_m: float, z_m: Point) -> list[Solid]:
    """Returns a pair of lamps with reflectors, at one end."""
    return [
        block(x_m, (half_m - 0.35, half_m - 0.05), z_m, Material.RETROREFLECTOR),
        block(x_m, (0.05 - half_m, 0.35 - half_m), z_m, Material.RETROREFLECTOR),
    ]


def _cab(rear_m: float, front_m: float, half_m: float, top_m: float) -> list[Solid]:
    """Returns a lorry's cab over its engine, with its windscreen and side windows."""
    sill_m = 0.55 * top_m
    return [
        block((rear_m, front_m), (-half_m, half_m), (0.45, sill_m)),
        prism(
            [(rear_m, sill_m), (front_m, sill_m), (front_m - 0.25, top_m), (rear_m, top_m)],
            (-half_m, half_m),
        ),
        prism(
            [
                (front_m - 0.02, sill_m + 0.05),
                (front_m + 0.02, sill_m + 0.05),
                (front_m - 0.16, top_m - 0.3),
                (front_m - 0.2, top_m - 0.3),
            ],
            (-0.9 * half_m, 0.9 * half_m),
            Material.GLASS,
        ),
        block(
            (rear_m + 0.7, front_m - 0.4),
            (-half_m - 0.01, half_m + 0.01),
            (sill_m + 0.05, top_m - 0.6),
            Material.GLASS,
        ),
        *_lights((front_m - 0.05, front_m + 0.03), half_m, (0.6, 0.85)),
    ]


def _lorry() -> list[Solid]:
    """A rigid lorry with two axles and a box body, 8.5 x 2.5 x 3.4 m."""
    return [
        block((0.0, 6.2), (-1.25, 1.25), (0.95, 3.4)),
        block((0.1, 6.6), (-0.45, 0.45), (0.55, 0.95), Material.METAL),
        block((2.8, 4.6), (-1.2, -0.7), (0.45, 0.9), Material.METAL),
        *_cab(6.5, 8.5, 1.2, 2.9),
        *_axle(1.9, 1.2, 0.48, 0.55),
        *_axle(7.4, 1.2, 0.48, 0.3),
        *_lights((-0.03, 0.05), 1.2, (0.7, 0.9)),
    ]


def _articulated() -> list[Solid]:
    """A tractor and its semi-trailer, 16.5 x 2.55 x 4.0 m, with the gap between them."""
    axles = [_axle(x_m, 1.25, 0.5, 0.4) for x_m in (2.4, 3.7, 5.0, 12.3)]
    return [
        block((0.0, 13.6), (-1.275, 1.275), (1.15, 4.0)),
        block((0.3, 13.3), (-0.45, 0.45), (0.8, 1.15), Material.METAL),
        block((6.2, 10.4), (-1.2, -1.12), (0.5, 1.0), Material.METAL),
        block((6.2, 10.4), (1.12, 1.2), (0.5, 1.0), Material.METAL),
        block((11.2, 14.6), (-0.45, 0.45), (0.55, 0.9), Material.METAL),
        *_cab(14.3, 16.5, 1.22, 3.7),
        *(solid for axle in axles for solid in axle),
        *_axle(15.4, 1.25, 0.5, 0.3),
        *_lights((-0.03, 0.05), 1.25, (0.8, 1.0)),
    ]


def _bus() -> list[Solid]:
    """A city bus with a low floor, 12 x 2.55 x 3.1 m, windows all around."""
    body = [(0.0, 0.32), (12.0, 0.32), (12.0, 1.1), (11.8, 3.1), (0.0, 3.1)]
    return [
        prism(body, (-1.26, 1.26)),
        block((0.6, 11.2), (-1.275, 1.275), (1.2, 2.5), Material.GLASS),
        prism(
            [(11.97, 1.2), (12.01, 1.2), (11.9, 2.7), (11.8, 2.7)], (-1.15, 1.15), Material.GLASS
        ),
        block((-0.02, 0.05), (-0.9, 0.9), (1.7, 2.5), Material.GLASS),
        *_axle(3.0, 1.27, 0.48, 0.5),
        *_axle(9.2, 1.27, 0.48, 0.3),
        *_lights((11.95, 12.03), 1.2, (0.55, 0.8)),
        *_lights((-0.03, 0.05), 1.2, (0.7, 1.0)),
    ]


def _rider(seat_m: float, lean_m: float, foot_m: Point) -> list[Solid]:
    """Returns a rider at x = `seat_m`, 0.85 m up: legs, leaning trunk, arms and head."""
    hip, shoulder = (seat_m, 0.85), (seat_m + lean_m, 1.38)
    x, z = foot_m
    trunk = [
        (hip[0] - 0.13, hip[1]),
        (hip[0] + 0.13, hip[1]),
        (shoulder[0] + 0.12, shoulder[1]),
        (shoulder[0] - 0.12, shoulder[1]),
    ]
    leg = [(x - 0.06, z), (x + 0.08, z), (hip[0] + 0.2, 0.9), (hip[0] - 0.05, 0.78)]
    arm = [
        (shoulder[0] + 0.35, shoulder[1] - 0.4),
        (shoulder[0] + 0.42, shoulder[1] - 0.34),
        (shoulder[0] + 0.05, shoulder[1]),
        (shoulder[0] - 0.03, shoulder[1] - 0.08),
    ]
    head_m = (shoulder[0] - 0.03, shoulder[0] + 0.2)
    return [
        prism(trunk, (-0.2, 0.2), Material.CLOTH),
        *(prism(leg, y_m, Material.CLOTH) for y_m in ((0.08, 0.22), (-0.22, -0.08))),
        *(prism(arm, y_m, Material.CLOTH) for y_m in ((0.2, 0.3), (-0.3, -0.2))),
        block(head_m, (-0.1, 0.1), (shoulder[1] + 0.05, shoulder[1] + 0.33), Material.CLOTH),
    ]


def _motorcycle() -> list[Solid]:
    """A motorcycle and its rider, 2.2 x 0.8 x 1.7 m."""
    tank = [(0.5, 0.35), (1.5, 0.3), (1.6, 0.9), (1.1, 1.0), (0.3, 0.85)]
    return [
        prism(tank, (-0.16, 0.16)),
        wheel(0.33, (-0.08, 0.08), 0.33),
        wheel(1.87, (-0.06, 0.06), 0.33),
        prism(
            [(1.78, 0.33), (1.86, 0.33), (1.58, 1.05), (1.48, 1.05)], (-0.09, 0.09), Material.METAL
        ),
        block((1.45, 1.55), (-0.4, 0.4), (1.0, 1.06), Material.METAL),
        block((1.6, 1.7), (-0.1, 0.1), (0.75, 0.95), Material.RETROREFLECTOR),
        block((0.1, 0.16), (-0.1, 0.1), (0.65, 0.8), Material.RETROREFLECTOR),
        *_rider(0.85, 0.22, (0.95, 0.35)),
    ]


def _bicycle() -> list[Solid]:
    """A bicycle and its rider, 1.8 x 0.6 x 1.7 m."""
    return [
        wheel(0.34, (-0.02, 0.02), 0.34),
        wheel(1.46, (-0.02, 0.02), 0.34),
        prism([(0.3, 0.3), (0.4, 0.3), (0.62, 0.85), (0.52, 0.85)], (-0.02, 0.02), Material.METAL),
        prism([(0.8, 0.28), (0.9, 0.28), (1.3, 0.85), (1.2, 0.85)], (-0.02, 0.02), Material.METAL),
        prism([(1.4, 0.34), (1.5, 0.34), (1.3, 1.02), (1.22, 1.02)], (-0.03, 0.03), Material.METAL),
        block((1.2, 1.27), (-0.3, 0.3), (0.98, 1.04), Material.METAL),
        block((0.02, 0.07), (-0.04, 0.04), (0.6, 0.68), Material.RETROREFLECTOR),
        *_rider(0.6, 0.25, (0.85, 0.2)),
    ]


_COMPOSED = {
    BOX: lambda: [block((-0.5, 0.5), (-0.5, 0.5), (0.0, 1.0))],
    "lorry": _lorry,
    "articulated": _articulated,
    "bus": _bus,
    "motorcycle": _motorcycle,
    "bicycle": _bicycle,
}
