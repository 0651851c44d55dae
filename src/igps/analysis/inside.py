"""Where in a body the values of an attribute lie, such as those of a CT, in numbers that do not depend on pose.

Samples are grouped by what the body itself gives: the potential, the distance from the surface, its first modes, and
interior distances. The values are then summarised in each group. All formulas are on the page *Where inside*. Nothing
depends on the sign of an eigenfunction, or on the basis inside a multiplet.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.spatial.distance import pdist
from scipy.stats import rankdata

from igps._arrays import Booleans, Floats, Integers, Singles
from igps.data.requirements import Requirements
from igps.signature.signature import Signature

REQUIREMENTS = Requirements(n_eigenpairs=64, attributes=("depth",))
"""What a Signature must have. With 16 to 250 eigenpairs, the numbers change with pose by the same amount."""

MIN_SAMPLES = 4000
"""Interior samples of a body. With 1000, another pose and its grid change the numbers by half as much again."""

VERSION = 1
"""Raise it whenever the same Signature would give other numbers."""

BY_POTENTIAL = ("core", "middle", "ends")
BY_DEPTH = ("rim", "mantle", "deep")
CLASSES = (*BY_POTENTIAL, *BY_DEPTH)
N_AXES = 3
PAIR_CLASSES = ("near", "middle", "far")
_PAIR_SHARES = (0.05, 0.5)  # of all pairs: near ones, and near or middle ones
_N_PAIRED = 2000  # samples whose pairs are compared
_SAME_MODE = 1.05  # ratio of two successive eigenvalues below which their modes share an axis
_BRIGHT = 0.1  # share of the samples that are the brightest
_CONSTANT = 1e-6  # standard deviations below this share of the largest value are rounding
_N_QUARTERS = 4

DISTRIBUTION = ("mean", "sd", "q10", "median", "q90")
OF_CLASS = (*DISTRIBUTION, "contrast", "bright")
OF_AXIS = ("correlation", "outward")
JOINT = ("correlation", "rank_correlation", "overlap", "information")


def column_names(attributes: Sequence[str]) -> list[str]:
    """Return the names of all numbers of attributes, in order, such as `ct.core.mean`."""
    names = []
    for attribute in attributes:
        names += [f"{attribute}.{number}" for number in DISTRIBUTION]
        for place in CLASSES:
            names += [f"{attribute}.{place}.{number}" for number in OF_CLASS]
        for axis in range(1, N_AXES + 1):
            names += [f"{attribute}.axis{axis}.{number}" for number in OF_AXIS]
        names += [f"{attribute}.variogram.{pairs}" for pairs in PAIR_CLASSES]
        names.append(f"{attribute}.moran")
    for first, second in combinations(attributes, 2):
        names += [f"{first}_and_{second}.{number}" for number in JOINT]
    return names


def has_unit(column: str) -> bool:
    """Return whether a number has the unit of its image; the others only tell where the values lie."""
    return column.rpartition(".")[2] in DISTRIBUTION


def inside_numbers(signature: Signature, attributes: Sequence[str]) -> dict[str, float]:
    """Return numbers by name that tell where in a body the values of its attributes lie, see `column_names`.

    NaN where a number is not defined: for a constant attribute, all that compares values with each other.

    Args:
        signature: meets `REQUIREMENTS`, and has the attributes at its interior samples.
        attributes: names of scalar attributes.

    Raises:
        ValueError: an attribute is missing, or has several values at a sample.
    """
    values = {name: _scalar_values(signature, name) for name in attributes}
    places = _Places.of(signature)
    numbers: dict[str, float] = dict.fromkeys(column_names(attributes), np.nan)
    for name, own in values.items():
        numbers |= _called(name, _numbers_of(own, places))
    for first, second in combinations(attributes, 2):
        numbers |= _called(f"{first}_and_{second}", _joint(values[first], values[second]))
    return numbers


def _called(prefix: str, numbers: Mapping[str, float]) -> dict[str, float]:
    """Return numbers with a prefix to their names."""
    return {f"{prefix}.{name}": number for name, number in numbers.items()}


def _scalar_values(signature: Signature, name: str) -> Floats:
    """Return the values (P,) of an attribute at the interior samples."""
    found = signature.interior.attributes.get(name)
    if found is None:
        known = ", ".join(sorted(signature.interior.attributes))
        raise ValueError(
            f"{signature.name}: attributes: expected {name!r}, got {known or 'none'}. Add it to the signature."
        )
    columns = found.reshape(len(found), -1)
    if columns.shape[1] != 1:
        raise ValueError(
            f"{signature.name}: {name}: expected one value at each sample, got {columns.shape[1]}. "
            "Give each component as an attribute of its own."
        )
    return columns[:, 0].astype(np.float64)


@dataclass(frozen=True, eq=False)
class _Places:
    """What the body itself gives at its P interior samples."""

    classes: Mapping[str, Booleans]  # by name, (P,): a third of the samples each
    axes: Sequence[Floats]  # modes (P, m) of each axis, of mean 0
    pairs: Mapping[str, tuple[Integers, Integers]]  # by class, the two samples of each pair

    @staticmethod
    def of(signature: Signature) -> "_Places":
        samples = signature.interior
        embedded = np.asarray(samples.eigenfunctions / np.sqrt(signature.eigenvalues))
        potential = np.square(embedded).sum(axis=1)
        depth = samples.attributes["depth"]
        classes = _thirds(potential, BY_POTENTIAL) | _thirds(depth, BY_DEPTH)
        axes = []
        for modes in _axes(signature.eigenvalues):
            values = samples.eigenfunctions[:, modes]
            centred = values - values.mean(axis=0)
            axes.append(centred.astype(np.float64))
        # At equal steps in the order of the samples, which depends on the shape alone
        n_paired = min(_N_PAIRED, len(samples))
        paired = np.arange(n_paired) * len(samples) // n_paired
        return _Places(classes, axes, _pair_classes(embedded, paired))


def _thirds(values: Floats | Singles, names: Sequence[str]) -> dict[str, Booleans]:
    """Return the samples with the lowest, middle and highest third of values, by name."""
    ranks = np.empty(len(values), dtype=np.int64)
    ranks[np.argsort(values, kind="stable")] = np.arange(len(values))
    third = ranks * len(names) // len(values)
    return {name: third == i for i, name in enumerate(names)}


def _axes(eigenvalues: Floats) -> list[list[int]]:
    """Return the modes of each axis; modes of nearly equal eigenvalues, in which no basis is special, share one."""
    axes = [[0]]
    for mode in range(1, len(eigenvalues)):
        if eigenvalues[mode] < _SAME_MODE * eigenvalues[mode - 1]:
            axes[-1].append(mode)
        elif len(axes) == N_AXES:
            break
        else:
            axes.append([mode])
    return axes


def _pair_classes(embedded: Floats, chosen: Integers) -> dict[str, tuple[Integers, Integers]]:
    """Return the pairs of chosen samples at small, middle and large interior distance, by name."""
    distances = pdist(embedded[chosen])
    bounds = np.quantile(distances, _PAIR_SHARES)
    number = np.searchsorted(bounds, distances)
    first, second = np.triu_indices(len(chosen), 1)  # the order of `pdist`
    pairs = {}
    for i, name in enumerate(PAIR_CLASSES):
        own = np.flatnonzero(number == i)
        pairs[name] = chosen[first[own]], chosen[second[own]]
    return pairs


def _numbers_of(values: Floats, places: _Places) -> dict[str, float]:
    numbers = _distribution(values)
    for name, members in places.classes.items():
        numbers |= _called(name, _distribution(values[members]))
    if is_constant(values):
        return numbers
    sd = values.std()
    bright = brightest(values)
    for name, members in places.classes.items():
        difference = values[members].mean() - values[~members].mean()
        numbers[f"{name}.contrast"] = difference / sd
        numbers[f"{name}.bright"] = bright[members].sum() / bright.sum()
    for i, modes in enumerate(places.axes, start=1):
        numbers[f"axis{i}.correlation"] = _multiple_correlation(values, modes)
        distance = np.linalg.norm(modes, axis=1)
        numbers[f"axis{i}.outward"] = _correlation(values, distance)
    return numbers | _spatial(values, places)


def is_constant(values: Floats) -> bool:
    """Return whether values (P,) differ by no more than rounding."""
    return bool(values.std() <= _CONSTANT * np.abs(values).max())


def _distribution(values: Floats) -> dict[str, float]:
    low, median, high = np.quantile(values, (0.1, 0.5, 0.9))
    numbers = (values.mean(), values.std(), low, median, high)
    return dict(zip(DISTRIBUTION, map(float, numbers), strict=True))


def brightest(values: Floats) -> Floats:
    """Return how far each of P samples counts among the brightest tenth, 0 to 1; equal values count equally."""
    n_wanted = _BRIGHT * len(values)
    n_below = len(values) - int(np.ceil(n_wanted))
    limit = np.sort(values)[n_below]
    is_above = values > limit
    is_equal = values == limit
    share = (n_wanted - is_above.sum()) / is_equal.sum()
    return is_above + share * is_equal


def _correlation(a: Floats, b: Floats) -> float:
    """Return Pearson's coefficient; NaN if one of both is constant."""
    if is_constant(a) or is_constant(b):
        return np.nan
    return float(np.corrcoef(a, b)[0, 1])


