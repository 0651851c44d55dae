"""The head of two levels against matrix functions of SciPy and NumPy, and against its formula."""

import numpy as np
import pytest
import torch
from scipy.linalg import sqrtm
from torch.testing import assert_close

from igps.nn.heads.two_level import TwoLevelHead
from igps.nn.heads.wccn import WCCNHead
from igps.retrieval import cosine

N_CLASSES = 16
N_BODIES = 4
N_POSES = 5
N_CELLS = 40


@pytest.fixture
def collection():
    """Histograms, classes and bodies; bodies of all classes differ along the same directions, poses along others."""
    generator = torch.Generator().manual_seed(0)
    kinds = torch.randn(N_CLASSES, 1, 1, N_CELLS, generator=generator)
    of_bodies = torch.randn(N_CLASSES, N_BODIES, 1, 4, generator=generator) @ torch.randn(
        4, N_CELLS, generator=generator
    )
    of_poses = torch.randn(N_CLASSES, N_BODIES, N_POSES, 2, generator=generator) @ torch.randn(
        2, N_CELLS, generator=generator
    )
    noise = 0.02 * torch.randn(N_CLASSES, N_BODIES, N_POSES, N_CELLS, generator=generator)
    cells = (0.3 * kinds + 0.4 * of_bodies + 0.3 * of_poses + noise).exp().flatten(0, 2)
    bodies = torch.arange(N_CLASSES * N_BODIES).repeat_interleave(N_POSES)
    return cells / cells.sum(dim=1, keepdim=True), bodies // N_BODIES, bodies


def projected(histograms, bodies, shrinkage):
    """(N, 10) centred roots, whitened within bodies, along the directions in which the means vary most."""
    roots = histograms.double().sqrt().numpy()
    members = bodies.numpy()
    means = np.stack([roots[members == b].mean(axis=0) for b in range(members.max() + 1)])
    residuals = roots - means[members]
    within = residuals.T @ residuals
    rank = min(len(roots) - len(means), N_CELLS)
    relative = within * rank / within.trace()
    whitening = np.real(sqrtm(shrinkage * np.linalg.inv(shrinkage * np.eye(N_CELLS) + relative)))
    centred = roots - roots.mean(axis=0)
    # The training roots span all 40 dimensions, so the head only subtracts their mean
    _, _, axes = np.linalg.svd(
        (means - roots.mean(axis=0)) @ whitening,
        full_matrices=False,
    )
    return centred @ whitening @ axes[:10].T


def test_a_level_is_the_projection_of_the_whitened_roots_on_their_means(collection):
    """Against SciPy's `sqrtm` and NumPy's SVD; cosines are compared, since vectors are unique only up to a rotation."""
    histograms, _, bodies = collection
    expected = projected(histograms, bodies, 0.2)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    head = WCCNHead(n_directions=10, shrinkage=0.2).fit(histograms.double(), bodies)
    found = head(histograms.double()).numpy()
    np.testing.assert_allclose(found @ found.T, expected @ expected.T, atol=1e-6)


def test_parts_have_equal_shares_and_others_do_not_count(collection):
    histograms, classes, _ = collection
    cells = (12, 18, 10)
    alone = [WCCNHead().fit(part, classes)(part) for part in histograms.split(cells, dim=1)]
    head = WCCNHead((0, 2)).fit(histograms, classes, cells)
    expected = (cosine(alone[0], alone[0]) + cosine(alone[2], alone[2])) / 2
    found = head(histograms)
    # A part has at most as many directions as cells
    assert found.shape == (len(histograms), 12 + 10)
    assert_close(cosine(found, found), expected, atol=2e-4, rtol=0)
    changed = histograms.clone()
    changed[:, 12:30] = torch.rand(
        len(changed),
        18,
        generator=torch.Generator().manual_seed(1),
    )
    assert_close(head(changed), found, atol=1e-6, rtol=0)


def test_with_lengths_distances_are_those_of_mahalanobis(collection):
    """Against SciPy's `sqrtm`, up to one common factor; the last number makes the length of the vector 1."""
    histograms, _, bodies = collection
    expected = torch.from_numpy(projected(histograms, bodies, 0.2))
    head = WCCNHead(n_directions=10, shrinkage=0.2, lengths=True).fit(
        histograms.double(),
        bodies,
    )
    found = head(histograms.double())
    assert found.shape == (len(histograms), 11)
    assert_close(
        found.norm(dim=1),
        torch.ones(len(found), dtype=torch.float64),
    )
    own = torch.pdist(found[:, :10])
    theirs = torch.pdist(expected)
    assert_close(
        own / own.median(),
        theirs / theirs.median(),
        atol=1e-6,
        rtol=1e-6,
    )
    assert float(own.median()) == pytest.approx(0.5, rel=1e-6)


