"""Whether groups of bodies differ: two tests by permutation, how large the difference is, and how well it sorts."""

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

FEWEST = 5
"""Of a group, for a test."""
# Permutations that differ, for the smallest level to be of use
_FEWEST_ARRANGEMENTS = 100
# Numbers that permuted designs hold at once
_BLOCK = 2**24
# For each degree of freedom of what is whitened, a usual rule of regression
_BODIES_EACH = 10
_MOST_OF_RANK = 0.9
_ROUNDING = 1e-9


@dataclass(frozen=True)
class GroupTest:
    """Whether groups differ in one kind of body; numbers are None where nothing was tested."""

    body: str  # which, such as an organ
    sizes: Mapping[str, int]  # of the groups by name
    permanova_f: float | None = None  # pseudo-F (Anderson 2001)
    permanova_p: float | None = None  # of it, by permutation
    permanova_q: float | None = None  # smallest false discovery rate to find the body (Benjamini and Hochberg 1995)
    # Two-sample statistic (Gretton et al. 2012) of whitened vectors, the squared distance between the kernel means of
    # two groups; of more, their weighted mean square about the mean of all
    kernel: float | None = None
    kernel_p: float | None = None  # of it, by the same permutations
    kernel_q: float | None = None  # as permanova_q
    # Share of the squared distances that the groups explain, without what chance alone explains: 0 on average where
    # there is no difference, at most 1; and its 95 % interval
    effect: float | None = None
    effect_low: float | None = None
    effect_high: float | None = None
    auc: float | None = None  # of a ridge classifier by cross-validation, 0.5 for chance; mean over the groups
    refused: str | None = None  # why nothing was tested


