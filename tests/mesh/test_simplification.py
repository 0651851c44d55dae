"""Simplified meshes keep their shape, their topology and the promised size."""

import numpy as np
import pytest
import trimesh

from conftest import as_mesh
from igps.mesh.errors import MeshError
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
    expected = simplify(blob, 200).vertices
    np.testing.assert_allclose(scaled.vertices / scale, expected, atol=1e-9)


def test_simplify_keeps_the_topology():
    ring = trimesh.creation.torus(1, 0.1, major_sections=64, minor_sections=16)
    small = simplify(as_mesh(ring), 60)
    n_vertices = len(small.vertices)
    n_faces = len(small.faces)
    assert n_vertices - n_faces // 2 == 0  # Euler characteristic of a torus, with 3/2 edges a face
    with pytest.raises(MeshError, match="Raise max_vertices"):
        simplify(as_mesh(ring), 4)
