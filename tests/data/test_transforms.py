import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from igps.data.transforms import Compose, FewerSamples, Scale
from igps.mesh.mesh import Mesh
from igps.signature.signature import SignatureConfig, compute_signature

CONFIG = SignatureConfig(n_eigenpairs=20, resolution=10, min_samples=0, n_surface_samples=60)
EVERY = [
    FewerSamples(n_interior=9, n_surface=7),
    Scale(),
]


def of_egg(scale=1.0):
    body = trimesh.creation.icosphere(subdivisions=2)
    body.vertices *= np.array([1.0, 1.2, 1.7]) * scale
    return compute_signature(Mesh(body.vertices, body.faces, name="egg"), CONFIG)


@pytest.fixture(scope="module")
def signature():
    found = of_egg()
    depth = np.arange(len(found.interior), dtype=np.float32)
    return replace(found, interior=replace(found.interior, attributes={"depth": depth}))


def arrays(signature):
    found = [signature.eigenvalues, np.array([signature.area, signature.volume])]
    for samples in (signature.interior, signature.surface):
        found += [samples.points, samples.eigenfunctions, *samples.attributes.values()]
    return found


def same(one, other):
    return all(
        a.shape == b.shape and (a == b).all()
        for a, b in zip(arrays(one), arrays(other), strict=True)
    )


@pytest.mark.parametrize("transform", EVERY, ids=lambda one: type(one).__name__)
def test_a_seed_says_all_and_no_input_is_changed(signature, transform):
    before = [array.copy() for array in arrays(signature)]
    for array in arrays(signature):
        array.flags.writeable = False
    seeded = replace(transform, seed=3)
    first = seeded(signature)
    assert same(first, seeded(signature))
    assert same(first, pickle.loads(pickle.dumps(seeded))(signature))
    assert not same(first, replace(transform, seed=4)(signature))
    assert not same(first, replace(seeded(replace(signature, name="another")), name="egg"))
    for a, b in zip(before, arrays(signature), strict=True):
        assert (a == b).all()
    assert seeded.cache_tag != replace(transform, seed=4).cache_tag
    for array in (first.interior.eigenfunctions, first.surface.eigenfunctions):
        assert array.dtype == np.float32


@pytest.mark.parametrize("transform", EVERY, ids=lambda one: type(one).__name__)
def test_without_a_seed_the_global_generator_draws(signature, transform):
    torch.manual_seed(0)
    first = transform(signature)
    second = transform(signature)
    torch.manual_seed(0)
    assert same(first, transform(signature))
    assert not same(first, second)
    with pytest.raises(ValueError, match="pre_transform: expected a seed"):
        _ = transform.cache_tag


def rows(samples):
    return [tuple(row) for row in np.hstack([samples.points, samples.eigenfunctions])]


def test_fewer_samples_are_some_of_them_in_their_order(signature):
    few = FewerSamples(n_interior=9, n_surface=10**6, seed=0)(signature)
    assert len(few.interior) == 9
    places = [rows(signature.interior).index(row) for row in rows(few.interior)]
    assert places == sorted(places)
    assert few.interior.attributes["depth"].tolist() == places
    assert rows(few.surface) == rows(signature.surface)


def test_scaled_is_the_signature_of_the_scaled_body(signature):
    """Computed from a mesh of twice the size; eigenfunctions to their signs, so that products of them are compared."""
    scaled = Scale(smallest=2.0, largest=2.0, seed=0)(signature)
    expected = of_egg(2.0)
    np.testing.assert_allclose(scaled.eigenvalues, expected.eigenvalues, rtol=1e-6)
    assert scaled.area == pytest.approx(expected.area)
    assert scaled.volume == pytest.approx(expected.volume)
    np.testing.assert_allclose(scaled.interior.points, expected.interior.points, atol=1e-9)
    for one, other in ((scaled.interior, expected.interior), (scaled.surface, expected.surface)):
        expected_sizes = np.abs(other.eigenfunctions)
        found = np.abs(one.eigenfunctions)
        np.testing.assert_allclose(found, expected_sizes, atol=1e-4)
    with pytest.raises(ValueError, match="0 < smallest ≤ largest"):
        Scale(smallest=2.0, largest=1.0)


def test_composed_are_one_after_the_other(signature):
    both = Compose(FewerSamples(n_interior=9, seed=0), Scale(seed=1))
    assert same(both(signature), Scale(seed=1)(FewerSamples(n_interior=9, seed=0)(signature)))
    assert both.cache_tag == f"{FewerSamples(n_interior=9, seed=0)!r}; {Scale(seed=1)!r}"
    assert same(pickle.loads(pickle.dumps(both))(signature), both(signature))
