import igl
import numpy as np
import pytest
import torch
import trimesh
from numpy.testing import assert_allclose
from one_body import of_mesh

from conftest import as_mesh
from igps.descriptors.literature.local_diameter_centricity import (
    LocalDiameterCentricity,
    centricity,
    local_diameters,
)
from igps.mesh.errors import MeshError
from igps.mesh.mesh import Mesh
from own_descriptors import changed


def centres(mesh):
    """The centroid of every face, as its face and barycentric coordinates."""
    return np.arange(len(mesh.faces)), np.full((len(mesh.faces), 3), 1 / 3)


def tube(radius, length, sections, rings):
    """A closed cylinder about the z axis, with rounded ends."""
    heights = np.linspace(-length / 2, length / 2, rings)
    ends = radius * np.sin(np.linspace(0, np.pi / 2, 6))[1:]
    z = np.concatenate(
        [
            -length / 2 - ends[::-1],
            heights,
            length / 2 + ends,
        ]
    )
    beyond = np.maximum(np.abs(z) - length / 2, 0)
    profile = np.stack(
        [np.sqrt(np.maximum(radius**2 - beyond**2, 0)), z],
        axis=1,
    )
    profile[[0, -1], 0] = 0.0
    return as_mesh(trimesh.creation.revolve(profile, sections=sections))


@pytest.mark.parametrize("angle", [60.0, 120.0])
def test_local_diameter_of_a_sphere_is_its_mean_chord(sphere, angle):
    # A chord at the angle t to the normal is 2 r cos t long; over a solid angle, cos t is uniform, so that neither the
    # median nor the trimming moves the mean.
    radius = 3.0
    ball = Mesh(sphere.vertices * radius, sphere.faces)
    diameters = local_diameters(ball, *centres(sphere), 200, angle)
    expected = radius * (1 + np.cos(np.radians(angle / 2)))
    # The polyhedron lies within the sphere
    assert diameters.mean() == pytest.approx(expected, rel=0.004)
    assert diameters.std() < 0.004 * expected


def test_local_diameter_of_a_long_cylinder():
    # Chords of the infinite cylinder of radius 1, in random directions of the cone: 2 cos t / (cos²t + sin²t cos²f).
    generator = np.random.default_rng(0)
    cosine = generator.uniform(0.5, 1, 200_000)
    azimuth = generator.uniform(0, 2 * np.pi, 200_000)
    chords = 2 * cosine / (cosine**2 + (1 - cosine**2) * np.cos(azimuth) ** 2)
    expected = chords[np.abs(chords - np.median(chords)) <= chords.std()].mean()
    mesh = tube(1.0, 20.0, 64, 60)
    face, weights = centres(mesh)
    middle = np.abs(mesh.vertices[mesh.faces].mean(axis=1)[:, 2]) < 5
    diameters = local_diameters(mesh, face[middle], weights[middle], 400, 120.0)
    assert diameters.mean() == pytest.approx(expected, rel=0.02)


def test_rays_that_leave_through_a_hole_do_not_count(sphere):
    # The lower half of the sphere: seen from near the pole, the narrow cone leads out through the opening.
    height = sphere.vertices[sphere.faces, 2].mean(axis=1)
    # The last one faces upwards, along the rays
    faces = sphere.faces[np.argsort(height)][: (height < 0.3).sum()]
    used, index = np.unique(faces, return_inverse=True)
    bowl = Mesh(
        sphere.vertices[used],
        index.reshape(-1, 3),
        allow_open=True,
    )
    height = bowl.vertices[bowl.faces].mean(axis=1)[:, 2]
    diameters = local_diameters(bowl, *centres(bowl), 30, 20.0)
    assert np.isnan(diameters[height < -0.95]).all()
    beside = diameters[np.abs(height) < 0.05]
    assert_allclose(beside, 1 + np.cos(np.radians(10)), rtol=0.02)


def test_surface_that_no_ray_meets_again_is_refused(sphere):
    faces = sphere.faces[sphere.vertices[sphere.faces, 2].mean(axis=1) < -0.75]
    used, index = np.unique(faces, return_inverse=True)
    dish = Mesh(
        sphere.vertices[used],
        index.reshape(-1, 3),
        allow_open=True,
    )
    with pytest.raises(MeshError, match="no ray"):
        changed(LocalDiameterCentricity(), opening_angle=10.0).describe_body(of_mesh(dish))


