"""Files that show the same body, whatever its scale, mirror image, triangulation, level of detail or file format.

Two surfaces are laid onto each other, which tells the same shape from another pose and from a sibling, see
`igps.gallery.surfaces`. Only those are laid whose moments allow that they are near, or in a gallery, whose
descriptions are. And no file joins two that are not the same as each other.
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
from igps.descriptors.individual import Size, keeps_size
from igps.gallery._alignment import surface_distance
from igps.gallery._moments import least_distances
from igps.gallery._near_pairs import NearPairs, near_in_gallery, near_pairs, of_one_size
from igps.gallery.calibration import Calibration
from igps.gallery.gallery import Gallery
from igps.gallery.surfaces import Grade, Surfaces
from igps.nn.description import describe
from igps.nn.descriptor import Descriptor

# Pairs whose surfaces are compared at once.
_PAIRS = 256
# `least_distances` knows the first order alone, and a distance averages over what thin wires lose all around: of
# copies that are found the former is up to 1.3 times the most that the latter may be.
_LEAST = 2.0

_Pairs = dict[tuple[int, int], float]


@dataclass(frozen=True)
class Duplicates:
    """Groups of files that show the same body."""

    # Names of at least two files each, in order; each is the same as some other of its group, by preference the finest
    groups: tuple[tuple[str, ...], ...]
    paths: dict[str, Path]  # of the files of the groups, by name
    # Those that make the groups, and how far apart: their surfaces over √area, or for poses their descriptions
    pairs: dict[tuple[str, str], float]
    grades: dict[tuple[str, str], Grade]  # of these pairs; none where poses are asked for
    # Of these pairs, how far the farthest sample of one surface is from the other: over √area, as a length, and its
    # unit if that is known
    largest: dict[tuple[str, str], tuple[float, float, str | None]]
    nearly: dict[tuple[str, str], float]  # those that are not the same, but as near as was tolerated, over √area
    n_files: int  # among which they were looked for
    failures: tuple[Failure, ...]  # files that could not be compared


@dataclass(frozen=True)
class BodyDistance:
    """How far two bodies are from each other, and what that means."""

    distance: float  # by the descriptor
    surfaces: float  # of their surfaces laid onto each other, root mean square over √area
    limit: float  # up to which they are of one shape, at their levels of detail; 0 as of `Surfaces.limit`
    meaning: str  # of the distance, in words
    same: bool  # whether they are the same body in the same shape


def duplicates(
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
    """Groups of files that show the same body in the same shape.

    Args:
        source: the files; or a gallery of them, whose near pairs are found without comparing all, and of which only the
            files of these are read again, if their Signatures are not cached.
        descriptor: a calibrated one; for a gallery its own.
        poses: whether other poses of a body count as the same; then nothing tells them from siblings but the distance
            of descriptions, and false pairs are more.
        size: whether files that differ in size are different, too, see `keeps_size`.
        tolerance: over √area, up to 0.02; pairs that are not the same and no farther apart are told as nearly so. In a
            gallery, of those whose descriptions are near.
        cache_dir: of Signatures, for a gallery; the user's cache directory if None.
        calibration: of the descriptor; the one that is shipped if None.
        n_workers: threads; all cores if None.

    Raises:
        ValueError: the calibration is of another descriptor, or the tolerance is out of range.
        MeshError: none of the meshes can be described.
    """
    calibration = calibration or Calibration.load()
    failures: list[Failure] = []
    if isinstance(source, Gallery):
        calibration.check(source.about["descriptor"], source.descriptor, source.config)
        chosen, dataset = source.descriptor, _files_of(source, cache_dir)
        near = near_in_gallery(source, calibration.pose.distance if poses else calibration.near, progress)
    else:
        chosen = descriptor_of(descriptor)
        calibration.check(descriptor, chosen, source.config)
        if poses:
            descriptions = describe(source, chosen, failures=failures, n_workers=n_workers, progress=progress)
            near = near_pairs(descriptions, chosen.distances, calibration.pose.distance, progress)
        else:
            most = max(calibration.same.distance, tolerance)
            moments, failures = Surfaces(source).moments(most, n_workers, progress)
            near = near_pairs(moments, least_distances, _LEAST * most, progress)
        dataset = source.usable(failures)
    if keeps_size(size, dataset.units())[0]:
        near = of_one_size(near, dataset)
    surfaces = None if poses else Surfaces(dataset, tolerance)
    joined = _joined(near, surfaces, calibration, n_workers, progress)
    if surfaces is not None:
        joined = _around_the_finest(joined, surfaces, calibration, n_workers, progress)
        failures = [*failures, *surfaces.failures.values()]
    names, groups = dataset.bodies.names, _groups(joined)
    grades: dict[tuple[str, str], Grade] = {}
    largest: dict[tuple[str, str], tuple[float, float, str | None]] = {}
    nearly: dict[tuple[str, str], float] = {}
    if surfaces is not None:
        found = on_threads(lambda pair: surfaces.grade(*pair), list(joined), n_workers)
        for (i, j), (grade, apart) in zip(joined, found, strict=True):
            length, unit = surfaces.length(i)
            grades[names[i], names[j]], largest[names[i], names[j]] = grade, (apart, apart * length, unit)
        together = {i: number for number, one in enumerate(groups) for i in one}
        for (i, j), apart in sorted(surfaces.nearly.items()):
            if together.get(i, -1 - i) != together.get(j, -1 - j):
                nearly[names[i], names[j]] = apart
    return Duplicates(
        tuple(tuple(names[i] for i in one) for one in groups),
        {names[i]: dataset.bodies.paths[i] for one in groups for i in one},
        {(names[i], names[j]): distance for (i, j), distance in joined.items()},
        grades,
        largest,
        nearly,
        len(dataset),
        tuple(failures),
    )


def _joined(
    near: NearPairs, surfaces: Surfaces | None, calibration: Calibration, n_workers: int | None, progress: bool
) -> _Pairs:
    """Those of near pairs that are the same, none of two that others have joined, by their surfaces if there are."""
    group = DisjointSet()
    joined: _Pairs = {}
    while some := list(islice(near, _PAIRS)):
        for i, j, _ in some:
            group.add(i)
            group.add(j)
        open_pairs = [(i, j, distance) for i, j, distance in some if not group.connected(i, j)]
        if surfaces is None:
            distances = iter([distance for _, _, distance in open_pairs])
        else:
            laid = on_threads(lambda pair: surfaces.distance(*pair[:2], calibration), open_pairs, n_workers)
            distances = iter(tqdm(laid, desc="laid onto each other", total=len(open_pairs), leave=False,
                                  disable=not progress))  # fmt: skip
        for (i, j, _), distance in zip(open_pairs, distances, strict=True):
            if distance < math.inf and group.merge(i, j):
                joined[i, j] = distance
    return joined


def _around_the_finest(
    joined: _Pairs, surfaces: Surfaces, calibration: Calibration, n_workers: int | None, progress: bool
) -> _Pairs:
    """The pairs that make the groups, and how far apart; groups may fall apart.

    A file that is too coarse to tell joins bodies that differ in a detail. So the files of a group come again, the
    finest first: each belongs to the nearest of those that lead a group; or where it is the same as none of them, to
    the nearest other file before it; or it leads a group itself. None joins two.
    """

    def pairs_of(members: list[int]) -> _Pairs:
        leading: list[int] = []
        following: list[int] = []
        found: _Pairs = {}
        for i in sorted(members, key=lambda one: (surfaces.coarseness(one), one)):
            for finer in (leading, following):
                apart = [surfaces.distance(one, i, calibration) for one in finer]
                if min(apart, default=math.inf) < math.inf:
                    found[finer[int(np.argmin(apart))], i] = min(apart)
                    following.append(i)
                    break
            else:
                leading.append(i)
        return found

    large = [members for members in _groups(joined) if len(members) > 2]
    again = {i for members in large for i in members}
    kept = {pair: distance for pair, distance in joined.items() if again.isdisjoint(pair)}
    found = on_threads(pairs_of, large, n_workers)
    for pairs in tqdm(found, desc="groups", total=len(large), disable=not progress):
        kept |= pairs
    return kept


def _groups(joined: _Pairs) -> list[list[int]]:
    """What pairs join, in order."""
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
    """How far the two meshes of a dataset are from each other, and what that means; arguments as of `duplicates`.

    Raises:
        ValueError: not two files, or the calibration is of another descriptor.
        MeshError: a mesh that cannot be used.
    """
    if len(dataset) != 2:
        told = ", ".join(dataset.bodies.names[:4])
        raise ValueError(
            f"dataset: expected two meshes to compare, got {len(dataset)}: {told}. Name one of a file as FILE#PART."
        )
    calibration, chosen = calibration or Calibration.load(), descriptor_of(descriptor)
    calibration.check(descriptor, chosen, dataset.config)
    descriptions = describe(dataset, chosen, n_workers=1, progress=progress)
    with torch.inference_mode():
        distance = float(chosen.distances(descriptions[:1], descriptions[1:]))
    surfaces = Surfaces(dataset)
    apart, limit = surface_distance(*map(surfaces.samples, range(2))), surfaces.limit(0, 1, calibration)
    return BodyDistance(distance, apart, limit, calibration.words(distance), apart <= limit)


def _files_of(gallery: Gallery, cache_dir: str | Path | None) -> SignatureDataset:
    """The files that a gallery was made of, in order of their ids."""
    rows = sorted(gallery.rows("id", "name", "file", "part"), key=itemgetter("id"))
    names = tuple(one["name"] for one in rows)
    if len(set(names)) < len(names):  # of several folders
        names = tuple(one["id"] for one in rows)
    files = Bodies(tuple(Path(one["file"]) for one in rows), names, None, tuple(one["part"] for one in rows))
    return SignatureDataset(files, gallery.config, cache_dir, reading=gallery.reading)
