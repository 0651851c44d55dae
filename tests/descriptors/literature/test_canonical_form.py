from itertools import product

import numpy as np
import pytest
import torch
import trimesh
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose
from one_body import of_mesh
from scipy.spatial.distance import cdist
from scipy.stats import special_ortho_group
from shortest_paths import farthest_points, geodesic_distances
from sklearn.manifold import smacof

from conftest import as_mesh
from igps.descriptors.literature.canonical_form import (
    CanonicalForm,
    classical_scaling,
    exponents,
    least_squares_scaling,
    moments,
)
from igps.mesh.mesh import Mesh
from own_descriptors import changed


def distance(a, b, descriptor):
    return descriptor.distances(torch.from_numpy(a)[None], torch.from_numpy(b)[None]).item()


def sheet(curvature):
    """A thin sheet of 2 × 1, rolled up along its length to a circular arc of the given curvature."""
    along, across = np.meshgrid(
        np.linspace(0, 2, 33),
        np.linspace(0, 1, 17),
        indexing="ij",
    )
    u = along.ravel()
    v = across.ravel()
    inner = np.stack([u, v, 0 * u], axis=1)
    if curvature:
        inner[:, 0] = np.sin(curvature * u) / curvature
        inner[:, 2] = (1 - np.cos(curvature * u)) / curvature
    normal = np.stack(
        [-np.sin(curvature * u), 0 * u, np.cos(curvature * u)],
        axis=1,
    )
    index = np.arange(33 * 17).reshape(33, 17)
    a = index[:-1, :-1].ravel()
    b = index[1:, :-1].ravel()
    c = index[1:, 1:].ravel()
    d = index[:-1, 1:].ravel()
    top = np.concatenate(
        [
            np.stack([a, b, c], axis=1),
            np.stack([a, c, d], axis=1),
        ]
    )
    rim = np.concatenate(
        [
            index[:-1, 0],
            index[-1, :-1],
            index[:0:-1, -1],
            index[0, :0:-1],
        ]
    )
    following = np.roll(rim, -1)
    n = index.size
    upper = np.stack([following, rim, rim + n], axis=1)
    lower = np.stack(
        [following, rim + n, following + n],
        axis=1,
    )
    sides = np.concatenate([upper, lower])
    vertices = np.concatenate([inner + 0.005 * normal, inner - 0.005 * normal])
    return Mesh(
        vertices,
        np.concatenate([top, top[:, ::-1] + n, sides]),
        "sheet",
    )


def test_a_rolled_up_sheet_has_the_form_of_the_flat_one():
    descriptor = changed(CanonicalForm(), max_vertices=1200)
    flat, rolled = (descriptor.describe_body(of_mesh(sheet(curvature))) for curvature in (0.0, 2.0))
    other = descriptor.describe_body(of_mesh(as_mesh(trimesh.creation.icosphere(subdivisions=3))))
    assert flat.dtype == np.float32
    assert flat.shape == (len(exponents(4)),)
    assert distance(flat, rolled, descriptor) < 0.05 * distance(flat, other, descriptor)
    # The rigid moments tell the two apart.
    rigid = []
    for mesh in (sheet(0.0), sheet(2.0)):
        rigid.append(moments(mesh.vertices / np.sqrt(mesh.area), 4).astype(np.float32))
    assert distance(*rigid, descriptor) > 10 * distance(flat, rolled, descriptor)


def test_the_geodesics_of_the_rolled_up_sheet_are_straight_when_flat():
    # The sheet is developable: the oracle of its canonical form is the flat rectangle itself.
    source = 5 * 17 + 3
    distances = geodesic_distances(sheet(2.0), [source])[0][: 33 * 17]
    flat = sheet(0.0).vertices[: 33 * 17]
    assert_allclose(distances, norm(flat - flat[source], axis=1), rtol=0.05, atol=0.02)


@pytest.mark.parametrize("dimension", [2, 3])
def test_points_of_space_come_back(dimension):
    points = default_rng(0).normal(size=(40, dimension)) * [3, 2, 1][:dimension]
    distances = cdist(points, points)
    form = classical_scaling(distances)
    assert form.shape == (40, 3)
    assert_allclose(cdist(form, form), distances, atol=1e-6)
    assert_allclose(form.mean(axis=0), 0, atol=1e-6)
    refined = least_squares_scaling(distances, form)
    assert_allclose(cdist(refined, refined), distances, atol=1e-6)