def test_centricity_of_a_sphere_is_a_quarter_of_its_circumference(sphere):
    values = centricity(Mesh(sphere.vertices * 2, sphere.faces), 100)
    assert values.mean() == pytest.approx(np.pi, rel=0.02)
    assert values.std() < 0.005 * np.pi


def test_centricity_of_a_thin_tube_rises_from_a_quarter_to_half_its_length():
    mesh = tube(0.1, 20.0, 12, 300)
    values = centricity(mesh, 200)
    z = mesh.vertices[:, 2]
    # The mean distance from a point z of a stick of length L is L/4 + z²/L.
    assert_allclose(values, 5 + z**2 / 20, rtol=0.03)


def test_sources_are_a_quadrature_of_the_whole_surface(blob):
    vertices = np.array(blob.vertices)
    faces = np.array(blob.faces)
    area = np.bincount(
        faces.ravel(),
        np.repeat(igl.doublearea(vertices, faces), 3),
    )
    values = centricity(blob, 60)
    everything = np.arange(len(vertices))
    for vertex in (0, 17, 333):
        exact = igl.exact_geodesic(
            vertices,
            faces,
            VS=np.array([vertex]),
            VT=everything,
        )
        assert values[vertex] == pytest.approx(exact @ area / area.sum(), rel=0.04)


def test_histogram_lies_where_the_sphere_is(sphere):
    descriptor = LocalDiameterCentricity()
    histogram = descriptor.describe_body(of_mesh(sphere))
    assert histogram.dtype == np.float32
    assert histogram.shape == (descriptor.n_diameter_bins, descriptor.n_centricity_bins)
    assert histogram.sum() == pytest.approx(1, abs=1e-5)
    assert histogram.min() >= 0
    root = np.sqrt(4 * np.pi)
    mean = histogram.sum(axis=1) @ (np.arange(32) + 0.5) / 32 * descriptor.max_diameter
    assert mean == pytest.approx(1.5 / root, rel=0.01)
    mean = histogram.sum(axis=0) @ (np.arange(32) + 0.5) / 32 * descriptor.max_centricity
    assert mean == pytest.approx(np.pi / 2 / root, rel=0.02)


def test_values_beyond_the_range_go_to_the_last_bins(sphere):
    descriptor = changed(LocalDiameterCentricity(), max_diameter=0.1, max_centricity=0.1)
    histogram = descriptor.describe_body(of_mesh(sphere))
    assert histogram[-1, -1] == pytest.approx(1, abs=1e-5)


def test_triangles_count_by_their_area():
    # The same tapered body, with small triangles at its thin end or at its thick one.
    descriptor = changed(LocalDiameterCentricity(), n_diameter_bins=8, n_centricity_bins=2)
    rows = []
    for power in (0.5, 2.0):
        z = np.linspace(0, 1, 60) ** power * 6
        radius = np.concatenate([[0], 0.3 + 0.15 * z, [0]])
        profile = np.stack(
            [radius, np.concatenate([z[:1], z, z[-1:]])],
            axis=1,
        )
        mesh = as_mesh(trimesh.creation.revolve(profile, sections=24))
        rows.append(descriptor.describe_body(of_mesh(mesh)).sum(axis=1))
    assert np.abs(rows[0] - rows[1]).sum() < 0.1


def test_bending_matters_less_than_thickness():
    straight = tube(0.5, 12.0, 24, 80)
    x, y, z = straight.vertices.T
    turned = np.stack(
        [8 - (8 - x) * np.cos(z / 8), y, (8 - x) * np.sin(z / 8)],
        axis=1,
    )
    bent = Mesh(turned, straight.faces)
    thicker = tube(0.8, 12.0, 24, 80)
    descriptor = LocalDiameterCentricity()
    described = [descriptor.describe_body(of_mesh(mesh)) for mesh in (straight, bent, thicker)]
    rows = torch.from_numpy(np.stack(described))
    distance = descriptor.distances(rows[:1], rows)[0]
    assert distance[0] == 0
    assert distance[1] < 0.5 * distance[2]