def test_body_heads_can_have_shapes_of_their_own(collection):
    histograms, classes, bodies = collection
    head = TwoLevelHead().fit(
        histograms[:200], classes[:200], bodies=bodies[200:], body_descriptions=histograms[200:]
    )
    of_class = WCCNHead()
    of_body = WCCNHead(n_directions=64, shrinkage=0.3, lengths=True)
    of_class.fit(histograms[:200], classes[:200])
    of_body.fit(histograms[200:], bodies[200:])
    expected = 0.5**0.5 * torch.cat([of_class(histograms), of_body(histograms)], dim=1)
    assert_close(head(histograms), expected)
    # Of the shapes of classes
    _, _, axes = np.linalg.svd(
        expected[:200].double().numpy(),
        full_matrices=False,
    )
    short = head.shorten(head(histograms))
    projected = torch.from_numpy(expected.double().numpy() @ axes.T)
    assert_close(
        cosine(short, short).double(),
        cosine(projected, projected),
        atol=1e-4,
        rtol=0,
    )


def test_distances_of_equal_vectors_have_a_gradient(collection):
    histograms, classes, bodies = collection
    body_heads = [
        WCCNHead(
            (part,),
            n_directions=6,
            lengths=True,
        )
        for part in range(2)
    ]
    head = TwoLevelHead(body_heads=body_heads, scales=(0.1, 0.1), exponents=(0.2, 0.8))
    head.fit(histograms, classes, (15, 25), bodies=bodies)
    vectors = head(histograms[:4]).requires_grad_()
    distances = head.distances(vectors, vectors)
    assert float(distances.detach().diagonal().max()) < 1e-6
    distances.sum().backward()
    assert vectors.grad is not None
    assert torch.isfinite(vectors.grad).all()
    point = torch.zeros(1, vectors.shape[1]).index_fill_(
        1,
        torch.tensor([0]),
        1.0,
    )
    leaf = point.clone().requires_grad_()
    head.distances(leaf, point).sum().backward()
    assert torch.isfinite(leaf.grad).all()


def test_short_vectors_span_the_leading_singular_directions(collection, monkeypatch):
    """Against NumPy's SVD for 7 numbers; if all numbers fit, the cosines do not change."""
    histograms, classes, bodies = collection
    head = TwoLevelHead().fit(histograms, classes, bodies=bodies)
    vectors = head(histograms)
    short = head.shorten(vectors)
    assert short.shape[1] <= vectors.shape[1] <= 256
    assert_close(cosine(short, short), cosine(vectors, vectors), atol=1e-5, rtol=0)
    monkeypatch.setattr("igps.nn.heads.two_level.MAX_SHORT_WIDTH", 7)
    found = head.fit(histograms, classes, bodies=bodies).shorten(vectors)
    assert found.shape == (len(vectors), 7)
    _, _, axes = np.linalg.svd(
        vectors.double().numpy(),
        full_matrices=False,
    )
    expected = vectors.double().numpy() @ axes[:7].T
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(found @ found.T, expected @ expected.T, atol=1e-4)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"parts": (0, 2)}, r"parts: expected indices from 0 to 1"),
        ({"n_directions": 0}, "n_directions: expected at least 1, got 0"),
        ({"shrinkage": 0.0}, "shrinkage: expected a positive number"),
    ],
)
def test_wrong_arguments_of_a_level_are_named(arguments, message, collection):
    with pytest.raises(ValueError, match=message):
        WCCNHead(**arguments).fit(collection[0], collection[1], (20, 20))


def test_what_cannot_be_fitted_is_named(collection):
    histograms, classes, _ = collection
    with pytest.raises(ValueError, match="part_cells: expected cells that add up to 40"):
        WCCNHead().fit(histograms, classes, (3, 4))
    with pytest.raises(ValueError, match="labels: expected one for each of 320 descriptions"):
        WCCNHead().fit(histograms, classes[:3])
    with pytest.raises(ValueError, match="as many classes as shapes"):
        WCCNHead().fit(histograms, torch.arange(len(histograms)))
    with pytest.raises(RuntimeError, match="expected to be fitted first"):
        WCCNHead()(histograms)
    for scales in ([0.0], [0.1, 0.2]):
        with pytest.raises(
            ValueError, match="scales: expected a positive scale for each of 1 body heads, got"
        ):
            TwoLevelHead(scales=scales)
    with pytest.raises(ValueError, match="share: expected a number between 0 and 1, got 1"):
        TwoLevelHead(share=1)
    with pytest.raises(ValueError, match="body_heads: expected heads with lengths"):
        TwoLevelHead(body_heads=[WCCNHead()])
    for exponents in ((), (0.9,), (-1.0,)):
        with pytest.raises(
            ValueError, match="exponents: expected a positive number for each of 1 body heads"
        ):
            TwoLevelHead(exponents=exponents)
    with pytest.raises(
        ValueError, match="bodies: expected one for each of 10 descriptions, got 320"
    ):
        TwoLevelHead().fit(histograms, classes, body_descriptions=histograms[:10])
    with pytest.raises(RuntimeError, match="TwoLevelHead: expected to be fitted first"):
        TwoLevelHead().shorten(histograms)
    fitted = TwoLevelHead().fit(histograms, classes)
    with pytest.raises(ValueError, match="expected 40 cells as in training, got 39"):
        fitted(histograms[:, :39])
    with pytest.raises(ValueError, match=r"embeddings: expected \d+ numbers each, got 40"):
        fitted.shorten(histograms)
