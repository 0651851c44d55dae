"""Short vectors against the distances that they stand for, and against scikit-learn's features and components."""

import numpy as np
from scipy.spatial.distance import cdist
from scipy.stats import spearmanr
from sklearn.kernel_approximation import AdditiveChi2Sampler

from igps.retrieval.vectors import VectorMap


def histograms(n, n_cells):
    """Histograms of sum 1, in families of twenty."""
    generator = np.random.default_rng(0)
    families = generator.gamma(0.5, size=(n // 20 + 1, n_cells)).repeat(20, axis=0)[:n]
    found = families * generator.gamma(20, size=families.shape)
    return (found / found.sum(axis=1, keepdims=True)).astype(np.float32)


def test_features_order_as_chi_square_does():
    """By a fifth to a third less, the more the closer, and in nearly the same order."""
    rows = histograms(120, 500)
    vectors = VectorMap.fit(rows, "chi_square")(rows)
    assert vectors.shape[1] <= 256
    a = rows[:, None].astype(float)
    b = rows[None].astype(float)
    expected = ((a - b) ** 2 / np.maximum(a + b, 1e-300)).sum(axis=2) / 2
    apart = ~np.eye(120, dtype=bool)
    found = cdist(vectors, vectors)[apart] ** 2 / 2
    ratio = found / expected[apart]
    assert ratio.min() > 0.63
    assert ratio.max() < 0.9
    assert spearmanr(found, expected[apart])[0] > 0.995


def test_rows_are_taken_some_at_a_time():
    """Of 600 rows 512 at first; vectors as long as the features keep their distances."""
    rows = histograms(600, 40)
    features = AdditiveChi2Sampler(sample_steps=2).fit_transform(rows)
    found = VectorMap.fit(rows, "chi_square")(rows)
    expected = cdist(features, features)
    np.testing.assert_allclose(cdist(found, found), expected, atol=1e-4)


def test_short_unit_vectors_stay_as_they_are():
    rows = histograms(30, 40)
    kept = VectorMap.fit(rows, "cosine")
    assert kept.components is None
    np.testing.assert_array_equal(kept(rows), rows)
