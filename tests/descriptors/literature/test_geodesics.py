import igl
import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose, assert_array_equal
from shortest_paths import farthest_points, geodesic_distances

from conftest import as_mesh
from igps.mesh.mesh import Mesh


def exact(mesh, source):
    none = np.array([], dtype=np.int64)
    vertices = np.asfortranarray(mesh.vertices)
    faces = np.asfortranarray(mesh.faces)
    return igl.exact_geodesic(
        vertices, faces, np.array([source]), none, np.arange(len(vertices)), none
    )


def test_never_shorter_than_the_exact_polyhedral_distance(blob):
    for source in (3, 400):
        reference = exact(blob, source)
        distances = geodesic_distances(blob, [source])[0]
        assert (distances >= reference - 1e-12).all()
        assert_allclose(distances, reference, rtol=0.05)


def test_thin_triangles_do_no_harm():
    cube = trimesh.creation.box((1, 1, 40)).subdivide().subdivide().subdivide()
    needles = as_mesh(cube)
    distances = geodesic_distances(needles, [0])[0]
    reference = exact(needles, 0)
    assert_allclose(distances, reference, atol=0.03 * reference.max())


def test_farthest_points_are_greedy(blob):
    samples = farthest_points(blob, 30)
    assert_allclose(samples.distances, geodesic_distances(blob, samples.vertices), rtol=1e-12)
    for i in range(1, 30):
        nearest = samples.distances[:i].min(axis=0)
        assert nearest[samples.vertices[i]] == nearest.max()
    # The first is an end of a long path: a step from it to the farthest and one from there do not lead much farther.
    length = samples.distances[0].max()
    everywhere = geodesic_distances(blob, np.arange(len(blob.vertices)))
    assert everywhere[samples.vertices[0]].max() == pytest.approx(length, rel=1e-12)
    assert length > 0.95 * everywhere.max()
    assert_array_equal(samples.mutual, samples.mutual.T)
    assert_allclose(samples.mutual, samples.distances[:, samples.vertices], rtol=1e-12)


def renumbered(mesh, seed):
    """The mesh with vertices, faces and their corners in another order, and the new number of each vertex."""
    generator = np.random.default_rng(seed)
    order = generator.permutation(len(mesh.vertices))
    new = np.argsort(order)
    faces = generator.permutation(new[mesh.faces])
    first = generator.integers(3, size=(len(faces), 1))
    faces = np.take_along_axis(
        faces,
        (first + np.arange(3)) % 3,
        axis=1,
    )
    return Mesh(mesh.vertices[order], faces, mesh.name), new


def test_farthest_points_do_not_depend_on_numbers(blob):
    samples = farthest_points(blob, 60)
    for seed in range(3):
        mesh, new = renumbered(blob, seed)
        assert_array_equal(farthest_points(mesh, 60).vertices, new[samples.vertices])


def test_rounding_does_not_decide_between_equally_far_points():
    # A body with three planes of symmetry, whose triangles have them too: most points have equals.
    octahedron = trimesh.creation.icosphere(subdivisions=2)
    mesh = as_mesh(octahedron.apply_scale([3.0, 2.0, 1.0]))
    expected = np.sort(farthest_points(mesh, 40).mutual, axis=None)
    for number, factor in enumerate((0.1, 1 / 3, 7.7)):
        moved, _ = renumbered(
            Mesh(mesh.vertices * factor + factor, mesh.faces),
            number,
        )
        found = np.sort(farthest_points(moved, 40).mutual, axis=None)
        assert_allclose(found, factor * expected, rtol=1e-9)
