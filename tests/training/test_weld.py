"""Welds: the tube adds one handle, and the gap it bridges is the best of all pairs of vertices."""

import numpy as np
import pytest
import trimesh
from docs.benchmarks.weld import TUBE_FACES, facing_vertices, weld, weld_gap
from numpy.linalg import norm
from scipy import sparse
from scipy.sparse.csgraph import shortest_path

from conftest import as_trimesh, horseshoe, surface_genus
from igps.mesh.errors import MeshError
from igps.mesh.mesh import Mesh
from igps.mesh.surface import vertex_normals


def grooved_ball():
    """A wide ball with a narrow groove: places face each other, but none is far away along the surface."""
    body = trimesh.creation.icosphere(subdivisions=3)
    z = body.vertices[:, 2:]
    body.vertices[:, :2] *= 2 - 0.5 * np.exp(-((z / 0.12) ** 2))
    body.vertices *= np.random.default_rng(0).uniform(
        0.99,
        1.01,
        (len(body.vertices), 1),
    )
    return Mesh(body.vertices, body.faces, name="grooved_ball")


def paths(mesh):
    """(V, V) shortest paths along edges."""
    surface = as_trimesh(mesh)
    n = len(mesh.vertices)
    edges = tuple(surface.edges_unique.T)
    graph = sparse.coo_matrix(
        (surface.edges_unique_length, edges),
        shape=(n, n),
    )
    return shortest_path(graph.tocsr(), directed=False)


def test_weld_adds_a_handle_and_nothing_else():
    mesh = horseshoe()
    # the middles of the two ends
    a = len(mesh.vertices) - 2
    b = len(mesh.vertices) - 1
    welded = weld(mesh, a, b)
    assert surface_genus(mesh) == 0
    assert surface_genus(welded) == 1
    np.testing.assert_array_equal(welded.vertices, mesh.vertices)
    assert len(welded.faces) == len(mesh.faces) - 2 + TUBE_FACES
    old = {tuple(face) for face in mesh.faces.tolist()}
    kept = welded.faces[:-TUBE_FACES].tolist()
    tube = welded.faces[-TUBE_FACES:]
    removed = old - {tuple(face) for face in kept}
    assert {tuple(face) for face in kept} < old
    assert len(removed) == 2
    assert all(a in face or b in face for face in removed)
    assert set(tube.ravel().tolist()) == {vertex for face in removed for vertex in face}
    # The tube is a solid bridge over the gap: about half of the two triangles' area times the gap.
    assert 0 < welded.volume - mesh.volume < 0.05 * mesh.volume
    assert f"vertices {a} and {b}" in welded.notes[-1]
    # The way from one end to the other is now as long as the gap, no more once around the ring.
    assert paths(mesh)[a, b] > 5
    assert paths(welded)[a, b] < 5 * norm(mesh.vertices[a] - mesh.vertices[b])


def test_weld_refuses_what_cannot_be_welded(sphere):
    for pair in ((0, len(sphere.vertices)), (-1, 5)):
        with pytest.raises(ValueError, match="expected a vertex index from 0 to 2561"):
            weld(sphere, *pair)
    neighbour = int(sphere.faces[(sphere.faces == 0).any(axis=1)][0].max())
    for other in (0, neighbour):
        with pytest.raises(ValueError, match="more than three edges apart"):
            weld(sphere, 0, other)


@pytest.mark.parametrize(
    ("make", "largest_gap", "least_path"),
    [
        (lambda: horseshoe(0.008), 1 / 64, 1 / 4),
        (lambda: horseshoe(0.03), 1 / 32, 1 / 4),
        (grooved_ball, 1 / 16, None),
    ],
    ids=["narrow", "wide", "crease"],
)
def test_facing_vertices_are_the_best_of_all_pairs(make, largest_gap, least_path):
    mesh = make()
    a, b = facing_vertices(mesh)
    normals = as_trimesh(mesh)
    areas = normals.face_normals * normals.area_faces[:, None]
    sums = np.zeros_like(mesh.vertices)
    for corner in mesh.faces.T:
        np.add.at(sums, corner, areas)
    unit = sums / norm(sums, axis=1, keepdims=True)
    np.testing.assert_allclose(vertex_normals(mesh.vertices, mesh.faces), unit, atol=1e-12)
    way = mesh.vertices[None, :] - mesh.vertices[:, None]
    gap = norm(way, axis=2) + np.eye(len(way))
    along = paths(mesh)
    facing = np.einsum("ik,ijk->ij", unit, way / gap[..., None]) > 0.5
    allowed = facing & facing.T & (gap <= largest_gap * mesh.diagonal)
    assert allowed.any()
    if least_path is None:
        assert not (allowed & (along >= mesh.diagonal / 4)).any()
        value = along
    else:
        allowed &= along >= least_path * mesh.diagonal
        value = along / gap
    assert allowed[a, b]
    assert value[a, b] == pytest.approx(value[allowed].max())


def test_convex_body_has_no_gap(sphere):
    with pytest.raises(MeshError, match="no two places face each other"):
        weld_gap(sphere)
