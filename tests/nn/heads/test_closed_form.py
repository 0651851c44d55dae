from copy import deepcopy
from itertools import combinations
from statistics import fmean, pvariance

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from scipy.special import softmax
from sklearn.kernel_ridge import KernelRidge
from torch.nn.functional import normalize
from torch.testing import assert_close

from igps.nn.heads.base import Head
from igps.nn.heads.classifier import ClassifierHead
from igps.nn.heads.closed_form import KernelHead, WhitenedHead
from igps.nn.heads.two_level import TwoLevelHead
from igps.nn.heads.wccn import WCCNHead
from igps.retrieval import cosine, retrieval_scores
from igps.retrieval.distances import euclidean

N_CELLS = 60


@pytest.fixture
def collection():
    """Histograms of 8 classes of 6 shapes; all classes vary along the same two directions, and much."""
    generator = torch.Generator().manual_seed(0)
    kinds = torch.rand(8, 1, N_CELLS, generator=generator)
    nuisance = torch.randn(8, 6, 2, generator=generator) @ torch.randn(
        2, N_CELLS, generator=generator
    )
    noise = 0.05 * torch.randn(8, 6, N_CELLS, generator=generator)
    histograms = (kinds + 0.5 * nuisance + noise).exp().flatten(0, 1)
    return histograms / histograms.sum(dim=1, keepdim=True), torch.arange(8).repeat_interleave(6)


def ft(embedding, labels):
    return retrieval_scores(cosine(embedding, embedding), labels).mean()["ft"]


def test_whitening_is_the_inverse_root_of_the_covariance(collection):
    histograms, labels = collection
    roots = histograms.double().sqrt().numpy()
    residuals = np.concatenate(
        [roots[labels == c] - roots[labels == c].mean(axis=0) for c in range(8)]
    )
    within = residuals.T @ residuals
    # The mean of the 40 eigenvalues that the residuals of 48 shapes of 8 classes allow
    within /= within.trace() / 40
    values, vectors = np.linalg.eigh(within + 0.5 * np.eye(N_CELLS))
    expected = (roots - roots.mean(axis=0)) @ vectors / np.sqrt(values) @ vectors.T
    head = WhitenedHead(n_directions=40, shrinkage=0.5).fit(histograms, labels)
    assert_allclose(head(histograms), normalize(torch.from_numpy(expected)), atol=2e-5)


def test_few_directions_are_the_largest(collection):
    histograms, labels = collection
    few = WhitenedHead(n_directions=3).fit(histograms, labels)
    many = WhitenedHead(n_directions=40).fit(histograms, labels)
    assert_close(few.gains, many.gains[:, :3])
    assert_close(
        (few.directions @ many.directions[:3].T).abs(),
        torch.eye(3),
        atol=1e-4,
        rtol=0,
    )


def test_parts_are_whitened_one_by_one(collection):
    histograms, labels = collection
    parts = histograms.split([20, 40], dim=1)
    together = WhitenedHead().fit(histograms, labels, (20, 40))(histograms)
    separate = [WhitenedHead().fit(part, labels)(part) for part in parts]
    expected = torch.stack([cosine(one, one) for one in separate]).mean(dim=0)
    found = cosine(together, together)
    assert_close(found, expected, atol=1e-5, rtol=0)


def test_an_unfitted_head_gives_normalised_square_roots(collection):
    """Whatever the number of cells."""
    assert_close(WhitenedHead()(collection[0]), collection[0].sqrt())
    few = collection[0][:, :7]
    assert_close(WhitenedHead()(few), normalize(few.sqrt()))
    stacked = collection[0].view(48, 4, 15)
    assert_close(WhitenedHead()(stacked), collection[0].sqrt())


def test_centred_head_damps_nothing(collection):
    histograms, _ = collection
    roots = histograms.sqrt() - histograms.sqrt().mean(dim=0)
    assert_close(WhitenedHead().centre(histograms)(histograms), normalize(roots))
    parts = [normalize(part) / 2**0.5 for part in roots.split([20, 40], dim=1)]
    in_parts = WhitenedHead().centre(histograms, (20, 40))(histograms)
    assert_close(in_parts, torch.cat(parts, dim=1))


def test_whitening_serves_classes_it_was_not_fitted_to(collection):
    histograms, labels = collection
    trained = labels < 4
    head = WhitenedHead(shrinkage=0.1).fit(histograms[trained], labels[trained])
    unseen = histograms[~trained]
    assert ft(head(unseen), labels[~trained]) > ft(unseen.sqrt(), labels[~trained]) + 0.2