def _multiple_correlation(values: Floats, modes: Floats) -> float:
    """Return the coefficient, 0 to 1, of the best linear prediction of values (P,) by modes (P, m) of mean 0."""
    centred = values - values.mean()
    weights, *_ = np.linalg.lstsq(modes, centred, rcond=None)
    explained = np.linalg.norm(modes @ weights) / np.linalg.norm(centred)
    return min(float(explained), 1.0)


def _spatial(values: Floats, places: _Places) -> dict[str, float]:
    """Return the variogram over the variance, and Moran's I of near pairs."""
    centred = values - values.mean()
    variance = np.square(centred).mean()
    numbers = {}
    for name, (first, second) in places.pairs.items():
        steps = values[first] - values[second]
        half_square = 0.5 * np.square(steps).mean()
        numbers[f"variogram.{name}"] = float(half_square / variance)
    near = places.pairs[PAIR_CLASSES[0]]
    numbers["moran"] = _moran(centred, *near)
    return numbers


def _moran(centred: Floats, first: Integers, second: Integers) -> float:
    """Return Moran's I of values (P,) of mean 0: the weights of the neighbours of each sample add up to 1."""
    one = np.concatenate([first, second])
    other = np.concatenate([second, first])
    n_neighbours = np.bincount(one, minlength=len(centred))
    sums = np.bincount(one, weights=centred[other], minlength=len(centred))
    own = n_neighbours > 0
    products = centred[own] * sums[own] / n_neighbours[own]
    return float(products.sum() / np.square(centred[own]).sum())


def _joint(a: Floats, b: Floats) -> dict[str, float]:
    """Return how the values of two attributes at the same samples go together; nothing if one is constant."""
    if is_constant(a) or is_constant(b):
        return {}
    n_bright = np.minimum(brightest(a), brightest(b)).sum()
    return {
        "correlation": _correlation(a, b),
        "rank_correlation": _correlation(rankdata(a), rankdata(b)),
        "overlap": float(n_bright / (_BRIGHT * len(a))),
        "information": _information(_quarters(a), _quarters(b)),
    }


def _quarters(values: Floats) -> Integers:
    bounds = np.quantile(values, np.arange(1, _N_QUARTERS) / _N_QUARTERS)
    return np.searchsorted(bounds, values, side="left")


def _information(a: Integers, b: Integers) -> float:
    """Return the mutual information of two classifications, in bits."""
    table = np.zeros((_N_QUARTERS, _N_QUARTERS))
    np.add.at(table, (a, b), 1 / len(a))
    independent = np.outer(table.sum(axis=1), table.sum(axis=0))
    present = table > 0
    shares = table[present]
    bits = np.log2(shares / independent[present])
    return float((shares * bits).sum())
