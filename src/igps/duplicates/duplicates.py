"""Files that show the same body, whatever its scale, mirror image, triangulation, level of detail or file format.

Two surfaces are aligned. The distance that remains tells the same shape from another pose and from a similar body (see
`igps.duplicates.surfaces`). Only candidate pairs are aligned: those whose moments allow a small distance or, in a
gallery, those with near descriptions.
"""

import math
from dataclasses import dataclass, replace
from itertools import islice
from operator import itemgetter
from pathlib import Path

import torch
from scipy.cluster.hierarchy import DisjointSet
from tqdm import tqdm

from igps._parallel import on_threads
from igps.data.dataset import Failure, SignatureDataset
from igps.data.sources import Bodies
from igps.descriptors import descriptor as descriptor_of
from igps.descriptors.size_and_side import Size, keeps_size
from igps.duplicates._alignment import surface_distance
from igps.duplicates._moments import distance_bounds
from igps.duplicates._near_pairs import NearPairs, near_in_gallery, near_pairs, of_one_size
from igps.duplicates.calibration import Calibration
from igps.duplicates.grouping import Pairs, assigned, groups_of
from igps.duplicates.surfaces import Grade, Surfaces
from igps.gallery.gallery import Gallery
from igps.nn.description import describe
from igps.nn.descriptor import Descriptor

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
    # The pairs that form the groups, with the distance of their surfaces over √area, or of their descriptions for poses
    pairs: dict[tuple[str, str], float]
    grades: dict[tuple[str, str], Grade]  # of these pairs; empty for poses
    # Largest deviation of these pairs, from a sample of one surface to the other: over √area, as a length, and the unit
    # of the length if known
    largest: dict[tuple[str, str], tuple[float, float, str | None]]
    mirrored: frozenset[tuple[str, str]]  # of these pairs; the others agree without a reflection
    # Distances over √area of pairs that are not copies, but within the tolerance
    nearly: dict[tuple[str, str], float]
    n_files: int  # that were compared
    failures: tuple[Failure, ...]  # files that could not be compared


@dataclass(frozen=True)
class BodyDistance:
    """The distance between two bodies, and its meaning."""

    distance: float  # by the descriptor
    surfaces: float  # of the aligned surfaces: root mean square over √area
    limit: float  # largest such distance of bodies of the same shape, see `Surfaces.limit`
    meaning: str  # of the descriptor's distance, in words
    same: bool  # whether the bodies have the same shape


@dataclass(frozen=True)
class _Work:
    """How pairs are compared."""

    calibration: Calibration
    n_workers: int | None
    progress: bool


def duplicates(
    source: SignatureDataset | Gallery,
    *,
    size: Size = "auto",
    tolerance: float = 0.0,
    cache_dir: str | Path | None = None,
    calibration: Calibration | None = None,
    n_workers: int | None = None,
    progress: bool = False,
) -> Duplicates:
    """Find groups of files that show the same body in the same shape.

    Args:
        source: the files, or a gallery of them. A gallery finds candidate pairs without comparing all pairs, and only
            the files of candidates are read again, unless their Signatures are cached.
        size: whether bodies of different size are different, see `keeps_size`.
        tolerance: distance over √area, up to 0.02. Pairs of different bodies within it are returned as `nearly`; in a
            gallery only those with near descriptions.
        cache_dir: cache of Signatures for a gallery; the user's cache directory if None.
        calibration: calibration of the descriptor; the built-in calibration if None.
        n_workers: threads; all cores if None.
        progress: show progress bars.

    Raises:
        ValueError: the calibration belongs to another descriptor, or the tolerance is out of range.
        MeshError: none of the meshes can be described.
    """
    work = _Work(calibration or Calibration.load(), n_workers, progress)
    failures: list[Failure] = []
    if isinstance(source, Gallery):
        _check_gallery(source, work.calibration)
        dataset = _files_of(source, cache_dir)
        near = near_in_gallery(source, work.calibration.near, progress)
    else:
        work.calibration.check_signatures(source.config)
        limit = max(work.calibration.same.distance, tolerance)
        moments, failures = Surfaces(source).moments(limit, n_workers, progress)
        near = near_pairs(moments, distance_bounds, _CANDIDATE_FACTOR * limit, progress)
        dataset = source.usable(failures)
    if keeps_size(size, dataset.units())[0]:
        near = of_one_size(near, dataset)
    surfaces = Surfaces(dataset, tolerance)
    joined = _regroup(_join(near, surfaces, work), surfaces, work)
    found = _found(dataset, joined, [*failures, *surfaces.failures.values()])
    return _with_grades(found, joined, surfaces, work)


def pose_duplicates(
    source: SignatureDataset | Gallery,
    descriptor: str | Descriptor = "pretrained",
    *,
    size: Size = "auto",
    cache_dir: str | Path | None = None,
    calibration: Calibration | None = None,
    n_workers: int | None = None,
    progress: bool = False,
) -> Duplicates:
    """Find groups of files that show the same body in the same or another pose.

    Only descriptions are compared, which finds more false pairs than `duplicates`. The descriptor is calibrated; that
    of a gallery is its own. For the other arguments and the errors see `duplicates`.
    """
    work = _Work(calibration or Calibration.load(), n_workers, progress)
    limit = work.calibration.pose.distance
    failures: list[Failure] = []
    if isinstance(source, Gallery):
        _check_gallery(source, work.calibration)
        dataset = _files_of(source, cache_dir)
        near = near_in_gallery(source, limit, progress)
    else:
        chosen = descriptor_of(descriptor)
        work.calibration.check(descriptor, chosen, source.config)
        descriptions = describe(
            source, chosen, failures=failures, n_workers=n_workers, progress=progress
        )
        near = near_pairs(descriptions, chosen.distances, limit, progress)
        dataset = source.usable(failures)
    if keeps_size(size, dataset.units())[0]:
        near = of_one_size(near, dataset)
    return _found(dataset, _join(near, None, work), failures)


