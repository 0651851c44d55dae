"""The meshes of a collection in an index, with the descriptor that they were described by."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from igps.data.dataset import Failure, SignatureDataset
from igps.data.sources import file_and_part
from igps.descriptors import descriptor as descriptor_of
from igps.descriptors.fingerprint import fingerprint, name_of
from igps.descriptors.registry import is_file
from igps.mesh.loading import BodyRef
from igps.mesh.mesh import MeshError
from igps.mesh.options import LoadOptions
from igps.nn.description import describe
from igps.nn.descriptor import Descriptor, EmbeddedDescriptor
from igps.retrieval.index import CANDIDATES, Entry, VectorIndex, check_alike, extend_index, merge_indices, write_index
from igps.retrieval.ranking import SearchResult
from igps.retrieval.reranking import N_RERANKED, rerank_found
from igps.signature.signature import SignatureConfig

# So many descriptions are in memory at once.
_AT_ONCE = 256


@dataclass(frozen=True)
class Match:
    """A mesh that a query found.

    Args:
        name: in its collection.
        label: its class, if it is known.
        path: its file when it was indexed, which may have been moved since.
        distance: from the query, by the descriptor's own distance; or re-ranked, without unit.
    """

    name: str
    label: str | None
    path: Path
    distance: float


class Gallery:
    """An index of meshes, opened for queries, which need neither the mesh files nor their Signatures.

    Args:
        path: folder of the index.
        descriptor: the one that the index was built with. It may be left out if the index knows it by its name.

    Raises:
        FileNotFoundError: there is no index.
        ValueError: it is damaged, or of another descriptor, another version of it, or another version of Signatures.
    """

    def __init__(self, path: str | Path, descriptor: str | Descriptor | None = None) -> None:
        self.index = VectorIndex(path)
        about = self.index.about
        by_name = not isinstance(descriptor, Descriptor) and not is_file(descriptor or "")  # a file may have moved
        if by_name and descriptor is not None:
            check_alike(self.index, {"descriptor": str(descriptor)})
        self.descriptor = descriptor_of(about["descriptor"] if descriptor is None else descriptor)
        if isinstance(descriptor, Descriptor):
            check_alike(self.index, {"descriptor": descriptor.name})
        check_alike(self.index, {"model": fingerprint(self.descriptor)})
        version = SignatureConfig.ALGORITHM_VERSION
        if about["signature"]["algorithm_version"] != version:
            raise ValueError(
                f"{path}: the index is of version {about['signature']['algorithm_version']} of the signatures, not "
                f"{version} as here. Build it again."
            )
        parameters = {name: value for name, value in about["signature"].items() if name != "algorithm_version"}
        self.config = SignatureConfig(**{**parameters, "attributes": tuple(parameters["attributes"])})
        self.reading = LoadOptions(**about["reading"])

    @property
    def path(self) -> Path:
        """Folder of the index."""
        return self.index.path

    def __len__(self) -> int:
        return len(self.index)

    def query(
        self,
        mesh: str | Path,
        *,
        top: int = 10,
        cache_dir: str | Path | None = None,
        exact: bool = False,
        rerank: bool = False,
    ) -> list[Match]:
        """The meshes closest to that of a file, closest first.

        Args:
            mesh: a file, read as those of the index were.
            top: how many; all if there are fewer.
            cache_dir: of Signatures; the user's cache directory if None.
            exact: compare with all, which takes long in a large index.
            rerank: put the nearest in order by what neighbours they have in common, see `rerank_found`.

        Raises:
            MeshError: the mesh cannot be used.
        """
        dataset = SignatureDataset([mesh], self.config, cache_dir, descriptor=self.descriptor, reading=self.reading)
        descriptions = describe(dataset, self.descriptor, n_workers=1)
        return self.nearest(descriptions, top=top, exact=exact, rerank=rerank)[0]

    def nearest(
        self, descriptions: Tensor, *, top: int = 10, exact: bool = False, rerank: bool = False
    ) -> list[list[Match]]:
        """For each of the descriptions (Q, ...) the meshes closest to it, closest first; options as of `query`."""
        if rerank:
            wide = self.search(descriptions, top=max(top, N_RERANKED), exact=exact)
            with torch.inference_mode():
                found = rerank_found(
                    descriptions,
                    wide,
                    lambda positions: self.index.descriptions(positions.numpy()),
                    self.descriptor.distances,
                    top=min(top, len(self)),
                )
        else:
            found = self.search(descriptions, top=top, exact=exact)
        return [
            [
                Match(entry.name, entry.label, file_and_part(Path(entry.id))[0], distance)
                for entry, distance in zip(self.index.entries(indices.numpy()), distances.tolist(), strict=True)
            ]
            for indices, distances in zip(found.indices, found.distances, strict=True)
        ]

    def search(self, descriptions: Tensor, *, top: int, exact: bool = False) -> SearchResult:
        """The entries of the index closest to each of the descriptions (Q, ...), by the descriptor's own distance."""
        # More are ranked under a head, whose distance may be only near the cosine's.
        candidates = 4 * CANDIDATES if isinstance(self.descriptor, EmbeddedDescriptor) else CANDIDATES
        with torch.inference_mode():
            return self.index.search(
                descriptions, self.descriptor.distances, top=min(top, len(self)), exact=exact, candidates=candidates
            )

    @classmethod
    def build(
        cls,
        path: str | Path,
        dataset: SignatureDataset,
        descriptor: str | Descriptor = "pretrained",
        *,
        n_workers: int | None = None,
        strict: bool = False,
        progress: bool = False,
    ) -> tuple[Gallery, list[Failure]]:
        """Index the meshes of a dataset, in place of an index that is there; also returns those that failed.

        Signatures that are not cached are computed on the way; `dataset.precompute()` does that on all cores.

        Args:
            path: folder of the index.
            dataset: of the meshes.
            descriptor: a name, which the index keeps, or a descriptor, which then is given whenever it is opened.
            n_workers: threads or processes that describe; all cores if None.
            strict: raise at the first mesh that cannot be described.
            progress: show bars.
        """
        chosen = descriptor_of(descriptor)
        failures: list[Failure] = []
        about = about_of(dataset.config, dataset.reading, descriptor)
        batches = _batches(dataset, chosen, {}, failures, n_workers, strict, progress)
        write_index(path, about, chosen.searched_by, batches, progress=progress)
        return cls(path, descriptor), failures

    @classmethod
    def add(
        cls,
        path: str | Path,
        dataset: SignatureDataset,
        descriptor: str | Descriptor = "pretrained",
        *,
        n_workers: int | None = None,
        strict: bool = False,
        progress: bool = False,
    ) -> tuple[Gallery, list[Failure]]:
        """Add the meshes of a dataset to an index. Files that it has already are passed over, changed ones replaced.

        Args:
            path, dataset, descriptor, n_workers, strict, progress: see `build`.

        Raises:
            ValueError: the index is of another descriptor or of other Signatures.
        """
        chosen, about = descriptor_of(descriptor), about_of(dataset.config, dataset.reading, descriptor)
        failures: list[Failure] = []
        index = VectorIndex(path)
        check_alike(index, about)
        known = index.marks([_id(one) for one in dataset.bodies])
        batches = _batches(dataset, chosen, known, failures, n_workers, strict, progress)
        extend_index(path, about, batches, progress=progress)
        return cls(path, descriptor), failures

    @classmethod
    def merge(
        cls,
        path: str | Path,
        others: Sequence[str | Path],
        descriptor: str | Descriptor | None = None,
        *,
        progress: bool = False,
    ) -> Gallery:
        """An index of the meshes of others, added to that at `path`, if there is one.

        Args:
            path, descriptor, progress: see `build`.
            others: folders of the other indices.

        Raises:
            ValueError: they are of different descriptors or Signatures.
        """
        merge_indices(path, others, progress=progress)
        return cls(path, descriptor)


