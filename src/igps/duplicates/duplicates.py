"""Files that show the same body, whatever its scale, mirror image, triangulation, level of detail or file format.

Two surfaces are aligned. The distance that remains tells the same shape from another pose and from a similar body (see
`igps.duplicates.compared_surfaces`). Only candidate pairs are aligned: those whose moments allow a small distance.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import islice
from pathlib import Path

import torch
from scipy.cluster.hierarchy import DisjointSet
from torch import Tensor

from igps._parallel import on_threads
from igps._progress import Progress
from igps.data.dataset import Failure, SignatureDataset
from igps.descriptors.size_and_side import Size, keeps_size
from igps.duplicates._moments import distance_bounds
from igps.duplicates.calibration import Calibration
from igps.duplicates.compared_surfaces import Grade, Surfaces
from igps.mesh.mesh import millimetres

_BATCH_SIZE = 256  # pairs that are aligned at once
# Candidates are pairs whose `distance_bounds` are below this many times the limit. The bounds hold to first order only,
# and details that cancel in a distance of surfaces do not cancel in moments: copies reached 1.3 times the limit.
_CANDIDATE_FACTOR = 2.0

_ROWS = 256  # of the matrix of bounds in memory at once
# Bodies of one size differ by less in the logarithm of √area; levels of detail of a body differ by up to half of this
_SIZE_TOLERANCE = 0.05

NearPairs = Iterator[tuple[int, int]]  # indices i < j
Pairs = dict[tuple[int, int], float]
"""Distances of pairs of files, by their indices."""


@dataclass(frozen=True)
class Copy:
    """Two files of one body."""

    names: tuple[str, str]
    distance: float  # of their surfaces, over √area
    grade: Grade
    deviation: float  # the largest, from a sample of one surface to the other, over √area
    largest_length: float  # the same as a length
    unit: str | None  # of the length, if known
    is_mirrored: bool  # the files agree by a reflection alone


@dataclass(frozen=True)
class Duplicates:
    """Groups of files that show the same body."""

    # Sorted names of at least two files each. Every file is a copy of another file of its group, preferably the finest
    groups: tuple[tuple[str, ...], ...]
    paths: dict[str, Path]  # of the files in groups, by name
    copies: tuple[Copy, ...]  # the pairs that form the groups
    n_files: int  # that were compared
    failures: tuple[Failure, ...]  # files that could not be compared


@dataclass(frozen=True)
class _Work:
    """How pairs are compared."""

    calibration: Calibration
    n_workers: int | None
    progress: bool


def duplicates(
    dataset: SignatureDataset,
    *,
    size: Size = "auto",
    calibration: Calibration | None = None,
    n_workers: int | None = None,
    progress: bool = False,
) -> Duplicates:
    """Find groups of files that show the same body in the same shape.

    Args:
        dataset: the files.
        size: whether bodies of different size are different, see `keeps_size`.
        calibration: of the distances; the built-in calibration if None.
        n_workers: threads; all cores if None.
        progress: show progress bars.

    Raises:
        ValueError: the calibration belongs to other Signatures.
        MeshError: none of the meshes can be described.
    """
    work = _Work(calibration or Calibration.load(), n_workers, progress)
    work.calibration.check_signatures(dataset.config)
    limit = work.calibration.same.distance
    moments, failures = Surfaces(dataset).moments(limit, n_workers, progress)
    near = near_pairs(moments, _CANDIDATE_FACTOR * limit, progress)
    dataset = dataset.usable(failures)
    is_size_kept, _ = keeps_size(size, dataset.units())
    if is_size_kept:
        near = of_one_size(near, dataset)
    surfaces = Surfaces(dataset)
    joined = _join(near, surfaces, work)
    joined = _regroup(joined, surfaces, work)
    return _graded(dataset, joined, surfaces, [*failures, *surfaces.failures.values()], work)


def _graded(
    dataset: SignatureDataset,
    joined: Pairs,
    surfaces: Surfaces,
    failures: list[Failure],
    work: _Work,
) -> Duplicates:
    """Return the groups that the pairs form, by the names of the bodies, with the grades of the pairs."""
    names = dataset.bodies.names
    pairs = list(joined)
    graded = on_threads(lambda pair: surfaces.grade(*pair), pairs, work.n_workers)
    mirrored = on_threads(lambda pair: surfaces.is_mirrored(*pair), pairs, work.n_workers)
    copies = []
    for (i, j), (grade, deviation), is_mirrored in zip(pairs, graded, mirrored, strict=True):
        length, unit = surfaces.length(i)
        copies.append(
            Copy(
                names=(names[i], names[j]),
                distance=joined[i, j],
                grade=grade,
                deviation=deviation,
                largest_length=deviation * length,
                unit=unit,
                is_mirrored=is_mirrored,
            )
        )
    groups = []
    paths = {}
    for members in groups_of(joined):
        groups.append(tuple(names[i] for i in members))
        for i in members:
            paths[names[i]] = dataset.bodies.paths[i]
    return Duplicates(
        groups=tuple(groups),
        paths=paths,
        copies=tuple(copies),
        n_files=len(dataset),
        failures=tuple(failures),
    )


def near_pairs(moments: Tensor, limit: float, progress: bool) -> NearPairs:
    """Yield the pairs i < j of bodies whose distance may be at most the limit, by their `moments` (N, 7, 6)."""
    with Progress(desc="compared", total=len(moments), disable=not progress) as bar:
        for start in range(0, len(moments), _ROWS):
            rows = moments[start : start + _ROWS]
            with torch.inference_mode():
                bounds = distance_bounds(rows, moments[start:])
            for i, j in torch.nonzero(bounds <= limit).tolist():
                if i < j:
                    yield start + i, start + j
            bar.update(len(rows))


def of_one_size(near: NearPairs, dataset: SignatureDataset) -> NearPairs:
    """Yield the pairs whose bodies have the same size."""

    @cache
    def log_length(i: int) -> float:
        signature = dataset[i].signature
        return math.log(signature.area) / 2 + math.log(millimetres(signature.unit))

    for i, j in near:
        if abs(log_length(i) - log_length(j)) < _SIZE_TOLERANCE:
            yield i, j


def _join(near: NearPairs, surfaces: Surfaces, work: _Work) -> Pairs:
    """Return the candidate pairs that are the same, as a spanning forest: pairs within a group are skipped."""

    def distance_of(pair: tuple[int, int]) -> float:
        return surfaces.distance(*pair, work.calibration)

    group = DisjointSet()
    joined: Pairs = {}
    while batch := list(islice(near, _BATCH_SIZE)):
        for i, j in batch:
            group.add(i)
            group.add(j)
        pairs = [pair for pair in batch if not group.connected(*pair)]
        distances = on_threads(distance_of, pairs, work.n_workers)
        bar = Progress(distances, desc="aligned", total=len(pairs), disable=not work.progress)
        for (i, j), distance in zip(pairs, bar, strict=True):
            if distance < math.inf and group.merge(i, j):
                joined[i, j] = distance
    return joined


def _regroup(joined: Pairs, surfaces: Surfaces, work: _Work) -> Pairs:
    """Split groups that a coarse file has merged, and return the pairs that form the new groups, with distances.

    A file that is too coarse to show a detail is the same as two bodies that differ in the detail. So the files of a
    group are assigned again, see `assigned`. No file joins two groups.
    """
    large = [members for members in groups_of(joined) if len(members) > 2]
    reassigned = set[int]().union(*large)
    final = {pair: distance for pair, distance in joined.items() if reassigned.isdisjoint(pair)}

    def assigned_again(members: list[int]) -> Pairs:
        return assigned(members, surfaces, work.calibration)

    regrouped = on_threads(assigned_again, large, work.n_workers)
    for pairs in Progress(regrouped, desc="groups", total=len(large), disable=not work.progress):
        final |= pairs
    return final


def assigned(members: list[int], surfaces: Surfaces, calibration: Calibration) -> Pairs:
    """Assign the files of a group, finest first, and return the pairs of a file and the finer one that it joins.

    Each file joins the nearest leader of a group that is the same; otherwise the nearest other file that is the same;
    otherwise it is the leader of a new group.
    """
    leaders: list[int] = []
    followers: list[int] = []
    pairs: Pairs = {}
    for i in sorted(members, key=lambda member: (surfaces.coarseness(member), member)):
        for finer in (leaders, followers):
            distances = [surfaces.distance(j, i, calibration) for j in finer]
            nearest = min(distances, default=math.inf)
            if nearest < math.inf:
                pairs[finer[distances.index(nearest)], i] = nearest
                followers.append(i)
                break
        else:
            leaders.append(i)
    return pairs


def groups_of(joined: Pairs) -> list[list[int]]:
    """Return the sorted connected components of the pairs."""
    group = DisjointSet({i for pair in joined for i in pair})
    for i, j in joined:
        group.merge(i, j)
    return sorted(sorted(members) for members in group.subsets())
