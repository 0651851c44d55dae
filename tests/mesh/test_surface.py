"""Areas, normals, edges and components against trimesh and loops."""

import numpy as np
import trimesh
from numpy.testing import assert_allclose, assert_array_equal

from conftest import as_trimesh
from igps.mesh import surface


def test_areas_and_normals(blob):
    oracle = as_trimesh(blob)
    assert_allclose(
        surface.face_areas(blob.vertices, blob.faces),
        oracle.area_faces,
        rtol=1e-12,
    )
    of_vertices = np.zeros(len(blob.vertices))
    sums = np.zeros_like(blob.vertices)
    for face, area, normal in zip(
        blob.faces,
        oracle.area_faces,
        oracle.face_normals,
        strict=True,
    ):
        of_vertices[face] += area / 3
        sums[face] += area * normal
    assert_allclose(
        surface.vertex_areas(blob.vertices, blob.faces),
        of_vertices,
        rtol=1e-12,
    )
    normals = sums / np.linalg.norm(sums, axis=1, keepdims=True)
    assert_allclose(
        surface.vertex_normals(blob.vertices, blob.faces),
        normals,
        atol=1e-12,
    )


def test_the_mean_of_neighbours_is_that_of_a_loop(blob):
    expected = np.empty_like(blob.vertices)
    for i, neighbours in enumerate(as_trimesh(blob).vertex_neighbors):
        beside = blob.vertices[neighbours]
        weights = 1 / np.square(beside - blob.vertices[i]).sum(axis=1)
        expected[i] = weights @ beside / weights.sum()
    assert_allclose(
        surface.mean_of_neighbours(blob.vertices, blob.faces),
        expected,
        rtol=1e-9,
    )


def test_a_neighbour_in_the_same_place_is_the_mean(blob):
    vertices = blob.vertices.copy()
    a, b, _ = blob.faces[0]
    vertices[a] = vertices[b]
    found = surface.mean_of_neighbours(vertices, blob.faces)
    expected = vertices[[b, b]]
    assert_allclose(found[[a, b]], expected, atol=1e-6)


def test_edges(blob):
    edges, edge_of = surface.undirected_edges(blob.faces)
    sides = [(int(face[i]), int(face[(i + 1) % 3])) for face in blob.faces for i in range(3)]
    start, end = surface.directed_edges(blob.faces)
    assert np.column_stack([start, end]).tolist() == [list(side) for side in sides]
    expected = sorted({(min(side), max(side)) for side in sides})
    assert edges.tolist() == [list(edge) for edge in expected]
    assert_array_equal(edges[edge_of], np.sort(sides, axis=1))


def test_parts_of_faces_and_their_areas():
    pieces = [
        trimesh.creation.icosphere(subdivisions=k, radius=radius)
        for k, radius in ((2, 1.0), (1, 3.0), (0, 2.0))
    ]
    whole = trimesh.util.concatenate(pieces)
    # A vertex of no face in between is no part.
    vertices = np.insert(
        np.asarray(whole.vertices),
        162,
        [9, 9, 9],
        axis=0,
    )
    faces = np.where(
        whole.faces >= 162,
        whole.faces + 1,
        whole.faces,
    )
    shuffled = np.random.default_rng(0).permutation(len(faces))
    part, areas = surface.face_parts(vertices, faces[shuffled])
    assert_array_equal(
        part,
        np.repeat([0, 1, 2], [len(piece.faces) for piece in pieces])[shuffled],
    )
    assert_allclose(areas, [piece.area for piece in pieces], rtol=1e-12)