def squared_distances(rows: Floats) -> Floats:
    """(N, N) squared Euclidean distances of rows (N, D)."""
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

    Covariates and the means of strata are regressed out of the vectors and of the groups; what is left of the vectors
    is permuted within strata (Freedman and Lane 1983; with distances, McArdle and Anderson 2001). PERMANOVA is the
    pseudo-F of these, and sees what is large beside the usual differences. The kernel test also sees what is small: it
    whitens what is left of the vectors by their covariance, with a ridge that leaves a degree of freedom for every ten
    bodies (as Harchaoui, Bach and Moulines 2008; of all bodies, so that permutations share it), and takes a Gaussian
    kernel with the median distance as its width, over the share of the groups that covariates do not explain. A
    probability is (1 + permutations as extreme) / (1 + permutations) (Phipson and Smyth 2010).

    Args:
        vectors: (N, D) of N bodies, one of each subject.
        groups: N names.
        strata: N names, such as of scanners; None where all may be permuted.
        covariates: (N, k) numbers, such as ages.
        body: what is tested.
        n_permutations, n_bootstraps: at random; without the latter the effect has no interval.
        n_repeats: of the cross-validation by five folds; 0 for none.
        seed: of both, and of the folds.

    Raises:
        ValueError: shapes that do not match, or numbers that are not finite.
    """
    check_at_least(1, n_permutations=n_permutations)
    n = len(vectors)
    strata = ["all"] * n if strata is None else strata
    codes_of = [np.unique(np.asarray(one), return_inverse=True)[1] for one in (groups, strata)]
    known = np.ones((n, 0)) if covariates is None else np.asarray(covariates, dtype=float).reshape(len(covariates), -1)
    for name, found in (("groups", len(groups)), ("strata", len(codes_of[1])), ("covariates", len(known))):
        if found != n:
            raise ValueError(f"{name}: expected one for each of {n} bodies, got {found}.")
    for name, numbers in (("vectors", vectors), ("covariates", known)):
        if not np.isfinite(numbers).all():
            raise ValueError(f"{name}: expected finite numbers. Leave out bodies that have none.")
    group, stratum = codes_of
    untested = GroupTest(body, dict(sorted(Counter(groups).items())))
    if why := _senseless(untested.sizes, group, stratum):
        return replace(untested, refused=why)
    # What is known of the bodies, and what the groups add to that, both orthonormal
    means = _orthonormal(_indicators(stratum), _ROUNDING)
    known = known / np.maximum(np.abs(known).max(axis=0, initial=0), np.finfo(float).tiny)  # whatever the unit
    known = _orthonormal(known - known.mean(axis=0), _ROUNDING)
    # Of covariates alone: no permutation within strata changes the means of these
    along = _orthonormal(known - means @ (means.T @ known), _ROUNDING)
    known = np.column_stack([means, along])
    indicators = _indicators(group)
    added = _orthonormal(indicators - known @ (known.T @ indicators), 1e-6)
    if added.shape[1] < len(untested.sizes) - 1:
        return replace(untested, refused="covariates or strata tell the groups apart by themselves.")
    if n - known.shape[1] - added.shape[1] < 3:
        return replace(untested, refused=f"{n} bodies are too few for so many strata and covariates.")
    beside = np.eye(n) - known @ known.T
    centred = vectors - vectors.mean(axis=0)
    whole = centred @ centred.T
    gram = beside @ whole @ beside
    if np.trace(gram) <= _ROUNDING * np.square(vectors).sum():
        return replace(untested, refused="the vectors do not differ, but for what covariates and strata explain.")
    whitened = _squares(_whitened(gram))
    apart = whitened[np.triu_indices(n, 1)]
    width = np.median(apart[apart > _ROUNDING * apart.max()])  # more than half of the pairs may be the same twice
    kernel = beside @ np.exp(-whitened / (2 * width)) @ beside

    random = np.random.default_rng(seed)
    of_groups, of_known, of_kernel, overlap = np.empty((4, n_permutations + 1))
    block = max(1, _BLOCK // (n * (known.shape[1] + added.shape[1])))
    for first in range(0, n_permutations + 1, block):
        orders = _orders(stratum, min(block, n_permutations + 1 - first), random)
        if first == 0:
            orders[0] = np.arange(n)
        part = slice(first, first + len(orders))
        of_groups[part], of_known[part] = _along(gram, added, orders), _along(gram, along, orders)
        of_kernel[part], overlap[part] = _along(kernel, added, orders), _along(along @ along.T, added, orders)
    share = of_groups / np.maximum(np.trace(gram) - of_known, np.finfo(float).tiny)  # grows with pseudo-F, to 1
    freedom = n - known.shape[1] - added.shape[1]
    # Covariates explain a share of permuted groups, of which the kernel then sees nothing
    unexplained = np.maximum(1 - overlap / added.shape[1], _ROUNDING)
    # For the effect, what the groups add stands at their means, and the rest has the variance that its degrees of
    # freedom leave: matched pairs have half of it
    sizes = np.bincount(group)
    at_means = _orthonormal(indicators - indicators.mean(axis=0), 1e-6)
    one, _, other = np.linalg.svd(at_means.T @ added)
    inflation = (n - len(sizes)) / freedom
    told = at_means @ one @ other @ added.T + np.sqrt(inflation) * (beside - added @ added.T)
    squares = _squares(told @ gram @ told.T)
    weights = [random.multinomial(k, np.full(k, 1 / k), n_bootstraps) for k in sizes]
    # Of a small group all may be drawn as one body, whose scatter nobody knows
    with np.errstate(invalid="ignore"):
        effects = _effects(squares, group, weights)
    low, high = np.nanquantile(effects, (0.025, 0.975)) if n_bootstraps else (None, None)
    return replace(
        untested,
        permanova_f=float(share[0] / max(1 - share[0], np.finfo(float).eps) * freedom / added.shape[1]),
        permanova_p=_probability(share),
        kernel=float(of_kernel[0] * (n / np.prod(sizes) if len(sizes) == 2 else 1 / n)),
        kernel_p=_probability(of_kernel / unexplained),
        effect=float(_effects(squares, group, [np.ones((1, k)) for k in sizes])[0]),
        effect_low=None if low is None else float(low),
        effect_high=None if high is None else float(high),
        auc=_auc(whole, known, group, n_repeats, seed) if n_repeats else None,
    )


def with_discovery_rates(tests: Sequence[GroupTest]) -> list[GroupTest]:
    """The tests with their q-values, over the bodies that were tested (Benjamini and Hochberg 1995)."""
    from scipy.stats import false_discovery_control

    tested = {i: one for i, one in enumerate(tests) if one.refused is None}
    if not tested:
        return list(tests)
    permanova, kernel = (
        false_discovery_control([getattr(one, name) for one in tested.values()]) for name in ("permanova_p", "kernel_p")
    )
    rates = zip(permanova.tolist(), kernel.tolist(), strict=True)
    found = {i: replace(tests[i], permanova_q=p, kernel_q=q) for i, (p, q) in zip(tested, rates, strict=True)}
    return [found.get(i, one) for i, one in enumerate(tests)]


def _senseless(sizes: Mapping[str, int], group: Integers, stratum: Integers) -> str | None:
    """Why a test would make no sense."""
    if len(sizes) < 2:
        return f"expected two groups, got {', '.join(sizes) or 'none'} alone."
    smallest = min(sizes, key=lambda name: sizes[name])
    if sizes[smallest] < FEWEST:
        return f"{smallest} has {sizes[smallest]}: fewer than {FEWEST} in a group cannot tell it from chance."
    counts = np.zeros((stratum.max() + 1, group.max() + 1), dtype=int)
    np.add.at(counts, (stratum, group), 1)
    logs = sum(math.lgamma(row.sum() + 1) - sum(math.lgamma(k + 1) for k in row) for row in counts)
    if logs < math.log(_FEWEST_ARRANGEMENTS):
        return f"within strata the groups can be arranged in only {math.exp(logs):.0f} ways, too few for a test."
    return None


def _indicators(codes: Integers) -> Floats:
    return np.eye(int(codes.max()) + 1)[codes]


def _orthonormal(columns: Floats, least: float) -> Floats:
    """An orthonormal basis of what columns of like scale span."""
    lengths = np.linalg.norm(columns, axis=0)
    columns = columns / np.where(lengths > least, lengths, np.inf)
    left, values, _ = np.linalg.svd(columns, full_matrices=False)
    return left[:, values > least]


def _whitened(gram: Floats) -> Floats:
    """G (G + ρ)⁻¹ of a Gram matrix G; ρ leaves a degree of freedom for every ten bodies, or as the rank allows."""
    values, axes = np.linalg.eigh(gram)
    kept = values > _ROUNDING * values[-1]
    values, axes = values[kept], axes[:, kept]
    freedom = min(len(gram) / _BODIES_EACH, _MOST_OF_RANK * len(values))

    def excess(logarithm: float) -> float:
        return float((values / (values + np.exp(logarithm))).sum()) - freedom

    # With the first each value counts for at least the share of the rank, with the other all for at most the freedom
    ridges = values[0] * (1 / _MOST_OF_RANK - 1) / 2, 2 * values.sum() / freedom
    ridge = np.exp(brentq(excess, *np.log(ridges)))
    found: Floats = (axes * (values / (values + ridge))) @ axes.T
    return found


def _squares(gram: Floats) -> Floats:
    lengths = np.diag(gram)
    found = np.maximum(lengths[:, None] + lengths - 2 * gram, 0)
    np.fill_diagonal(found, 0)
    return found


def _orders(stratum: Integers, count: int, random: np.random.Generator) -> Integers:
    """(count, N) random permutations within strata."""
    orders = np.empty((count, len(stratum)), dtype=np.int64)
    for one in range(stratum.max() + 1):
        members = np.flatnonzero(stratum == one)
        orders[:, members] = random.permuted(np.tile(members, (count, 1)), axis=1)
    return orders


def _along(matrix: Floats, basis: Floats, orders: Integers) -> Floats:
    """Traces bᵀ M b of a basis (N, k), its rows in each of several orders (n, N)."""
    count, n = orders.shape
    moved = basis[orders.T].reshape(n, -1)
    return np.einsum("ij,ij->j", matrix @ moved, moved).reshape(count, -1).sum(axis=1)


def _probability(values: Floats) -> float:
    """Of the first among all; ties within rounding count as extreme."""
    return float((values >= values[0] - _ROUNDING * values.max()).mean())


def _effects(squares: Floats, group: Integers, weights: Sequence[Any]) -> Floats:
    """(n,) effects, each with weights (n, members) of each group's bodies; no pair of a body with itself counts."""
    members = [np.flatnonzero(group == one) for one in range(len(weights))]
    shares = [len(one) / len(group) for one in members]

    def mean(a: int, b: int) -> Floats:
        of_pairs = np.einsum(
            "ni,ij,nj->n", weights[a], squares[np.ix_(members[a], members[b])], weights[b], optimize=True
        )
        pairs = weights[a].sum(axis=1) * weights[b].sum(axis=1)
        found: Floats = of_pairs / (pairs - np.square(weights[a]).sum(axis=1) if a == b else pairs)
        return found

    inside = [mean(a, a) / 2 for a in range(len(members))]
    pairs = combinations(range(len(members)), 2)
    between: Any = sum(shares[a] * shares[b] * (mean(a, b) - inside[a] - inside[b]) for a, b in pairs)
    within: Any = sum(share * one for share, one in zip(shares, inside, strict=True))
    effects: Floats = between / (between + within)
    return effects


