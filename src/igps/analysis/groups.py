"""Tests for differences between groups of bodies: two permutation tests, an effect size, and a classification score."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence, Sized
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
_MIN_ADDED = 1e-6  # smaller parts of group indicators count as explained by strata and covariates
_TINY = np.finfo(float).tiny


@dataclass(frozen=True)
class GroupTest:
    """Result of the tests for one kind of body; numbers are None if it was not tested."""

    body: str  # kind of body, such as an organ
    sizes: Mapping[str, int]  # sizes of the groups by name
    permanova_f: float | None = None  # pseudo-F (Anderson 2001)
    permanova_p: float | None = None  # p-value of the pseudo-F, by permutation
    # q-value: smallest false discovery rate at which it is significant
    permanova_q: float | None = None
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
    # Area under the curve of a ridge classifier, cross-validated, group mean; 0.5 for chance
    auc: float | None = None
    refused: str | None = None  # reason for no test

    def differs(self, level: float) -> bool:
        """Return whether one of both tests finds a difference at a false discovery rate."""
        found = [q for q in (self.permanova_q, self.kernel_q) if q is not None]
        return bool(found) and min(found) <= level


def squared_distances(rows: Floats) -> Floats:
    """Return the squared Euclidean distances (N, N) of rows (N, D)."""
    centred = rows - rows.mean(axis=0)
    return _squares(centred @ centred.T)


def group_test(  # noqa: PLR0913 (two arrays, and settings that all have a default)
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
    group = codes_of(groups)
    stratum = codes_of(strata)
    numbers = np.ones((n, 0))
    if covariates is not None:
        numbers = np.asarray(covariates, dtype=float).reshape(len(covariates), -1)
    _check_numbers_of_bodies(n, groups=groups, strata=strata, covariates=numbers)
    _check_finite(vectors=vectors, covariates=numbers)
    untested = GroupTest(body, dict(sorted(Counter(groups).items())))

    def refused(reason: str) -> GroupTest:
        return replace(untested, refused=reason)

    reason = _obstacle(untested.sizes, group, stratum)
    if reason is not None:
        return refused(reason)
    extent = np.ptp(vectors, axis=0).max()
    if extent <= _ROUNDING * np.abs(vectors).max():
        return refused("all bodies are identical.")
    design = design_of(group, stratum, numbers)
    n_added = design.added.shape[1]
    if n_added < len(untested.sizes) - 1:
        return refused("covariates or strata determine the groups.")
    nuisance = design.nuisance
    freedom = n - nuisance.shape[1] - n_added
    if freedom < 3:
        return refused(f"{n} bodies are too few for so many strata and covariates.")
    residual = np.eye(n) - nuisance @ nuisance.T  # projection
    centred = vectors - vectors.mean(axis=0)
    total = centred @ centred.T
    gram = residual @ total @ residual
    variation = np.trace(gram)
    if variation <= _ROUNDING * np.square(vectors).sum():
        return refused("the vectors do not differ beyond what covariates and strata explain.")
    kernel = residual @ _gaussian_kernel(gram) @ residual
    random = np.random.default_rng(seed)
    traces = _permuted_traces(gram, kernel, design, stratum, n_permutations, random)
    unexplained = np.maximum(variation - traces.of_covariates, _TINY)
    share = traces.of_groups / unexplained  # grows with pseudo-F
    odds = share[0] / max(1 - share[0], np.finfo(float).eps)
    # Covariates explain a share of the permuted groups, which the kernel of the residuals cannot contain
    kernel_share = np.maximum(1 - traces.overlap / n_added, _ROUNDING)
    squares = _squares_for_effect(gram, residual, design, group, freedom)
    sizes = np.bincount(group)
    effect = _effects(squares, group, [np.ones((1, size)) for size in sizes])
    low, high = _interval(squares, group, n_bootstraps, random)
    factor = n / np.prod(sizes) if len(sizes) == 2 else 1 / n
    return replace(
        untested,
        permanova_f=float(odds * freedom / n_added),
        permanova_p=_p_value(share),
        kernel=float(traces.of_kernel[0] * factor),
        kernel_p=_p_value(traces.of_kernel / kernel_share),
        effect=float(effect[0]),
        effect_low=low,
        effect_high=high,
        auc=_auc(total, nuisance, group, n_repeats, seed) if n_repeats else None,
    )


def codes_of(names: Sequence[str]) -> Integers:
    """Return the number of each name in the order of the alphabet."""
    _, codes = np.unique(np.asarray(names), return_inverse=True)
    return codes


def medoids_of(distances: Floats, codes: Integers) -> list[int]:
    """Return the body of each group that has the smallest sum of distances (N, N) to the others of the group."""
    medoids = []
    for code in range(int(codes.max()) + 1):
        own = np.flatnonzero(codes == code)
        sums = distances[np.ix_(own, own)].sum(axis=1)
        medoids.append(int(own[sums.argmin()]))
    return medoids


def _check_numbers_of_bodies(n: int, **values: Sized) -> None:
    for name, value in values.items():
        if len(value) != n:
            raise ValueError(f"{name}: expected one for each of {n} bodies, got {len(value)}.")


def _check_finite(**values: Floats) -> None:
    for name, numbers in values.items():
        if not np.isfinite(numbers).all():
            raise ValueError(f"{name}: expected finite numbers. Leave out bodies that have none.")


@dataclass(frozen=True, eq=False)
class Design:
    """Orthonormal bases (N, k). A permutation within strata changes the covariates, but not the means of strata."""

    nuisance: Floats  # the means of strata, and what covariates add to these
    covariates: Floats  # what covariates add to the means of strata
    added: Floats  # what groups add to both


def design_of(group: Integers, stratum: Integers, covariates: Floats) -> Design:
    strata = _orthonormal(_indicators(stratum), _ROUNDING)
    largest = np.abs(covariates).max(axis=0, initial=0)
    scaled = covariates / np.maximum(largest, _TINY)  # whatever the units
    centred = _orthonormal(scaled - scaled.mean(axis=0), _ROUNDING)
    beyond_strata = centred - strata @ (strata.T @ centred)
    basis = _orthonormal(beyond_strata, _ROUNDING)
    nuisance = np.column_stack([strata, basis])
    indicators = _indicators(group)
    beyond_both = indicators - nuisance @ (nuisance.T @ indicators)
    return Design(nuisance, basis, _orthonormal(beyond_both, _MIN_ADDED))


def _gaussian_kernel(gram: Floats) -> Floats:
    """Return the kernel (N, N) of the whitened vectors that belong to a Gram matrix."""
    whitened = _squares(_whitened(gram))
    pairs = whitened[np.triu_indices(len(gram), 1)]
    is_apart = pairs > _ROUNDING * pairs.max()  # most of the pairs may be duplicates
    width = np.median(pairs[is_apart])
    return np.asarray(np.exp(-whitened / (2 * width)))


@dataclass(frozen=True, eq=False)
class _Traces:
    """Traces for each permutation; the first is the identity."""

    of_groups: Floats  # of the Gram matrix in what groups add
    of_covariates: Floats  # of the Gram matrix in the covariates
    of_kernel: Floats  # of the kernel in what groups add
    overlap: Floats  # of what groups add with the covariates


def _permuted_traces(
    gram: Floats,
    kernel: Floats,
    design: Design,
    stratum: Integers,
    n_permutations: int,
    random: np.random.Generator,
) -> _Traces:
    count = n_permutations + 1
    result = _Traces(*np.empty((4, count)))
    covariates = design.covariates @ design.covariates.T
    n_columns = design.nuisance.shape[1] + design.added.shape[1]
    block = max(1, _BLOCK // (len(gram) * n_columns))
    for first in range(0, count, block):
        orders = permutations(stratum, min(block, count - first), random)
        if first == 0:
            orders[0] = np.arange(len(gram))
        part = slice(first, first + len(orders))
        result.of_groups[part] = _traces(gram, design.added, orders)
        result.of_covariates[part] = _traces(gram, design.covariates, orders)
        result.of_kernel[part] = _traces(kernel, design.added, orders)
        result.overlap[part] = _traces(covariates, design.added, orders)
    return result


def _squares_for_effect(
    gram: Floats, residual: Floats, design: Design, group: Integers, freedom: int
) -> Floats:
    """Return squared distances (N, N) as if there were no strata and covariates.

    The part that groups add is rotated to the group means. The remainder is scaled up to the variance before strata
    and covariates took their degrees of freedom: matched pairs keep half of it.
    """
    indicators = _indicators(group)
    at_means = _orthonormal(indicators - indicators.mean(axis=0), _MIN_ADDED)
    left, _, right = np.linalg.svd(at_means.T @ design.added)
    inflation = (len(group) - indicators.shape[1]) / freedom
    remainder = residual - design.added @ design.added.T
    adjustment = at_means @ left @ right @ design.added.T + np.sqrt(inflation) * remainder
    return _squares(adjustment @ gram @ adjustment.T)


def _interval(
    squares: Floats, group: Integers, n_bootstraps: int, random: np.random.Generator
) -> tuple[float | None, float | None]:
    """Return the 95 % interval of the effect, by bootstrap samples of each group; None without samples."""
    if n_bootstraps == 0:
        return None, None
    weights = []
    for size in np.bincount(group):
        equal = np.full(size, 1 / size)
        weights.append(random.multinomial(size, equal, n_bootstraps))
    # NaN if a group is drawn as copies of one body, which have no variance
    with np.errstate(invalid="ignore"):
        effects = _effects(squares, group, weights)
    low, high = np.nanquantile(effects, (0.025, 0.975))
    return float(low), float(high)


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
    smallest = min(sizes, key=sizes.__getitem__)
    if sizes[smallest] < _MIN_GROUP_SIZE:
        return f"{smallest} has {sizes[smallest]} bodies, a test needs at least {_MIN_GROUP_SIZE} in each group."
    counts = np.zeros((stratum.max() + 1, group.max() + 1), dtype=int)
    np.add.at(counts, (stratum, group), 1)
    log_ways = 0.0
    for row in counts:
        log_ways += math.lgamma(row.sum() + 1)
        log_ways -= sum(math.lgamma(k + 1) for k in row)
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


def _positive_eigenpairs(gram: Floats) -> tuple[Floats, Floats]:
    """Return the positive eigenvalues (k,) of a Gram matrix, ascending, and their eigenvectors (N, k)."""
    values, axes = np.linalg.eigh(gram)
    is_positive = values > _ROUNDING * values[-1]
    return values[is_positive], axes[:, is_positive]


def _whitened(gram: Floats) -> Floats:
    """Return G (G + ρ)⁻¹ of a Gram matrix G; the ridge ρ makes the trace the degrees of freedom, see `group_test`."""
    values, axes = _positive_eigenpairs(gram)
    freedom = min(len(gram) / _BODIES_PER_DEGREE, _MAX_RANK_SHARE * len(values))

    def excess(log_ridge: float) -> float:
        shares = values / (values + np.exp(log_ridge))
        return float(shares.sum()) - freedom

    # Bracket of the root: at the first every term exceeds the share of the rank, at the second the sum is below freedom
    smallest = values[0] * (1 / _MAX_RANK_SHARE - 1) / 2
    largest = 2 * values.sum() / freedom
    ridge = np.exp(brentq(excess, np.log(smallest), np.log(largest)))
    shares = values / (values + ridge)
    return np.asarray((axes * shares) @ axes.T)


def _squares(gram: Floats) -> Floats:
    """Return the squared distances (N, N) that belong to a Gram matrix."""
    lengths = np.diag(gram)
    squares = np.maximum(lengths[:, None] + lengths - 2 * gram, 0)
    np.fill_diagonal(squares, 0)
    return squares


def permutations(stratum: Integers, count: int, random: np.random.Generator) -> Integers:
    """Return random permutations (count, N) within strata."""
    orders = np.empty((count, len(stratum)), dtype=np.int64)
    for code in range(stratum.max() + 1):
        members = np.flatnonzero(stratum == code)
        copies = np.tile(members, (count, 1))
        orders[:, members] = random.permuted(copies, axis=1)
    return orders


def _traces(matrix: Floats, basis: Floats, orders: Integers) -> Floats:
    """Return the trace of bᵀ M b for a basis b (N, k) with its rows in each of the orders (count, N)."""
    count, n = orders.shape
    moved = basis[orders.T].reshape(n, -1)
    products = np.einsum("ij,ij->j", matrix @ moved, moved)
    return products.reshape(count, -1).sum(axis=1)


def _p_value(values: Floats) -> float:
    """Return the share of values at least as large as the first; ties within rounding count."""
    least = values[0] - _ROUNDING * values.max()
    return float((values >= least).mean())


def _effects(squares: Floats, group: Integers, weights: Sequence[Any]) -> Floats:
    """Return an effect for each row of weights (n, members) of the groups; pairs of a body with itself do not count."""
    members = [np.flatnonzero(group == code) for code in range(len(weights))]
    shares = [len(own) / len(group) for own in members]

    def mean(a: int, b: int) -> Floats:
        block = squares[np.ix_(members[a], members[b])]
        total = np.einsum("ni,ij,nj->n", weights[a], block, weights[b], optimize=True)
        n_pairs = weights[a].sum(axis=1) * weights[b].sum(axis=1)
        if a == b:
            n_pairs = n_pairs - np.square(weights[a]).sum(axis=1)
        return np.asarray(total / n_pairs)

    variances = [mean(a, a) / 2 for a in range(len(members))]
    between: Any = 0
    for a, b in combinations(range(len(members)), 2):
        apart = mean(a, b) - variances[a] - variances[b]
        between = between + shares[a] * shares[b] * apart
    within: Any = 0
    for share, variance in zip(shares, variances, strict=True):
        within = within + share * variance
    return np.asarray(between / (between + within))


def _auc(gram: Floats, nuisance: Floats, group: Integers, n_repeats: int, seed: int) -> float:
    """Return the area under the curve of a ridge classifier, by five-fold cross-validation.

    The classifier uses principal coordinates, which are equivalent to the vectors for a ridge. The nuisance terms
    (N, k) are regressed out with the training bodies alone: the mean of a pair would reveal the group of the other.
    """
    from sklearn.linear_model import RidgeClassifierCV
    from sklearn.metrics import roc_auc_score
    from sklearn.model_selection import RepeatedStratifiedKFold

    values, axes = _positive_eigenpairs(gram)
    coordinates = axes * np.sqrt(values)
    alphas = values.mean() * np.logspace(-3, 3, 7)
    areas = []
    folds = RepeatedStratifiedKFold(n_splits=5, n_repeats=n_repeats, random_state=seed)
    for training, test in folds.split(gram, group):
        effects, *_ = np.linalg.lstsq(nuisance[training], coordinates[training], rcond=1e-9)
        residuals = coordinates - nuisance @ effects
        classifier = RidgeClassifierCV(alphas)
        classifier.fit(residuals[training], group[training])
        scores = classifier.decision_function(residuals[test])
        if scores.ndim == 1:  # for two groups, scikit-learn returns the score of the second
            scores = np.stack([-scores, scores], axis=1)
        by_group = []
        for code, column in enumerate(scores.T):
            by_group.append(roc_auc_score(group[test] == code, column))
        areas.append(np.mean(by_group))
    return float(np.mean(areas))
