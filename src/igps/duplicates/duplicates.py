"""Files that show the same body, whatever its scale, mirror image, triangulation, level of detail or file format.

Two surfaces are aligned. The distance that remains tells the same shape from another pose and from a similar body (see
`igps.duplicates.surfaces`). Only candidate pairs are aligned: those whose moments allow a small distance.
"""

import math
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from scipy.cluster.hierarchy import DisjointSet

from igps._parallel import on_threads
from igps._progress import Progress
from igps.data.dataset import Failure, SignatureDataset
from igps.descriptors.size_and_side import Size, keeps_size
from igps.duplicates._near_pairs import NearPairs, near_pairs, of_one_size
from igps.duplicates.calibration import Calibration
from igps.duplicates.grouping import Pairs, assigned, groups_of
from igps.duplicates.surfaces import Grade, Surfaces

_BATCH_SIZE = 256  # pairs that are aligned at once
# Candidates are pairs whose `distance_bounds` are below this many times the limit. The bounds hold to first order only,
# and details that cancel in a distance of surfaces do not cancel in moments: copies reached 1.3 times the limit.
_CANDIDATE_FACTOR = 2.0


@dataclass(frozen=True)
class Duplicates:
    """Groups of files that show the same body."""

    # Sorted names of at least two files each. Every file is a copy of another file of its group, preferably the finest
    groups: tuple[tuple[str, ...], ...]
    paths: dict[str, Path]  # of the files in groups, by name
    # The pairs that form the groups, with the distance of their surfaces over √area
    pairs: dict[tuple[str, str], float]
    grades: dict[tuple[str, str], Grade]  # of these pairs
    # Largest deviation of these pairs, from a sample of one surface to the other: over √area, as a length, and the unit
    # of the length if known
    largest: dict[tuple[str, str], tuple[float, float, str | None]]
    mirrored: frozenset[tuple[str, str]]  # of these pairs; the others agree without a reflection
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
    if keeps_size(size, dataset.units())[0]:
        near = of_one_size(near, dataset)
    surfaces = Surfaces(dataset)
    joined = _regroup(_join(near, surfaces, work), surfaces, work)
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
    groups = groups_of(joined)
    grades: dict[tuple[str, str], Grade] = {}
    largest: dict[tuple[str, str], tuple[float, float, str | None]] = {}
    graded = on_threads(lambda pair: surfaces.grade(*pair), list(joined), work.n_workers)
    sides = on_threads(lambda pair: surfaces.is_mirrored(*pair), list(joined), work.n_workers)
    mirrored = frozenset(
        (names[i], names[j])
        for (i, j), is_mirrored in zip(joined, sides, strict=True)
        if is_mirrored
    )
    for (i, j), (grade, deviation) in zip(joined, graded, strict=True):
        pair = names[i], names[j]
        length, unit = surfaces.length(i)
        grades[pair] = grade
        largest[pair] = (deviation, deviation * length, unit)
    return Duplicates(
        groups=tuple(tuple(names[i] for i in group) for group in groups),
        paths={names[i]: dataset.bodies.paths[i] for group in groups for i in group},
        pairs={(names[i], names[j]): distance for (i, j), distance in joined.items()},
        grades=grades,
        largest=largest,
        mirrored=mirrored,
        n_files=len(dataset),
        failures=tuple(failures),
    )


def _join(near: NearPairs, surfaces: Surfaces, work: _Work) -> Pairs:
    """Return the candidate pairs that are the same, as a spanning forest: pairs within a group are skipped."""
    group = DisjointSet()
    joined: Pairs = {}
    while batch := list(islice(near, _BATCH_SIZE)):
        for i, j in batch:
            group.add(i)
            group.add(j)
        pairs = [pair for pair in batch if not group.connected(*pair)]
        distances = on_threads(
            lambda pair: surfaces.distance(*pair, work.calibration), pairs, work.n_workers
        )
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
    reassigned = {i for members in large for i in members}
    final = {pair: distance for pair, distance in joined.items() if reassigned.isdisjoint(pair)}
    regrouped = on_threads(
        lambda members: assigned(members, surfaces, work.calibration), large, work.n_workers
    )
    for pairs in Progress(regrouped, desc="groups", total=len(large), disable=not work.progress):
        final |= pairs
    return final