def _auc(gram: Floats, known: Floats, group: Integers, n_repeats: int, seed: int) -> float:
    """By five folds; the rows' principal coordinates are to a ridge what the rows are.

    What is known (N, k) is regressed out by the bodies that train alone: of a pair, the mean would tell the other.
    """
    from sklearn.linear_model import RidgeClassifierCV
    from sklearn.metrics import roc_auc_score
    from sklearn.model_selection import RepeatedStratifiedKFold

    values, axes = np.linalg.eigh(gram)
    kept = values > _ROUNDING * values[-1]
    coordinates = axes[:, kept] * np.sqrt(values[kept])
    alphas = values[kept].mean() * np.logspace(-3, 3, 7)
    found = []
    folds = RepeatedStratifiedKFold(n_splits=5, n_repeats=n_repeats, random_state=seed)
    for training, test in folds.split(gram, group):
        left = coordinates - known @ np.linalg.lstsq(known[training], coordinates[training], rcond=1e-9)[0]
        scores = RidgeClassifierCV(alphas).fit(left[training], group[training]).decision_function(left[test])
        if scores.ndim == 1:  # of two groups, for the second
            scores = np.stack([-scores, scores], axis=1)
        found.append(np.mean([roc_auc_score(group[test] == one, column) for one, column in enumerate(scores.T)]))
    return float(np.mean(found))
