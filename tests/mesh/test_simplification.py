"""Simplified meshes keep their shape, their topology and the promised size."""

import numpy as np
import pytest
import trimesh

from conftest import as_mesh
from igps.mesh.errors import MeshError
from igps.mesh.isosurface import simplify_surface
from igps.mesh.mesh import Mesh
from igps.mesh.simplification import simplify


def test_simplify_keeps_the_shape_and_the_promise(sphere):
    small = simplify(sphere, 500)
    assert len(small.vertices) <= 500
    assert small.volume == pytest.approx(sphere.volume, rel=0.02)
    assert any("simplified from 2562" in note for note in small.notes)
    assert simplify(sphere, 5000) is sphere


@pytest.mark.parametrize("scale", [2.0**-20, 2.0**20])
def test_simplify_does_not_depend_on_scale(blob, scale):
    scaled = simplify(Mesh(blob.vertices * scale, blob.faces), 200)
    np.testing.assert_allclose(scaled.vertices / scale, simplify(blob, 200).vertices, atol=1e-9)


def test_simplify_keeps_the_topology():
    ring = trimesh.creation.torus(1, 0.1, major_sections=64, minor_sections=16)
    small = simplify(as_mesh(ring), 60)
    n_vertices = len(small.vertices)
    n_faces = len(small.faces)
    assert n_vertices - n_faces // 2 == 0  # Euler characteristic of a torus, with 3/2 edges a face
    with pytest.raises(MeshError, match="Raise max_vertices"):
        simplify(as_mesh(ring), 4)


def test_a_simplified_ball_has_all_its_vertices_near_the_sphere(sphere: Mesh) -> None:
    vertices, faces = simplify_surface(sphere.vertices, sphere.faces, 400)
    small = Mesh(vertices, faces)
    assert (len(vertices), small.genus) == (400, 0)
    assert small.volume == pytest.approx(sphere.volume, rel=1e-3)
    # Equilateral triangles on a sphere of radius 1 with 400 vertices have sides of 0.19 and sagittas of 0.006
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 1.0, atol=0.012)


@pytest.mark.parametrize("offset", [0.0, 1e4])
def test_flat_sides_and_sharp_edges_stay_where_they_are(offset: float) -> None:
    box = trimesh.creation.box((1, 2, 3))
    for _ in range(4):
        box = box.subdivide()
    vertices, faces = simplify_surface(box.vertices + offset, box.faces, 60)
    distance = np.abs(np.abs(vertices - offset) - [0.5, 1, 1.5]).min(axis=1)
    assert len(vertices) == 60
    assert distance.max() < 0.01
    assert Mesh(vertices, faces).volume == pytest.approx(6.0, rel=1e-3)


def test_a_handle_is_kept_whatever_number_is_asked_for() -> None:
    ring = as_mesh(trimesh.creation.torus(1, 0.1, major_sections=64, minor_sections=16))
    vertices, faces = simplify_surface(ring.vertices, ring.faces, 4)
    assert len(vertices) < 40
    assert Mesh(vertices, faces).genus == 1
