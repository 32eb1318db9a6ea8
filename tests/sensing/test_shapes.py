"""Meshes out of the set-up."""

from __future__ import annotations

import numpy as np
import pytest

from protocol.errors import MessageError
from protocol.messages import MeshPart, Setup, VehicleType
from sensing.mesh import VehicleShapes
from tests.roads import street
from tests.sensing.solids import unit_box, unit_wedge

CAR = VehicleType(name="car", mesh="wedge", length_m=4.6, width_m=1.8, height_m=1.5)
MESHES = {"box": unit_box(), "wedge": unit_wedge()}


def setup(parts: list[MeshPart], kind: VehicleType = CAR) -> Setup:
    return Setup(
        scenario={},
        road_map=street(),
        vehicle_types=[kind],
        meshes=parts,
        mesh_vertices=np.concatenate([m.vertices for m in MESHES.values()]),
        mesh_triangles=np.concatenate([m.triangles for m in MESHES.values()]),
    )


def parts() -> list[MeshPart]:
    return [
        MeshPart(name=name, vertices=len(m.vertices), triangles=len(m.triangles))
        for name, m in MESHES.items()
    ]


def test_meshes_come_out_of_the_setup_as_they_went_in() -> None:
    shapes = VehicleShapes.from_setup(setup(parts()))
    for found, meant in zip(shapes.meshes, MESHES.values(), strict=True):
        assert np.array_equal(found.vertices, meant.vertices)
        assert np.array_equal(found.triangles, meant.triangles)
    bodies = shapes.bodies(["car", "car"])
    assert bodies.mesh.tolist() == [1, 1]
    assert bodies.size_m.tolist() == [[4.6, 1.8, 1.5]] * 2


def test_a_setup_whose_parts_do_not_fit_is_refused() -> None:
    long = [*parts(), MeshPart(name="more", vertices=9, triangles=1)]
    with pytest.raises(MessageError, match="ends beyond"):
        VehicleShapes.from_setup(setup(long))
    swapped = [p.model_copy(update={"vertices": 4}) for p in parts()]
    with pytest.raises(MessageError, match="a triangle names vertex"):
        VehicleShapes.from_setup(setup(swapped))


@pytest.mark.parametrize("wrong", [{"mesh": "tram"}, {"length_m": 0.0}])
def test_a_type_without_a_mesh_or_a_size_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(MessageError, match="type car has"):
        VehicleShapes.from_setup(setup(parts(), CAR.model_copy(update=wrong)))
