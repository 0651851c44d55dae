import igl
import numpy as np
import pytest
import robust_laplacian
import trimesh
from lapy import Solver, TriaMesh

from conftest import FACES, as_mesh
from igps.mesh.mesh import Mesh
from igps.signature.laplacian import laplacian


@pytest.mark.parametrize("backend", ["cotangent", "robust"])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_rows_sum_to_zero_and_mass_to_area(blob, backend, scale):
    mesh = Mesh(blob.vertices * scale, blob.faces)
    stiffness, mass = laplacian(mesh, backend)
    assert abs(stiffness.sum(axis=1)).max() < 1e-10
    assert mass.sum() == pytest.approx(mesh.area, rel=1e-9)
    assert mass.min() > 0
    assert abs(stiffness - stiffness.T).max() < 1e-12


def test_stiffness_is_positive_semidefinite_with_constants_as_kernel(blob):
    values = np.linalg.eigvalsh(laplacian(blob)[0].toarray())
    assert abs(values[0]) < 1e-12
    assert values[1] > 1e-3


def test_stiffness_equals_lapy_and_libigl(blob):
    stiffness, _ = laplacian(blob)
    lapy = Solver(TriaMesh(np.array(blob.vertices), np.array(blob.faces))).stiffness
    assert abs(stiffness - lapy).max() < 1e-5  # LaPy assembles in single precision in places
    libigl = -igl.cotmatrix(
        np.array(blob.vertices),
        np.array(blob.faces),
    )
    assert abs(stiffness - libigl).max() < 1e-12


def test_mixed_voronoi_mass_equals_libigl(blob):
    """Also of a tetrahedron with obtuse faces."""
    corners = np.array(
        [
            [0, 0, 0],
            [2, 0, 0],
            [3, 1, 0],
            [1.7, 0.4, 0.6],
        ]
    )
    for mesh in (blob, Mesh(corners, FACES)):
        vertices = np.array(mesh.vertices)
        libigl = igl.massmatrix(
            vertices,
            np.array(mesh.faces),
            igl.MASSMATRIX_TYPE_VORONOI,
        )
        np.testing.assert_allclose(laplacian(mesh)[1], libigl.diagonal(), rtol=1e-10)


def test_robust_backend_equals_its_library(blob):
    stiffness, mass = laplacian(blob, "robust")
    vertices = np.array(blob.vertices)
    expected, expected_mass = robust_laplacian.mesh_laplacian(vertices, np.array(blob.faces))
    assert abs(stiffness - expected).max() < 1e-4  # mollification is relative to the longest side
    np.testing.assert_allclose(mass, expected_mass.diagonal(), rtol=1e-4)


def test_zero_area_faces_stay_finite_and_tie_their_corners_together():
    # A vertex of an edge is moved onto its neighbour: two faces collapse, and both corners become one point.
    surface = trimesh.creation.icosphere(subdivisions=2)
    vertices = np.array(surface.vertices)
    a, b = surface.edges_unique[10]
    vertices[a] = vertices[b]
    mesh = Mesh(vertices, surface.faces)
    stiffness, mass = laplacian(mesh)
    assert np.isfinite(stiffness.data).all()
    assert mass.min() > 0
    values = np.linalg.eigvalsh(stiffness.toarray())
    assert values[0] > -1e-9
    assert stiffness[a, b] < -100  # a stiff spring: equal values at both ends


def test_unknown_backend_is_refused():
    with pytest.raises(ValueError, match="backend"):
        laplacian(as_mesh(trimesh.creation.box()), "magic")