def test_kernel_head_is_kernel_ridge_regression(collection):
    histograms, labels = collection
    train = slice(0, 48, 2)
    test = slice(1, 48, 2)
    head = KernelHead(ridge=0.1).fit(histograms[train], labels[train])
    whitened = WhitenedHead().fit(histograms[train], labels[train])(histograms).double().numpy()
    distances = 1 - whitened @ whitened[train].T
    kernel = np.exp(-distances / np.median(distances[train][np.triu_indices(24, 1)]))
    targets = np.eye(8)[labels[train]]
    oracle = KernelRidge(alpha=0.1, kernel="precomputed").fit(kernel[train], targets)
    expected = oracle.predict(kernel[test])
    found = head.scores(histograms[test])
    assert_allclose(found, expected, atol=2e-3)
    np.testing.assert_array_equal(head.predict(histograms[test]), expected.argmax(axis=1))


def test_identical_shapes_have_no_direction():
    histograms = torch.tensor(
        [
            [0.5, 0.5, 0.0],
            [0.5, 0.5, 0.0],
            [0.0, 0.25, 0.75],
            [0.0, 0.25, 0.75],
        ]
    )
    head = WhitenedHead().fit(
        histograms,
        torch.tensor([0, 0, 1, 1]),
    )
    centred = histograms.sqrt() - histograms.sqrt().mean(dim=0)
    assert_close(head(histograms), normalize(centred))


def test_classes_keep_their_names(collection):
    histograms, labels = collection
    head = KernelHead().fit(histograms, 10 * labels + 3)
    assert (head.predict(histograms) == 10 * labels + 3).all()


def test_errors_name_the_argument(collection):
    histograms, labels = collection
    fitted = WhitenedHead().fit(histograms, labels)
    with pytest.raises(ValueError, match="expected 60 cells as in training, got 59"):
        fitted(histograms[:, 1:])
    for part_cells in ((20, 39), (0, 60)):
        with pytest.raises(ValueError, match="part_cells: expected cells that add up to 60"):
            WhitenedHead().fit(histograms, labels, part_cells)
    with pytest.raises(ValueError, match="labels: expected one for each of 48"):
        WhitenedHead().fit(histograms, labels[1:])
    with pytest.raises(ValueError, match="labels: expected one for each of 48"):
        KernelHead().fit(histograms, labels[1:])
    with pytest.raises(ValueError, match="labels: expected a class of at least two"):
        WhitenedHead().fit(histograms[:4], torch.arange(4))
    with pytest.raises(ValueError, match="labels: expected at least two classes, got 1"):
        KernelHead().fit(histograms[:4], torch.zeros(4))
    with pytest.raises(ValueError, match="descriptions: expected histograms, entries ≥ 0"):
        WhitenedHead().fit(histograms - 0.5, labels)
    with pytest.raises(ValueError, match="shrinkage"):
        WhitenedHead(shrinkage=0)
    with pytest.raises(ValueError, match="n_directions: expected at least 1, got 0"):
        WhitenedHead(n_directions=0)
    with pytest.raises(ValueError, match="ridge"):
        KernelHead(ridge=0)
    with pytest.raises(ValueError, match="temperature: expected a positive number, got 0"):
        KernelHead(temperature=0)
    for kind in (WhitenedHead, KernelHead):
        for share in (0, 1):
            with pytest.raises(
                ValueError, match=f"prior_share: expected a number between 0 and 1, got {share}"
            ):
                kind(prior_share=share)
    with pytest.raises(RuntimeError, match="expected to be fitted first"):
        KernelHead()(histograms)


@pytest.fixture
def prior(collection):
    """Fitted to the last four classes, in two parts."""
    histograms, labels = collection
    return WhitenedHead().fit(
        histograms[labels >= 4],
        labels[labels >= 4],
        (20, 40),
    )


class SquaredPrior(WhitenedHead):
    """A head whose distance is the squared cosine distance for unit vectors, but not for other vectors."""

    def distances(self, queries, gallery):
        return euclidean(queries, gallery) ** 4 / 4


@pytest.fixture
def squared(prior):
    """The prior with that distance."""
    found = SquaredPrior()
    found.load_state_dict(prior.state_dict())
    return found


@pytest.mark.parametrize("kind", [WhitenedHead, KernelHead])
def test_a_prior_stays_as_it_is(collection, prior, kind):
    histograms, labels = collection
    before = {name: value.clone() for name, value in prior.state_dict().items()}
    head = kind(prior=prior).fit(
        histograms[labels < 4],
        labels[labels < 4],
        (30, 30),
    )
    for name, value in prior.state_dict().items():
        assert_close(value, before[name], rtol=0, atol=0)
    assert_close(head(histograms).norm(dim=1), torch.ones(48))
    copy = kind(prior=WhitenedHead())
    copy.load_state_dict(head.state_dict())
    assert_close(copy(histograms), head(histograms), rtol=0, atol=0)


