"""Files that show the same body, whatever its scale, mirror image, triangulation, level of detail or file format.

Two surfaces are aligned. The distance that remains tells the same shape from another pose and from a similar body (see
`igps.duplicates.surfaces`). Only candidate pairs are aligned: those whose moments allow a small distance or, in a
gallery, those with near descriptions.
"""

import math
from dataclasses import dataclass
from itertools import islice
from operator import itemgetter
from pathlib import Path

import numpy as np
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
from igps.duplicates.surfaces import Grade, Surfaces
from igps.gallery.gallery import Gallery
from igps.nn.description import describe
from igps.nn.descriptor import Descriptor

_BATCH_SIZE = 256  # pairs that are aligned at once
# Candidates are pairs whose `distance_bounds` are below this many times the limit. The bounds hold to first order only,
# and details that cancel in a distance of surfaces do not cancel in moments: copies reached 1.3 times the limit.
_CANDIDATE_FACTOR = 2.0

_Pairs = dict[tuple[int, int], float]


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
    nearly: dict[
        tuple[str, str], float
    ]  # distances over √area of pairs that are not copies, but within the tolerance
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


def duplicates(  # noqa: PLR0913 (a source, and settings that all have a default)
    source: SignatureDataset | Gallery,
    descriptor: str | Descriptor = "pretrained",
    *,
    poses: bool = False,
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
        descriptor: a calibrated descriptor; ignored for a gallery, which has its own.
        poses: whether other poses of a body count as the same body. Then only descriptions are compared, which finds
            more false pairs.
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
    calibration = calibration or Calibration.load()
    failures: list[Failure] = []
    if isinstance(source, Gallery):
        calibration.check(source.about["descriptor"], source.descriptor, source.config)
        chosen, dataset = source.descriptor, _files_of(source, cache_dir)
        near = near_in_gallery(
            source, calibration.pose.distance if poses else calibration.near, progress
        )
    else:
        chosen = descriptor_of(descriptor)
        calibration.check(descriptor, chosen, source.config)
        if poses:
            descriptions = describe(
                source, chosen, failures=failures, n_workers=n_workers, progress=progress
            )
            near = near_pairs(descriptions, chosen.distances, calibration.pose.distance, progress)
        else:
            limit = max(calibration.same.distance, tolerance)
            moments, failures = Surfaces(source).moments(limit, n_workers, progress)
            near = near_pairs(moments, distance_bounds, _CANDIDATE_FACTOR * limit, progress)
        dataset = source.usable(failures)
    if keeps_size(size, dataset.units())[0]:
        near = of_one_size(near, dataset)
    surfaces = None if poses else Surfaces(dataset, tolerance)
    joined = _join(near, surfaces, calibration, n_workers, progress)
    if surfaces is not None:
        joined = _regroup(joined, surfaces, calibration, n_workers, progress)
        failures = [*failures, *surfaces.failures.values()]
    names, groups = dataset.bodies.names, _groups(joined)
    grades: dict[tuple[str, str], Grade] = {}
    largest: dict[tuple[str, str], tuple[float, float, str | None]] = {}
    nearly: dict[tuple[str, str], float] = {}
    if surfaces is not None:
        graded = on_threads(lambda pair: surfaces.grade(*pair), list(joined), n_workers)
        for (i, j), (grade, deviation) in zip(joined, graded, strict=True):
            length, unit = surfaces.length(i)
            grades[names[i], names[j]], largest[names[i], names[j]] = (
                grade,
                (deviation, deviation * length, unit),
            )
        group_of = {i: number for number, group in enumerate(groups) for i in group}
        for (i, j), distance in sorted(surfaces.nearly.items()):
            if group_of.get(i, -1 - i) != group_of.get(j, -1 - j):
                nearly[names[i], names[j]] = distance
    return Duplicates(
        tuple(tuple(names[i] for i in group) for group in groups),
        {names[i]: dataset.bodies.paths[i] for group in groups for i in group},
        {(names[i], names[j]): distance for (i, j), distance in joined.items()},
        grades,
        largest,
        nearly,
        len(dataset),
        tuple(failures),
    )


def _join(
    near: NearPairs,
    surfaces: Surfaces | None,
    calibration: Calibration,
    n_workers: int | None,
    progress: bool,
) -> _Pairs:
    """Return the candidate pairs that are the same, as a spanning forest: pairs that a group has already are skipped.

    Pairs are compared by their surfaces; if `surfaces` is None, all candidates count as the same.
    """
    group = DisjointSet()
    joined: _Pairs = {}
    while batch := list(islice(near, _BATCH_SIZE)):
        for i, j, _ in batch:
            group.add(i)
            group.add(j)
        open_pairs = [(i, j, distance) for i, j, distance in batch if not group.connected(i, j)]
        if surfaces is None:
            distances = iter([distance for _, _, distance in open_pairs])
        else:
            aligned = on_threads(
                lambda pair: surfaces.distance(*pair[:2], calibration), open_pairs, n_workers
            )
            distances = iter(
                tqdm(
                    aligned,
                    desc="aligned",
                    total=len(open_pairs),
                    leave=False,
                    disable=not progress,
                )
            )
        for (i, j, _), distance in zip(open_pairs, distances, strict=True):
            if distance < math.inf and group.merge(i, j):
                joined[i, j] = distance
    return joined


def _regroup(
    joined: _Pairs,
    surfaces: Surfaces,
    calibration: Calibration,
    n_workers: int | None,
    progress: bool,
) -> _Pairs:
    """Split groups that a coarse file has merged, and return the pairs that form the new groups, with distances.

    A file that is too coarse to show a detail is the same as two bodies that differ in the detail. So the files of a
    group are assigned again, finest first: each joins the nearest leader of a group that is the same; otherwise the
    nearest other file that is the same; otherwise it is the leader of a new group. No file joins two groups.
    """

    def pairs_of(members: list[int]) -> _Pairs:
        leaders: list[int] = []
        followers: list[int] = []
        pairs: _Pairs = {}
        for i in sorted(members, key=lambda member: (surfaces.coarseness(member), member)):
            for finer in (leaders, followers):
                distances = [surfaces.distance(j, i, calibration) for j in finer]
                if min(distances, default=math.inf) < math.inf:
                    pairs[finer[int(np.argmin(distances))], i] = min(distances)
                    followers.append(i)
                    break
            else:
                leaders.append(i)
        return pairs

    large = [members for members in _groups(joined) if len(members) > 2]
    reassigned = {i for members in large for i in members}
    final = {pair: distance for pair, distance in joined.items() if reassigned.isdisjoint(pair)}
    for pairs in tqdm(
        on_threads(pairs_of, large, n_workers),
        desc="groups",
        total=len(large),
        disable=not progress,
    ):
        final |= pairs
    return final


def _groups(joined: _Pairs) -> list[list[int]]:
    """Return the sorted connected components of the pairs."""
    group = DisjointSet({i for pair in joined for i in pair})
    for i, j in joined:
        group.merge(i, j)
    return sorted(sorted(members) for members in group.subsets())


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
    calibration, chosen = calibration or Calibration.load(), descriptor_of(descriptor)
    calibration.check(descriptor, chosen, dataset.config)
    descriptions = describe(dataset, chosen, n_workers=1, progress=progress)
    with torch.inference_mode():
        distance = float(chosen.distances(descriptions[:1], descriptions[1:]))
    surfaces = Surfaces(dataset)
    between, limit = (
        surface_distance(*map(surfaces.samples, range(2))),
        surfaces.limit(0, 1, calibration),
    )
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