def _check_gallery(gallery: Gallery, calibration: Calibration) -> None:
    calibration.check(gallery.about["descriptor"], gallery.descriptor, gallery.config)


def _found(dataset: SignatureDataset, joined: Pairs, failures: list[Failure]) -> Duplicates:
    """Return the groups that the pairs form, by the names of the bodies."""
    names = dataset.bodies.names
    groups = groups_of(joined)
    return Duplicates(
        groups=tuple(tuple(names[i] for i in group) for group in groups),
        paths={names[i]: dataset.bodies.paths[i] for group in groups for i in group},
        pairs={(names[i], names[j]): distance for (i, j), distance in joined.items()},
        grades={},
        largest={},
        mirrored=frozenset(),
        nearly={},
        n_files=len(dataset),
        failures=tuple(failures),
    )


def _with_grades(found: Duplicates, joined: Pairs, surfaces: Surfaces, work: _Work) -> Duplicates:
    """Return the groups with the grades of their pairs, and the pairs that are nearly the same."""
    names = surfaces.names
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
    group_of = {name: group for group in found.groups for name in group}
    nearly: dict[tuple[str, str], float] = {}
    for (i, j), distance in sorted(surfaces.nearly.items()):
        one = group_of.get(names[i])
        other = group_of.get(names[j])
        if one is None or one != other:
            nearly[names[i], names[j]] = distance
    return replace(found, grades=grades, largest=largest, mirrored=mirrored, nearly=nearly)


def _join(near: NearPairs, surfaces: Surfaces | None, work: _Work) -> Pairs:
    """Return the candidate pairs that are the same, as a spanning forest: pairs that a group has already are skipped.

    Pairs are compared by their surfaces; if `surfaces` is None, all candidates count as the same.
    """
    group = DisjointSet()
    joined: Pairs = {}
    while batch := list(islice(near, _BATCH_SIZE)):
        for i, j, _ in batch:
            group.add(i)
            group.add(j)
        pairs = [(i, j, distance) for i, j, distance in batch if not group.connected(i, j)]
        distances = [distance for _, _, distance in pairs]
        if surfaces is not None:
            distances = _aligned(pairs, surfaces, work)
        for (i, j, _), distance in zip(pairs, distances, strict=True):
            if distance < math.inf and group.merge(i, j):
                joined[i, j] = distance
    return joined


def _aligned(pairs: list[tuple[int, int, float]], surfaces: Surfaces, work: _Work) -> list[float]:
    """Return the distances of the aligned surfaces of the pairs."""
    distances = on_threads(
        lambda pair: surfaces.distance(*pair[:2], work.calibration), pairs, work.n_workers
    )
    bar = tqdm(distances, desc="aligned", total=len(pairs), leave=False, disable=not work.progress)
    return list(bar)


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
    for pairs in tqdm(regrouped, desc="groups", total=len(large), disable=not work.progress):
        final |= pairs
    return final


def body_distance(
    dataset: SignatureDataset,
    descriptor: str | Descriptor = "pretrained",
    *,
    calibration: Calibration | None = None,
    progress: bool = False,
) -> BodyDistance:
    """Return the distance between the two bodies of a dataset, and its meaning. For the arguments see `duplicates`.

    Raises:
        ValueError: the dataset does not have two bodies, or the calibration belongs to another descriptor.
        MeshError: a mesh cannot be used.
    """
    if len(dataset) != 2:
        names = ", ".join(dataset.bodies.names[:4])
        raise ValueError(
            f"dataset: expected two meshes to compare, got {len(dataset)}: {names}. Name a part of a file as FILE#PART."
        )
    calibration = calibration or Calibration.load()
    chosen = descriptor_of(descriptor)
    calibration.check(descriptor, chosen, dataset.config)
    descriptions = describe(dataset, chosen, n_workers=1, progress=progress)
    with torch.inference_mode():
        distance = float(chosen.distances(descriptions[:1], descriptions[1:]))
    surfaces = Surfaces(dataset)
    between = surface_distance(surfaces.samples(0), surfaces.samples(1))
    limit = surfaces.limit(0, 1, calibration)
    return BodyDistance(distance, between, limit, calibration.words(distance), between <= limit)


def _files_of(gallery: Gallery, cache_dir: str | Path | None) -> SignatureDataset:
    """Return the bodies of a gallery as a dataset, sorted by id."""
    rows = sorted(gallery.rows("id", "name", "file", "part"), key=itemgetter("id"))
    names = tuple(row["name"] for row in rows)
    if len(set(names)) < len(names):  # from several folders
        names = tuple(row["id"] for row in rows)
    files = Bodies(
        tuple(Path(row["file"]) for row in rows), names, None, tuple(row["part"] for row in rows)
    )
    return SignatureDataset(files, gallery.config, cache_dir, reading=gallery.reading)
