import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from igps.data.transforms import FewerSamples
from igps.mesh.mesh import Mesh
from igps.signature.signature import compute_signature
from own_descriptors import CONFIG

FEW = FewerSamples(n_interior=9, n_surface=7)


def of_egg():
    body = trimesh.creation.icosphere(subdivisions=2)
    body.vertices *= np.array([1.0, 1.2, 1.7])
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


def test_a_seed_says_all_and_no_input_is_changed(signature):
    before = [array.copy() for array in arrays(signature)]
    for array in arrays(signature):
        array.flags.writeable = False
    seeded = replace(FEW, seed=3)
    first = seeded(signature)
    assert same(first, seeded(signature))
    assert same(first, pickle.loads(pickle.dumps(seeded))(signature))
    assert not same(first, replace(FEW, seed=4)(signature))
    assert not same(first, replace(seeded(replace(signature, name="another")), name="egg"))
    for a, b in zip(before, arrays(signature), strict=True):
        assert (a == b).all()
    assert seeded.cache_tag != replace(FEW, seed=4).cache_tag
    for array in (first.interior.eigenfunctions, first.surface.eigenfunctions):
        assert array.dtype == np.float32


def test_without_a_seed_the_global_generator_draws(signature):
    torch.manual_seed(0)
    first = FEW(signature)
    second = FEW(signature)
    torch.manual_seed(0)
    assert same(first, FEW(signature))
    assert not same(first, second)
    with pytest.raises(ValueError, match="pre_transform: expected a seed"):
        _ = FEW.cache_tag


def rows(samples):
    return [tuple(row) for row in np.hstack([samples.points, samples.eigenfunctions])]


def test_fewer_samples_are_some_of_them_in_their_order(signature):
    few = FewerSamples(n_interior=9, n_surface=10**6, seed=0)(signature)
    assert len(few.interior) == 9
    places = [rows(signature.interior).index(row) for row in rows(few.interior)]
    assert places == sorted(places)
    assert few.interior.attributes["depth"].tolist() == places
    assert rows(few.surface) == rows(signature.surface)
