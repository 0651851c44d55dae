from itertools import product

import numpy as np
import pytest
import torch
import trimesh
from one_body import of_mesh
from scipy.optimize import brentq
from scipy.special import spherical_jn

from conftest import as_mesh
from igps.descriptors.literature.volume_shape_dna import VolumeShapeDNA, volume_spectrum
from igps.mesh.errors import MeshError
from igps.mesh.mesh import Mesh
from own_descriptors import changed


def cube_frequencies(n):
    triples = sorted(
        product(range(1, 9), repeat=3),
        key=lambda t: sum(i * i for i in t),
    )
    return triples[:n]


def ball_eigenvalues(n):
    """Squared zeros of the spherical Bessel functions, times the unit ball's volume^(2/3)."""
    values = []
    x = np.linspace(0.05, 12, 2000)
    for degree in range(12):

        def radial(r, degree=degree):
            return float(spherical_jn(degree, r))

        y = np.array([radial(r) for r in x])
        for i in np.nonzero(y[:-1] * y[1:] < 0)[0]:
            values += [brentq(radial, x[i], x[i + 1]) ** 2] * (2 * degree + 1)
    return np.sort(values)[:n] * (4 * np.pi / 3) ** (2 / 3)


def test_cube_has_the_spectrum_of_its_grid_with_all_multiplets():
    n = 12
    angles = np.pi * np.array(cube_frequencies(200)) / (2 * n)
    expected = np.sort(4 * n**2 * np.square(np.sin(angles)).sum(axis=1))[:60]
    spectrum = volume_spectrum(
        as_mesh(trimesh.creation.box((1, 1, 1))),
        60,
        n**3 - 1,
    )
    np.testing.assert_allclose(spectrum, expected, rtol=1e-6)


def test_ball_tends_to_zeros_of_bessel_functions():
    exact = ball_eigenvalues(30)
    ball = as_mesh(trimesh.creation.icosphere(subdivisions=4))
    coarse, fine = (np.abs(volume_spectrum(ball, 30, n) / exact - 1) for n in (500, 8000))
    assert fine.max() < 0.04
    measured = np.log(coarse.mean() / fine.mean()) / np.log(16 ** (1 / 3))
    assert measured > 1.8


def test_walls_lie_between_the_cells_where_the_surface_is():
    # Walls half a cell beyond the last centre inside, as in a body of whole voxels, would be wrong by more than 1 %.
    cube = trimesh.creation.box((1, 1, 1))
    generator = np.random.default_rng(0)
    for _ in range(4):
        turn, _ = np.linalg.qr(generator.standard_normal((3, 3)))
        first = volume_spectrum(
            Mesh(np.asarray(cube.vertices) @ turn, cube.faces),
            1,
            4000,
        )
        assert first[0] == pytest.approx(3 * np.pi**2, rel=0.006)


def test_description_is_the_spectrum(blob):
    description = changed(VolumeShapeDNA(), n_eigenvalues=10, n_voxels=500).describe_body(
        of_mesh(blob)
    )
    assert description.dtype == np.float32
    assert description.shape == (10,)
    np.testing.assert_allclose(description, volume_spectrum(blob, 10, 500), rtol=1e-6)


def test_distances_are_euclidean():
    rows = torch.tensor([[0.0, 0.0], [3.0, 4.0]])
    torch.testing.assert_close(
        VolumeShapeDNA().distances(rows, rows), torch.tensor([[0.0, 5.0], [5.0, 0.0]])
    )


def test_too_few_cells_are_refused(blob):
    with pytest.raises(MeshError, match="too few for 40 eigenvalues"):
        changed(VolumeShapeDNA(), n_eigenvalues=40, n_voxels=20).describe_body(of_mesh(blob))
