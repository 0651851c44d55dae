"""Tests of groups hold their level, find what is there, and refuse what makes no sense."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.random import default_rng

from igps.analysis.groups import GroupTest, group_test, squared_distances, with_q_values

PAIR = ["a"] * 12 + ["b"] * 12


def quick(vectors, groups=PAIR, seed=0, **given):
    options = {"n_permutations": 199, "n_bootstraps": 0, "n_repeats": 0, **given}
    return group_test(vectors, groups, seed=seed, **options)


def whitened_kernel(vectors):
    """Gaussian kernel of Mahalanobis distances by the covariance of all, with a ridge.

    The ridge leaves as many degrees of freedom as a tenth of the bodies, or nine tenths of the numbers.
    """
    n, n_numbers = vectors.shape
    centred = vectors - vectors.mean(axis=0)
    scatter = centred.T @ centred
    low = 1e-9 * np.trace(scatter)
    high = 1e9 * np.trace(scatter)
    for _ in range(200):
        middle = (low * high) ** 0.5
        inverse = np.linalg.inv(scatter + middle * np.eye(n_numbers))
        if np.trace(scatter @ inverse) > min(n / 10, 0.9 * n_numbers):
            low = middle
        else:
            high = middle
    apart = vectors[:, None] - vectors
    squares = np.einsum("ijk,kl,ijl->ij", apart, inverse, apart)
    median = np.median(squares[np.triu_indices(len(vectors), 1)])
    return np.exp(-squares / (2 * median))


@pytest.mark.parametrize(
    ("is_confounded", "n_numbers"),
    [(False, 6), (True, 40)],
)
def test_without_a_difference_one_test_in_twenty_rejects(is_confounded, n_numbers):
    """Of 1,000 draws; also where a covariate that differs between the groups, and the strata, cause a difference."""
    random = default_rng(1)
    found = []
    for draw in range(1000):
        vectors = random.normal(size=(24, n_numbers))
        given = {}
        if is_confounded:
            age = random.normal(size=24) + np.repeat([0, 1], 12)
            scanner = random.integers(0, 2, 24)
            vectors[:, :2] += np.outer(age, [2, 1])
            vectors += 2 * scanner[:, None]
            given = {
                "covariates": age[:, None],
                "strata": [str(one) for one in scanner],
            }
        test = quick(vectors, seed=draw, **given)
        found.append((test.permanova_p, test.kernel_p))
    rejected = (np.array(found, dtype=float) <= 0.05).mean(axis=0)
    assert ((rejected >= 0.03) & (rejected <= 0.07)).all(), rejected


def test_the_unit_of_a_covariate_does_not_matter():
    """Down to one in which all values lie below rounding of numbers about 1; a constant explains nothing."""
    random = default_rng(3)
    age = random.normal(size=24) + 7
    vectors = random.normal(size=(24, 3)) + np.outer(age, [2, 1, 0])
    usual = quick(vectors, covariates=age[:, None])
    for other in (1e-15 * age, 1e15 * age):
        found = quick(
            vectors,
            covariates=np.stack([other, np.full(24, 1e15 / 3)], axis=1),
        )
        assert found.permanova_f == pytest.approx(usual.permanova_f)
        assert found.permanova_p == usual.permanova_p


def test_numbers_that_are_none_are_refused():
    vectors = default_rng(0).normal(size=(24, 3))
    with pytest.raises(ValueError, match="n_permutations: expected at least 1, got -3"):
        quick(vectors, n_permutations=-3)
    with pytest.raises(ValueError, match="covariates: expected finite numbers"):
        quick(
            vectors,
            covariates=np.full((24, 1), np.nan),
        )
    with pytest.raises(ValueError, match="vectors: expected finite numbers"):
        quick(
            np.where(
                np.arange(24)[:, None] == 2,
                np.inf,
                vectors,
            )
        )


def test_power_grows_with_the_difference():
    random = default_rng(2)
    powers = []
    for shift in (0.0, 0.7, 1.4, 2.8):
        apart = np.outer(
            np.repeat([0, 1], 12),
            [shift, 0, 0, 0],
        )
        tests = [quick(random.normal(size=(24, 4)) + apart) for _ in range(60)]
        by_means = np.mean([one.permanova_p <= 0.05 for one in tests])
        by_kernel = np.mean([one.kernel_p <= 0.05 for one in tests])
        powers.append([by_means, by_kernel])
    assert (np.diff(powers, axis=0) > 0).all(), powers
    assert min(powers[-1]) > 0.95


def test_the_kernel_test_finds_a_small_direction_that_distances_drown():
    random = default_rng(9)
    scales = np.array([10.0, 5, 2, 1, 1])
    shift = np.outer(
        np.repeat([0, 1], 20),
        [0, 0, 0, 2.0, 0],
    )
    tests = [
        quick(
            random.normal(size=(40, 5)) * scales + shift,
            ["a"] * 20 + ["b"] * 20,
            i,
        )
        for i in range(60)
    ]
    assert np.mean([one.permanova_p <= 0.05 for one in tests]) < 0.2
    assert np.mean([one.kernel_p <= 0.05 for one in tests]) > 0.9


def test_a_covariate_that_causes_all_the_difference_explains_it():
    random = default_rng(3)
    age = random.normal(size=60) + np.repeat([0, 2], 30)
    vectors = np.outer(age, [1.0, 0.5, 0, 0]) + 0.3 * random.normal(size=(60, 4))
    groups = ["young"] * 30 + ["old"] * 30
    alone = group_test(vectors, groups, n_permutations=999)
    explained = group_test(
        vectors,
        groups,
        covariates=age[:, None],
        n_permutations=999,
    )
    assert max(alone.permanova_p or 1, alone.kernel_p or 1) < 0.002
    assert min(explained.permanova_p or 0, explained.kernel_p or 0) > 0.05
    assert (alone.auc or 0) > 0.85 > 0.7 > (explained.auc or 1)
    assert (alone.effect_low or 0) > 0.1
    assert (explained.effect or 1) < 0.05


def test_statistics_are_those_of_the_textbook():
    random = default_rng(4)
    vectors = random.normal(size=(24, 3)) + np.repeat([0, 1], 12)[:, None]
    test = quick(vectors)
    one = vectors[:12]
    other = vectors[12:]
    half = (one.mean(axis=0) - other.mean(axis=0)) / 2
    between = 24 * (half**2).sum()
    within = 12 * (one.var(axis=0).sum() + other.var(axis=0).sum())
    assert test.permanova_f == pytest.approx(between / (within / 22))
    squares = squared_distances(vectors)
    expected = ((vectors[:, None] - vectors) ** 2).sum(axis=2)
    np.testing.assert_allclose(squares, expected, atol=1e-12)
    kernel = whitened_kernel(vectors)
    means = kernel[:12, :12].mean() + kernel[12:, 12:].mean() - 2 * kernel[:12, 12:].mean()
    assert test.kernel == pytest.approx(means)
    # Without bias: of the variance of all, the squared distance of the means less what chance adds to it
    variances = [part.var(axis=0, ddof=1).sum() for part in (one, other)]
    apart = ((one.mean(axis=0) - other.mean(axis=0)) ** 2).sum() - sum(variances) / 12
    expected = pytest.approx(apart / 4 / (apart / 4 + sum(variances) / 2))
    assert test.effect == expected


def test_the_interval_covers_the_effect():
    random = default_rng(5)
    # means 1 apart, two dimensions of variance 1
    truth = 0.25 / (0.25 + 2)
    covered = []
    for draw in range(100):
        vectors = random.normal(size=(80, 2)) + np.outer(np.repeat([0, 1], 40), [1, 0])
        test = quick(
            vectors,
            ["a"] * 40 + ["b"] * 40,
            draw,
            n_permutations=1,
            n_bootstraps=400,
        )
        covered.append((test.effect_low or 1) <= truth <= (test.effect_high or 0))
    assert 0.88 < np.mean(covered) < 0.99


def test_matched_pairs_without_a_difference_show_no_effect():
    """Over 40 draws the mean AUC is near 0.5, the mean effect near 0, and intervals cover 0."""
    random = default_rng(10)
    pairs = [str(i) for i in range(12)] * 2
    found = []
    for draw in range(40):
        vectors = random.normal(size=(24, 20)) + np.tile(3 * random.normal(size=(12, 20)), (2, 1))
        test = quick(vectors, seed=draw, strata=pairs, n_bootstraps=200, n_repeats=1)
        covered = (test.effect_low or 1) <= 0 <= (test.effect_high or -1)
        found.append((test.auc, test.effect, covered))
    auc, effect, covered = np.array(found, dtype=float).mean(axis=0)
    assert abs(auc - 0.5) < 0.1
    assert abs(effect) < 0.01
    assert covered > 0.9


@pytest.mark.filterwarnings("error")
def test_what_no_permutation_changes_has_a_probability_of_one():
    """If all bodies but one, or both groups, are equal, p = 1; for groups without scatter it is the least, 1 / 200."""
    random = default_rng(11)
    one = np.outer(
        np.arange(24) == 3,
        random.normal(size=5),
    )
    twice = np.tile(
        random.normal(size=(12, 3)),
        (2, 1),
    )
    for vectors in (one, twice):
        test = quick(vectors)
        assert test.permanova_p == test.kernel_p == 1
    apart = quick(np.repeat([[0.0], [1.0]], 12, axis=0))
    assert apart.permanova_p == apart.kernel_p == 1 / 200
    assert (apart.permanova_f or 0) > 1e12


@pytest.mark.filterwarnings("error")
def test_small_groups_have_an_interval():
    """A bootstrap sample may consist of one body drawn six times, which has no scatter."""
    random = default_rng(6)
    vectors = random.normal(size=(12, 3)) + np.repeat([0, 1], 6)[:, None]
    for seed in range(8):
        found = quick(
            vectors,
            ["a"] * 6 + ["b"] * 6,
            seed,
            n_bootstraps=2000,
        )
        assert found.effect_low is not None
        assert found.effect_high is not None
        assert found.effect_low < found.effect_high < 1


def test_a_probability_is_that_of_all_arrangements():
    """Ten numbers in two groups of five: 252 arrangements, counted one by one."""
    from itertools import combinations

    values = default_rng(6).normal(size=10) + np.repeat([0, 0.8], 5)
    kernel = whitened_kernel(values[:, None])
    of_means = []
    of_kernel = []
    for one in combinations(range(10), 5):  # the groups themselves first
        side = np.isin(np.arange(10), one)
        of_means.append(abs(values[side].mean() - values[~side].mean()))
        within = kernel[side][:, side].mean() + kernel[~side][:, ~side].mean()
        of_kernel.append(within - 2 * kernel[side][:, ~side].mean())
    arranged = np.array([of_means, of_kernel])
    exact = (arranged >= arranged[:, :1] - 1e-12).mean(axis=1)
    test = quick(
        values[:, None],
        ["a"] * 5 + ["b"] * 5,
        n_permutations=20_000,
    )
    expected = pytest.approx(exact, abs=0.01)
    assert [test.permanova_p, test.kernel_p] == expected


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ({"groups": ["a"] * 21 + ["b"] * 3}, "b has 3"),
        ({"groups": ["a"] * 24}, "expected two groups, got a alone"),
        ({"strata": PAIR}, "within strata the groups can be arranged in only 1 ways"),
        (
            {"covariates": np.repeat([[0.0], [1.0]], 12, axis=0)},
            "covariates or strata determine the groups",
        ),
        ({"vectors": np.ones((24, 3))}, "identical"),
        ({"covariates": default_rng(0).normal(size=(24, 21))}, "too few"),
    ],
)
def test_what_makes_no_sense_is_refused(given, why):
    vectors = default_rng(7).normal(size=(24, 3))
    test = quick(**{"vectors": vectors, **given})
    assert test.permanova_p is test.kernel_p is test.effect is None
    assert why in (test.refused or "")
    with pytest.raises(ValueError, match="strata: expected one for each of 24 bodies, got 2"):
        quick(vectors, strata=["a", "b"])


def test_discovery_rates_are_over_what_was_tested():
    tests = [
        GroupTest(
            str(p),
            {},
            permanova_p=p,
            kernel_p=p,
        )
        for p in (0.01, 0.04, 0.03)
    ]
    refused = GroupTest("no", {}, refused="too few")
    found = with_q_values([tests[0], refused, *tests[1:]])
    assert found[1] is refused
    expected = pytest.approx([0.03, None, 0.04, 0.04])
    assert [one.permanova_q for one in found] == expected
    assert with_q_values([refused]) == [refused]
    same = with_q_values([replace(one, body="all") for one in tests])
    assert [one.permanova_p for one in same] == [0.01, 0.04, 0.03]


def test_three_groups_are_tested_together():
    random = default_rng(8)
    vectors = random.normal(size=(45, 3)) + np.outer(np.repeat([0, 0, 3], 15), [1, 0, 0])
    test = quick(
        vectors,
        ["a"] * 15 + ["b"] * 15 + ["c"] * 15,
        n_repeats=1,
    )
    assert test.permanova_p == test.kernel_p == 1 / 200
    assert 0.6 < (test.auc or 0) < 1
