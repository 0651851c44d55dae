"""Tests for differences between groups of bodies: two permutation tests, an effect size, and a classification score."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from scipy.optimize import brentq

from igps._arrays import Floats, Integers
from igps._parameters import check_at_least

_MIN_GROUP_SIZE = 5  # for a test
_MIN_ARRANGEMENTS = 100  # different permutations; fewer allow no small p-value
_BLOCK = 2**24  # entries of permuted designs in memory at once
_BODIES_PER_DEGREE = 10  # bodies per degree of freedom of the whitening, a usual rule of regression
_MAX_RANK_SHARE = 0.9  # upper bound of the degrees of freedom of the whitening, over the rank
_ROUNDING = 1e-9  # relative; smaller values count as zero


@dataclass(frozen=True)
class GroupTest:
    """Result of the tests for one kind of body; numbers are None if it was not tested."""

    body: str  # kind of body, such as an organ
    sizes: Mapping[str, int]  # sizes of the groups by name
    permanova_f: float | None = None  # pseudo-F (Anderson 2001)
    permanova_p: float | None = None  # p-value of the pseudo-F, by permutation
    permanova_q: float | None = (
        None  # q-value: smallest false discovery rate at which it is significant
    )
    # Kernel two-sample statistic (Gretton et al. 2012) of the whitened vectors: the squared distance between the kernel
    # means of two groups; for more groups, the weighted mean squared distance of their means from the overall mean
    kernel: float | None = None
    kernel_p: float | None = None  # p-value of the kernel statistic, by the same permutations
    kernel_q: float | None = None  # q-value of the kernel statistic
    # Share of the squared distances that the groups explain beyond chance, at most 1, and on average 0 without a
    # difference; and its 95 % interval
    effect: float | None = None
    effect_low: float | None = None
    effect_high: float | None = None
    auc: float | None = (
        None  # area under the curve of a ridge classifier, cross-validated, group mean; 0.5 for chance
    )
    refused: str | None = None  # reason for no test


def squared_distances(rows: Floats) -> Floats:
    """Return the squared Euclidean distances (N, N) of rows (N, D)."""
    return _squares((centred := rows - rows.mean(axis=0)) @ centred.T)


def group_test(
    vectors: Floats,
    groups: Sequence[str],
    *,
    strata: Sequence[str] | None = None,
    covariates: Floats | None = None,
    body: str = "all",
    n_permutations: int = 10_000,
    n_bootstraps: int = 2000,
    n_repeats: int = 3,
    seed: int = 0,
) -> GroupTest:
    """Test whether groups differ.

    Covariates and the means of strata are regressed out of the vectors and of the group indicators. The residuals of
    the vectors are permuted within strata (Freedman and Lane 1983; for distances, McArdle and Anderson 2001).

    PERMANOVA uses the pseudo-F of the residuals, and detects differences that are large compared with the variation.
    The kernel test also detects small differences. It whitens the residuals by their covariance, with a ridge that
    leaves one degree of freedom for every ten bodies (Harchaoui, Bach and Moulines 2008, but with the covariance of all
    bodies, which is the same for all permutations), and uses a Gaussian kernel with the median distance as width. Its
    statistic is divided by the share of the group indicators that covariates do not explain. A p-value is
    (1 + permutations as extreme) / (1 + permutations) (Phipson and Smyth 2010).

    Args:
        vectors: (N, D) vectors of N bodies, each of another subject.
        groups: names of the groups of the N bodies.
        strata: names of the strata of the N bodies, such as scanners; None permutes all bodies.
        covariates: (N, k) numbers, such as ages.
        body: name of the kind of body, for the result.
        n_permutations: number of random permutations.
        n_bootstraps: number of bootstrap samples for the interval of the effect; 0 for no interval.
        n_repeats: repetitions of the five-fold cross-validation; 0 for no area under the curve.
        seed: seed of the permutations, bootstrap samples and folds.

    Raises:
        ValueError: shapes that do not match, or numbers that are not finite.
    """
    check_at_least(1, n_permutations=n_permutations)
    n = len(vectors)
    strata = ["all"] * n if strata is None else strata
    group, stratum = (
        np.unique(np.asarray(names), return_inverse=True)[1] for names in (groups, strata)
    )
    design = (
        np.ones((n, 0))
        if covariates is None
        else np.asarray(covariates, dtype=float).reshape(len(covariates), -1)
    )
    for name, count in (
        ("groups", len(groups)),
        ("strata", len(stratum)),
        ("covariates", len(design)),
    ):
        if count != n:
            raise ValueError(f"{name}: expected one for each of {n} bodies, got {count}.")
    for name, numbers in (("vectors", vectors), ("covariates", design)):
        if not np.isfinite(numbers).all():
            raise ValueError(f"{name}: expected finite numbers. Leave out bodies that have none.")
    untested = GroupTest(body, dict(sorted(Counter(groups).items())))
    if reason := _obstacle(untested.sizes, group, stratum):
        return replace(untested, refused=reason)
    # Orthonormal bases of the means of strata, of what covariates add to these, and of what groups add to both. A
    # permutation within strata changes the covariates, but not the means of strata
    stratum_basis = _orthonormal(_indicators(stratum), _ROUNDING)
    design = design / np.maximum(
        np.abs(design).max(axis=0, initial=0), np.finfo(float).tiny
    )  # whatever the units
    design = _orthonormal(design - design.mean(axis=0), _ROUNDING)
    covariate_basis = _orthonormal(design - stratum_basis @ (stratum_basis.T @ design), _ROUNDING)
    nuisance = np.column_stack([stratum_basis, covariate_basis])
    indicators = _indicators(group)
    added = _orthonormal(indicators - nuisance @ (nuisance.T @ indicators), 1e-6)
    if added.shape[1] < len(untested.sizes) - 1:
        return replace(untested, refused="covariates or strata determine the groups.")
    freedom = n - nuisance.shape[1] - added.shape[1]
    if freedom < 3:
        return replace(
            untested, refused=f"{n} bodies are too few for so many strata and covariates."
        )
    residual = np.eye(n) - nuisance @ nuisance.T  # projection
    centred = vectors - vectors.mean(axis=0)
    total = centred @ centred.T
    gram = residual @ total @ residual
    if np.trace(gram) <= _ROUNDING * np.square(vectors).sum():
        return replace(
            untested, refused="the vectors do not differ beyond what covariates and strata explain."
        )
    whitened = _squares(_whitened(gram))
    pairs = whitened[np.triu_indices(n, 1)]
    width = np.median(pairs[pairs > _ROUNDING * pairs.max()])  # most of the pairs may be duplicates
    kernel = residual @ np.exp(-whitened / (2 * width)) @ residual

    random = np.random.default_rng(seed)
    group_traces, covariate_traces, kernel_traces, overlap = np.empty((4, n_permutations + 1))
    block = max(1, _BLOCK // (n * (nuisance.shape[1] + added.shape[1])))
    for first in range(0, n_permutations + 1, block):
        orders = _permutations(stratum, min(block, n_permutations + 1 - first), random)
        if first == 0:
            orders[0] = np.arange(n)
        part = slice(first, first + len(orders))
        group_traces[part] = _traces(gram, added, orders)
        covariate_traces[part] = _traces(gram, covariate_basis, orders)
        kernel_traces[part] = _traces(kernel, added, orders)
        overlap[part] = _traces(covariate_basis @ covariate_basis.T, added, orders)
    share = group_traces / np.maximum(
        np.trace(gram) - covariate_traces, np.finfo(float).tiny
    )  # grows with pseudo-F
    # Covariates explain a share of the permuted groups, which the kernel of the residuals cannot contain
    unexplained = np.maximum(1 - overlap / added.shape[1], _ROUNDING)
    # For the effect, the part that groups add is rotated to the group means, and the remainder is scaled up to the
    # variance before strata and covariates took their degrees of freedom: matched pairs keep half of it
    sizes = np.bincount(group)
    at_means = _orthonormal(indicators - indicators.mean(axis=0), 1e-6)
    left, _, right = np.linalg.svd(at_means.T @ added)
    inflation = (n - len(sizes)) / freedom
    adjustment = at_means @ left @ right @ added.T + np.sqrt(inflation) * (
        residual - added @ added.T
    )
    squares = _squares(adjustment @ gram @ adjustment.T)
    weights = [random.multinomial(k, np.full(k, 1 / k), n_bootstraps) for k in sizes]
    with np.errstate(
        invalid="ignore"
    ):  # NaN if a group is drawn as copies of one body, which have no variance
        effects = _effects(squares, group, weights)
    low, high = np.nanquantile(effects, (0.025, 0.975)) if n_bootstraps else (None, None)
    return replace(
        untested,
        permanova_f=float(
            share[0] / max(1 - share[0], np.finfo(float).eps) * freedom / added.shape[1]
        ),
        permanova_p=_p_value(share),
        kernel=float(kernel_traces[0] * (n / np.prod(sizes) if len(sizes) == 2 else 1 / n)),
        kernel_p=_p_value(kernel_traces / unexplained),
        effect=float(_effects(squares, group, [np.ones((1, k)) for k in sizes])[0]),
        effect_low=None if low is None else float(low),
        effect_high=None if high is None else float(high),
        auc=_auc(total, nuisance, group, n_repeats, seed) if n_repeats else None,
    )


def with_q_values(tests: Sequence[GroupTest]) -> list[GroupTest]:
    """Return the tests with their q-values over all bodies that were tested (Benjamini and Hochberg 1995)."""
    from scipy.stats import false_discovery_control

    tested = [i for i, test in enumerate(tests) if test.refused is None]
    result = list(tests)
    for name in ("permanova", "kernel") if tested else ():
        q_values = false_discovery_control([getattr(tests[i], f"{name}_p") for i in tested])
        for i, q in zip(tested, q_values.tolist(), strict=True):
            result[i] = replace(result[i], **{f"{name}_q": q})
    return result


def _obstacle(sizes: Mapping[str, int], group: Integers, stratum: Integers) -> str | None:
    """Return the reason why groups cannot be tested, or None."""
    if len(sizes) < 2:
        return f"expected two groups, got {', '.join(sizes) or 'none'} alone."
    smallest = min(sizes, key=lambda name: sizes[name])
    if sizes[smallest] < _MIN_GROUP_SIZE:
        return f"{smallest} has {sizes[smallest]} bodies, a test needs at least {_MIN_GROUP_SIZE} in each group."
    counts = np.zeros((stratum.max() + 1, group.max() + 1), dtype=int)
    np.add.at(counts, (stratum, group), 1)
    log_ways = sum(
        math.lgamma(row.sum() + 1) - sum(math.lgamma(k + 1) for k in row) for row in counts
    )
    if log_ways < math.log(_MIN_ARRANGEMENTS):
        return f"within strata the groups can be arranged in only {math.exp(log_ways):.0f} ways, too few for a test."
    return None


def _indicators(codes: Integers) -> Floats:
    return np.eye(int(codes.max()) + 1)[codes]


def _orthonormal(columns: Floats, tolerance: float) -> Floats:
    """Return an orthonormal basis of the span of columns of similar scale."""
    lengths = np.linalg.norm(columns, axis=0)
    columns = columns / np.where(lengths > tolerance, lengths, np.inf)
    left, values, _ = np.linalg.svd(columns, full_matrices=False)
    return left[:, values > tolerance]


def _whitened(gram: Floats) -> Floats:
    """Return G (G + ρ)⁻¹ of a Gram matrix G; the ridge ρ makes the trace the degrees of freedom, see `group_test`."""
    values, axes = np.linalg.eigh(gram)
    is_positive = values > _ROUNDING * values[-1]
    values, axes = values[is_positive], axes[:, is_positive]
    freedom = min(len(gram) / _BODIES_PER_DEGREE, _MAX_RANK_SHARE * len(values))

    def excess(log_ridge: float) -> float:
        return float((values / (values + np.exp(log_ridge))).sum()) - freedom

    # Bracket of the root: at the first every term exceeds the share of the rank, at the second the sum is below freedom
    ridges = values[0] * (1 / _MAX_RANK_SHARE - 1) / 2, 2 * values.sum() / freedom
    ridge = np.exp(brentq(excess, *np.log(ridges)))
    return np.asarray((axes * (values / (values + ridge))) @ axes.T)


def _squares(gram: Floats) -> Floats:
    """Return the squared distances (N, N) that belong to a Gram matrix."""
    lengths = np.diag(gram)
    squares = np.maximum(lengths[:, None] + lengths - 2 * gram, 0)
    np.fill_diagonal(squares, 0)
    return squares


def _permutations(stratum: Integers, count: int, random: np.random.Generator) -> Integers:
    """Return random permutations (count, N) within strata."""
    orders = np.empty((count, len(stratum)), dtype=np.int64)
    for code in range(stratum.max() + 1):
        members = np.flatnonzero(stratum == code)
        orders[:, members] = random.permuted(np.tile(members, (count, 1)), axis=1)
    return orders


def _traces(matrix: Floats, basis: Floats, orders: Integers) -> Floats:
    """Return the trace of bᵀ M b for a basis b (N, k) with its rows in each of the orders (count, N)."""
    count, n = orders.shape
    moved = basis[orders.T].reshape(n, -1)
    return np.einsum("ij,ij->j", matrix @ moved, moved).reshape(count, -1).sum(axis=1)


def _p_value(values: Floats) -> float:
    """Return the share of values at least as large as the first; ties within rounding count."""
    return float((values >= values[0] - _ROUNDING * values.max()).mean())


def _effects(squares: Floats, group: Integers, weights: Sequence[Any]) -> Floats:
    """Return an effect for each row of weights (n, members) of the groups; pairs of a body with itself do not count."""
    members = [np.flatnonzero(group == code) for code in range(len(weights))]
    shares = [len(own) / len(group) for own in members]

    def mean(a: int, b: int) -> Floats:
        total = np.einsum(
            "ni,ij,nj->n",
            weights[a],
            squares[np.ix_(members[a], members[b])],
            weights[b],
            optimize=True,
        )
        n_pairs = weights[a].sum(axis=1) * weights[b].sum(axis=1)
        return np.asarray(
            total / (n_pairs - np.square(weights[a]).sum(axis=1) if a == b else n_pairs)
        )

    variances = [mean(a, a) / 2 for a in range(len(members))]
    pairs = combinations(range(len(members)), 2)
    between: Any = sum(
        shares[a] * shares[b] * (mean(a, b) - variances[a] - variances[b]) for a, b in pairs
    )
    within: Any = sum(share * variance for share, variance in zip(shares, variances, strict=True))
    return np.asarray(between / (between + within))


def _auc(gram: Floats, nuisance: Floats, group: Integers, n_repeats: int, seed: int) -> float:
    """Return the area under the curve of a ridge classifier, by five-fold cross-validation.

    The classifier uses principal coordinates, which are equivalent to the vectors for a ridge. The nuisance terms
    (N, k) are regressed out with the training bodies alone: the mean of a pair would reveal the group of the other.
    """
    from sklearn.linear_model import RidgeClassifierCV
    from sklearn.metrics import roc_auc_score
    from sklearn.model_selection import RepeatedStratifiedKFold

    values, axes = np.linalg.eigh(gram)
    is_positive = values > _ROUNDING * values[-1]
    coordinates = axes[:, is_positive] * np.sqrt(values[is_positive])
    alphas = values[is_positive].mean() * np.logspace(-3, 3, 7)
    areas = []
    folds = RepeatedStratifiedKFold(n_splits=5, n_repeats=n_repeats, random_state=seed)
    for training, test in folds.split(gram, group):
        residuals = (
            coordinates
            - nuisance @ np.linalg.lstsq(nuisance[training], coordinates[training], rcond=1e-9)[0]
        )
        scores = (
            RidgeClassifierCV(alphas)
            .fit(residuals[training], group[training])
            .decision_function(residuals[test])
        )
        if scores.ndim == 1:  # for two groups, scikit-learn returns the score of the second
            scores = np.stack([-scores, scores], axis=1)
        areas.append(
            np.mean(
                [roc_auc_score(group[test] == code, column) for code, column in enumerate(scores.T)]
            )
        )
    return float(np.mean(areas))
