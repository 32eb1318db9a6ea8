"""Shapes of vehicles."""

from pathlib import Path

import numpy as np
import pytest

from protocol.errors import ConfigError
from protocol.messages import Material
from sim_host.sumo import sumo_home
from sim_host.vehicle_meshes import BOX, PackedMeshes, load_meshes

FOLDER = sumo_home() / "data" / "3D"


@pytest.mark.parametrize("name", sorted(load_meshes(FOLDER)))
def test_a_mesh_fills_the_unit_footprint_and_stands_on_the_ground(name: str) -> None:
    mesh = load_meshes(FOLDER)[name]
    np.testing.assert_allclose(mesh.vertices.min(axis=0), [-0.5, -0.5, 0], atol=1e-6)
    np.testing.assert_allclose(mesh.vertices.max(axis=0), [0.5, 0.5, 1], atol=1e-6)
    assert mesh.triangles.min() == 0
    assert mesh.triangles.max() < len(mesh.vertices)
    assert len(mesh.materials) == len(mesh.triangles)
    assert set(mesh.materials.tolist()) <= set(Material)


def test_a_car_looks_forward_with_its_cabin_behind_the_bonnet() -> None:
    vertices = load_meshes(FOLDER)["car"].vertices
    roof = vertices[vertices[:, 2] > 0.95]
    assert roof[:, 0].mean() < 0  # the bonnet, in front, is longer than the boot
    np.testing.assert_allclose(vertices[:, 1].mean(), 0, atol=0.02)


def test_packed_meshes_unpack_to_the_same() -> None:
    meshes = load_meshes(FOLDER)
    packed = PackedMeshes.of(meshes)
    vertices, triangles = packed.vertices, packed.triangles
    at_vertex = at_triangle = 0
    for part in packed.parts:
        own = vertices[at_vertex : at_vertex + part.vertices]
        np.testing.assert_array_equal(own, meshes[part.name].vertices)
        sides = triangles[at_triangle : at_triangle + part.triangles]
        np.testing.assert_array_equal(sides, meshes[part.name].triangles)
        at_vertex, at_triangle = at_vertex + part.vertices, at_triangle + part.triangles
    assert (at_vertex, at_triangle) == (len(vertices), len(triangles))
    assert len(packed.materials) == len(triangles)


def test_a_box_is_closed_and_faces_outward() -> None:
    box = load_meshes(FOLDER)[BOX]
    a, b, c = (box.vertices[box.triangles[:, i]].astype(float) for i in range(3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    assert volume == pytest.approx(1.0)


def test_a_missing_mesh_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="car-normal-citrus"):
        load_meshes(tmp_path)