class SteppedPrior(WhitenedHead):
    """A head whose distances are 0.01 or 1; the kernel of such distances is not positive definite."""

    def distances(self, queries, gallery):
        return (euclidean(queries, gallery) > 1.1).to(queries.dtype).clamp_min(0.01)


def test_an_indefinite_kernel_is_projected_on_its_positive_eigenvectors(collection, prior):
    """Against scikit-learn on the projected kernel. Here the ridge cancels the smallest eigenvalue."""
    histograms, labels = collection
    stepped = SteppedPrior()
    stepped.load_state_dict(prior.state_dict())
    head = KernelHead(stepped, prior_share=0.9).fit(histograms, labels)
    kernel = head._kernel(head.anchors).double().numpy()
    values, vectors = np.linalg.eigh(kernel)
    assert values[0] < -0.1
    head = KernelHead(stepped, prior_share=0.9, ridge=-float(values[0])).fit(histograms, labels)
    positive = vectors[:, values > 0]
    projection = positive @ positive.T
    oracle = KernelRidge(alpha=-values[0], kernel="precomputed").fit(
        projection @ kernel, np.eye(8)[labels]
    )
    assert_allclose(head.scores(histograms), oracle.predict(kernel @ projection), atol=1e-4)


def test_whitened_distance_is_the_weighted_mean_with_the_priors(collection, prior, squared):
    """With the prior's own distance, where it has one; the cosine distance of the vectors is that with its cosines."""
    histograms, labels = collection
    own = WhitenedHead().fit(histograms, labels)(histograms)
    other = prior(histograms)
    for given, of_prior in ((prior, cosine(other, other)), (squared, cosine(other, other) ** 2)):
        head = WhitenedHead(prior=given, prior_share=0.3).fit(histograms, labels)
        beside = head(histograms)
        found = head.distances(beside, beside[:9])
        assert_close(
            found,
            (0.7 * cosine(own, own) + 0.3 * of_prior)[:, :9],
            atol=1e-6,
            rtol=0,
        )
        whole = 0.7 * cosine(own, own) + 0.3 * cosine(other, other)
        assert_close(cosine(beside, beside), whole, atol=1e-6, rtol=0)
    with pytest.raises(RuntimeError, match="WhitenedHead: expected to be fitted first"):
        WhitenedHead(prior=prior).distances(beside, beside)


def test_parts_beside_a_prior_are_weighted_by_fishers_discriminant(collection, squared):
    """Means and variances over all pairs, by `statistics`; the last part separates shapes, but not classes."""
    histograms, labels = collection
    backwards = histograms.roll(1, dims=0).view(8, 6, N_CELLS).transpose(0, 1).reshape(48, N_CELLS)
    descriptions = torch.cat([histograms, backwards], dim=1)
    cells = (5, 55, 60)
    train = torch.arange(48)[labels < 5]
    apart = [
        1 - vectors @ vectors.T
        for part in descriptions.split(cells, dim=1)
        for vectors in [WhitenedHead().fit(part[train], labels[train])(part).double().numpy()]
    ]
    pairs = list(combinations(train.tolist(), 2))
    shares = []
    for distances in apart:
        near = [distances[i, j] for i, j in pairs if labels[i] == labels[j]]
        far = [distances[i, j] for i, j in pairs if labels[i] != labels[j]]
        shares.append(max(0, fmean(far) - fmean(near)) / (pvariance(near) + pvariance(far)))
    assert shares[1] > 2 * shares[0] > 0
    assert shares[2] == 0
    own = np.average(apart, axis=0, weights=shares)
    head = WhitenedHead(prior=Stretched(squared, N_CELLS), prior_share=0.3)
    vectors = head.fit(descriptions[train], labels[train], cells)(descriptions)
    expected = 0.7 * own + 0.3 * squared.distances(squared(histograms), squared(histograms)).numpy()
    found = head.distances(vectors, vectors)
    assert_allclose(found, expected, atol=1e-5)
    assert_close(vectors.norm(dim=1), torch.ones(48))


class Stretched(Head):
    """A prior that looks at the first cells alone."""

    def __init__(self, head, n_cells):
        super().__init__()
        self.head = head
        self.n_cells = n_cells

    def fit(self, descriptions, labels, part_cells=None):
        raise AssertionError("a prior stays as it is")

    def forward(self, descriptions):
        return self.head(descriptions[:, : self.n_cells])

    def distances(self, queries, gallery):
        return self.head.distances(queries, gallery)