def test_least_squares_equals_scikit_learn(sphere):
    sources = np.arange(0, 2562, 40)
    distances = np.arccos(
        np.clip(
            sphere.vertices[sources] @ sphere.vertices[sources].T,
            -1,
            1,
        )
    )
    start = classical_scaling(distances)
    form = least_squares_scaling(distances, start)
    reference, stress = smacof(
        distances,
        n_components=3,
        init=start,
        n_init=1,
        max_iter=500,
        eps=1e-9,
        normalized_stress=False,
    )
    ours = np.square(cdist(form, form) - distances).sum() / 2
    before = np.square(cdist(start, start) - distances).sum() / 2
    assert stress <= ours < 1.001 * stress
    assert before > 1.5 * ours
    assert_allclose(cdist(form, form), cdist(reference, reference), atol=0.02)


def test_no_step_raises_the_stress():
    generator = default_rng(1)
    distances = cdist(*[generator.normal(size=(25, 6))] * 2)
    start = generator.normal(size=(25, 3))
    start[3] = start[4]  # coincident points must not divide by zero
    form = least_squares_scaling(distances, start)
    assert np.isfinite(form).all()
    before = np.square(cdist(start, start) - distances).sum()
    after = np.square(cdist(form, form) - distances).sum()
    assert after < before / 4


def test_moments_of_a_box_by_closed_form():
    # Midpoints of a fine grid on [−3, 3] × [−2, 2] × [−1, 1]: E x² = a²/3, E x⁴ = a⁴/5, odd moments zero.
    axes = [(np.arange(40) + 0.5) / 20 - 1] * 3
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) * [3, 2, 1]
    turned = points @ special_ortho_group.rvs(3, random_state=0) + 7
    half = {
        0: np.ones(3),
        2: np.array([9, 4, 1]) / 3,
        4: np.array([81, 16, 1]) / 5,
    }
    radius = np.sqrt(half[2].sum())
    for value, (p, q, r) in zip(
        moments(turned, 4),
        exponents(4),
        strict=True,
    ):
        odd = p % 2 or q % 2 or r % 2
        expected = 0 if odd else half[p][0] * half[q][1] * half[r][2] / radius ** (p + q + r - 1)
        assert value == pytest.approx(expected, rel=3e-3, abs=1e-9)


def test_distances_ignore_reflections_but_not_their_mixture():
    descriptor = CanonicalForm()
    powers = exponents(4)
    form = default_rng(0).gamma(2.0, size=(60, 3)) * [3, 2, 1]
    described = moments(form, 4).astype(np.float32)
    for flips in product((1, -1), repeat=3):
        reflected = (described * np.prod(np.array(flips) ** powers, axis=1)).astype(np.float32)
        assert distance(described, reflected, descriptor) == 0
    # Changing one sign alone is no reflection.
    changed = described.copy()
    changed[np.flatnonzero((powers == [3, 0, 0]).all(axis=1))] *= -1
    assert distance(described, changed, descriptor) > 0.1
    # The least over the reflections, by a loop.
    other = moments(default_rng(1).gamma(2.0, size=(60, 3)), 4).astype(np.float32)
    apart = []
    for flips in product((1, -1), repeat=3):
        signs = np.prod(np.array(flips) ** powers, axis=1)
        apart.append(norm(described * signs - other))
    loop = min(apart)
    assert distance(described, other, descriptor) == pytest.approx(loop, rel=1e-6)
    assert distance(other, described, descriptor) == pytest.approx(loop, rel=1e-6)


def test_the_form_is_that_of_least_squares(blob):
    distances = farthest_points(blob, 200).mutual / np.sqrt(blob.area)
    classical = classical_scaling(distances)
    forms = [moments(form, 4) for form in (least_squares_scaling(distances, classical), classical)]
    descriptor = CanonicalForm()
    found = descriptor.describe_body(of_mesh(blob))
    # the signs of the axes are arbitrary, and rounding decides them: the distance takes the best reflection
    fitted, plain = (
        distance(
            found.astype(float),
            form,
            descriptor,
        )
        for form in forms
    )
    assert fitted < 1e-6 * norm(forms[0])
    assert plain > 1e-2 * norm(forms[1])


def test_more_samples_than_vertices_are_refused(blob):
    with pytest.raises(ValueError, match="642"):
        changed(CanonicalForm(), n_samples=700).describe_body(of_mesh(blob))