def about_of(config: SignatureConfig, reading: LoadOptions, descriptor: str | Descriptor) -> dict[str, Any]:
    """What an index records of how its descriptions were made; only such descriptions can be compared with them."""
    signature = {**asdict(config), "algorithm_version": SignatureConfig.ALGORITHM_VERSION}
    return {
        "descriptor": name_of(descriptor),
        "model": fingerprint(descriptor_of(descriptor)),
        "signature": {**signature, "attributes": list(config.attributes)},
        "reading": reading.as_dict(),
    }


def _batches(
    dataset: SignatureDataset,
    descriptor: Descriptor,
    known: dict[str, str],
    failures: list[Failure],
    n_workers: int | None,
    strict: bool,
    progress: bool,
) -> Iterator[tuple[Tensor, list[Entry]]]:
    """Descriptions and entries of the files that are not known by their marks; the failures are added to the list."""
    with tqdm(desc="descriptions", total=len(dataset), disable=not progress) as bar:
        for start in range(0, len(dataset), _AT_ONCE):
            part = dataset.subset(range(start, min(start + _AT_ONCE, len(dataset))))
            keys = [_key(part, i) for i in range(len(part))]
            ids, names = [_id(one) for one in part.bodies], part.bodies.names
            labels = part.bodies.labels or (None,) * len(part)
            new = [i for i, one in enumerate(ids) if keys[i] is None or known.get(one) != keys[i]]
            descriptions, failed = _described(part.subset(new), descriptor, n_workers, strict)
            if len(new) > len(failed):
                lost = {failure.id for failure in failed}
                left = [i for i in new if names[i] not in lost]
                yield descriptions, [Entry(ids[i], names[i], labels[i], keys[i] or "") for i in left]
            failures += failed
            bar.update(len(part))


def _described(
    dataset: SignatureDataset, descriptor: Descriptor, n_workers: int | None, strict: bool
) -> tuple[Tensor, list[Failure]]:
    """Descriptions of those of the meshes that can be described, which may be none, and the failures of the others."""
    failed: list[Failure] = []
    try:
        if len(dataset):
            return describe(dataset, descriptor, failures=None if strict else failed, n_workers=n_workers), failed
    except MeshError:
        if strict:
            raise
    return torch.zeros(0), failed


def _key(dataset: SignatureDataset, i: int) -> str | None:
    try:
        return dataset.key(i)
    except MeshError:  # describing it will say why
        return None


def _id(body: BodyRef) -> str:
    return str(replace(body, path=body.path.resolve()))