def test_without_separation_all_parts_have_equal_weights(collection, prior):
    """A single class, or two classes of identical shapes."""
    histograms, _ = collection
    again = torch.cat([histograms[:6], histograms[:6]])
    for shapes, labels in (
        (histograms[:6], torch.zeros(6)),
        (again, torch.arange(2).repeat_interleave(6)),
    ):
        beside = WhitenedHead(prior=prior).fit(shapes, labels, (20, 40))
        assert beside.part_shares.tolist() == [0.5, 0.5]
        alone = WhitenedHead().fit(shapes, labels, (20, 40))(histograms)
        assert_close(beside(histograms)[:, :N_CELLS], (2 / 3) ** 0.5 * alone)


@pytest.mark.parametrize("power", [1, 2])
def test_the_priors_kernel_is_one_more(collection, prior, squared, power):
    """By the prior's own distance, where it has one."""
    histograms, labels = collection
    train = slice(0, 48, 2)
    test = slice(1, 48, 2)
    kernels = []
    parts = histograms.split([20, 40], dim=1)
    heads = [
        WhitenedHead().fit(
            part[train],
            labels[train],
        )(part)
        for part in parts
    ]
    for vectors, exponent in (*((one, 1) for one in heads), (prior(histograms), power)):
        distances = (1 - (vectors @ vectors[train].T).double().numpy()) ** exponent
        kernels.append(np.exp(-distances / np.median(distances[train][np.triu_indices(24, 1)])))
    kernel = 0.375 * (kernels[0] + kernels[1]) + 0.25 * kernels[2]
    oracle = KernelRidge(alpha=0.03, kernel="precomputed").fit(
        kernel[train], np.eye(8)[labels[train]]
    )
    given = prior if power == 1 else squared
    head = KernelHead(given, prior_share=0.25).fit(
        histograms[train],
        labels[train],
        (20, 40),
    )
    assert_allclose(
        head.scores(histograms[test]),
        oracle.predict(kernel[test]),
        atol=2e-3,
    )


def test_one_shape_of_each_class_leaves_the_prior_alone(collection, prior):
    histograms, labels = collection
    vectors = prior(histograms).double().numpy()
    distances = 1 - vectors @ vectors[::6].T
    few = distances[::6][np.triu_indices(8, 1)]
    kernel = np.exp(-distances / np.sort(few)[(len(few) - 1) // 2])
    oracle = KernelRidge(alpha=0.03, kernel="precomputed").fit(
        kernel[::6],
        np.eye(8),
    )
    head = KernelHead(prior).fit(histograms[::6], labels[::6])
    assert_allclose(head.scores(histograms), oracle.predict(kernel), atol=2e-3)


@pytest.mark.parametrize(
    ("n_of_each", "temperature"),
    [(3, 0.2), (6, 0.1), (24, 0.1)],
)
def test_vectors_of_the_kernel_head_are_scores_and_what_is_likely(
    collection, n_of_each, temperature
):
    """Against NumPy and SciPy's softmax; with three shapes of each class the temperature is doubled."""
    histograms, labels = collection
    used = slice(None, None, 2 if n_of_each == 3 else 1)
    labels = labels % 2 if n_of_each == 24 else labels
    head = KernelHead(temperature=0.1).fit(histograms[used], labels[used])
    scores = head.scores(histograms).double().numpy()
    about = scores - 1 / len(labels.unique())
    about /= np.linalg.norm(about, axis=1, keepdims=True)
    likely = np.sqrt(softmax(scores / temperature, axis=1))
    expected = 1 - (about @ about.T + likely @ likely.T) / 2
    vectors = head(histograms)
    assert_allclose(cosine(vectors, vectors), expected, atol=1e-5)
    hard = KernelHead(temperature=1e-6).fit(
        histograms[::2],
        labels[::2],
    )
    assert torch.isfinite(hard(histograms)).all()  # as no exponential overflows


def fitted_heads(collection):
    """All heads that are fitted in closed form, by themselves or with a prior."""
    body_heads = [WCCNHead([part], lengths=True) for part in range(2)]
    prior = TwoLevelHead(
        WCCNHead([0]),
        body_heads,
        scales=(0.1, 0.2),
        exponents=(0.3, 0.7),
    )
    prior.fit(*collection, [20, 40])
    made = [WhitenedHead(prior=prior), KernelHead(), ClassifierHead(prior=prior)]
    return [
        prior,
        *(head.fit(*collection, [20, 40]) for head in made),
    ]


def test_fitted_heads_are_traced_whole_and_take_half_precision(collection):
    histograms = collection[0]
    for head in fitted_heads(collection):
        expected = head(histograms)
        torch.compiler.reset()
        traced = torch.compile(head, backend="aot_eager", fullgraph=True)
        assert_close(traced(histograms), expected, rtol=0, atol=1e-5)
        halved = deepcopy(head).half()(histograms)
        assert float(torch.cosine_similarity(halved.float(), expected).min()) > 0.99
