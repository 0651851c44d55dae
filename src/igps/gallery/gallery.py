"""A gallery: a database of described bodies, with the descriptor that described them."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from igps._parameters import check_at_least
from igps.data.dataset import Failure, SignatureDataset
from igps.descriptors import descriptor as descriptor_of
from igps.descriptors.fingerprint import fingerprint, name_of
from igps.descriptors.registry import is_file
from igps.gallery.about import about_of, check_alike
from igps.gallery.opening import tables
from igps.gallery.rows import described_rows, further_columns
from igps.mesh.options import LoadOptions
from igps.nn.description import check_centres, describe
from igps.nn.descriptor import Descriptor
from igps.retrieval.reranking import N_RERANKED, rerank_candidates
from igps.signature.signature import SignatureConfig

CANDIDATES = 640
"""Number of bodies, nearest by their short vectors, that are ranked by the descriptor's own distance."""


@dataclass(frozen=True)
class Match:
    """A body that a query found."""

    name: str  # in its collection
    label: str | None  # its class, if known
    path: Path  # its file at the time of description
    distance: (
        float  # from the query, by the descriptor's own distance; without unit after re-ranking
    )
    # All columns of its row in the gallery
    row: Mapping[str, Any] = field(default_factory=dict, repr=False, compare=False)


class Gallery:
    """A database of described bodies. Queries need neither the files of the bodies nor their Signatures.

    Args:
        path: folder of the gallery, or its place in an object store, such as s3://bucket/gallery.
        descriptor: the descriptor that the gallery was built with; not needed if that is a named one.

    Raises:
        FileNotFoundError: there is no gallery in the folder.
        ValueError: the gallery is damaged, or was built with another descriptor, other parameters of it, or another
            version of the Signatures.
        ImportError: LanceDB is not installed.
    """

    def __init__(
        self,
        path: str | Path,
        descriptor: str | Descriptor | None = None,
    ) -> None:
        self.path = path
        self.table = tables().BodyTable(path)
        about = self.about
        descriptor = about["descriptor"] if descriptor is None else descriptor
        if isinstance(descriptor, Descriptor) or not is_file(descriptor):  # a file may have moved
            check_alike(path, about, {"descriptor": name_of(descriptor)})
        self.descriptor = descriptor_of(descriptor)
        check_alike(path, about, {"model": fingerprint(self.descriptor)})
        parameters = dict(about["signature"])
        version = parameters.pop("algorithm_version")
        current = SignatureConfig.ALGORITHM_VERSION
        if version != current:
            raise ValueError(
                f"{path}: expected signatures of version {current}, got {version}. Build it again."
            )
        parameters["attributes"] = tuple(parameters["attributes"])
        self.config = SignatureConfig(**parameters)
        self.reading = LoadOptions(**about["reading"], names=about.get("names"))

    @property
    def about(self) -> dict[str, Any]:
        """How the descriptions were made: descriptor, parameters of the Signatures, options of reading."""
        return self.table.about

    @property
    def columns(self) -> dict[str, type]:
        """Names and types of the columns."""
        return self.table.columns

    def __len__(self) -> int:
        return len(self.table)

    def query(
        self,
        mesh: str | Path,
        *,
        top: int = 10,
        cache_dir: str | Path | None = None,
        exact: bool = False,
        rerank: bool = False,
        where: str | None = None,
    ) -> list[Match]:
        """Return the bodies closest to the body in a file, closest first.

        Args:
            mesh: a file, read with the options of the gallery.
            top: largest number of bodies.
            cache_dir: cache of Signatures; the user's cache directory if None.
            exact: compare the query with all bodies, which is slow in a large gallery.
            rerank: order the nearest bodies by the neighbours that they share, see `rerank_candidates`.
            where: condition on the columns, such as "class = 'femur' AND volume > 2e5"; other bodies are left out.

        Raises:
            MeshError: the mesh cannot be used.
            ValueError: the condition cannot be parsed.
        """
        dataset = SignatureDataset(
            [mesh], self.config, cache_dir, descriptor=self.descriptor, reading=self.reading
        )
        descriptions = describe(dataset, self.descriptor, n_workers=1)
        return self.nearest(descriptions, top=top, exact=exact, rerank=rerank, where=where)[0]

    def nearest(
        self,
        descriptions: Tensor,
        *,
        top: int = 10,
        exact: bool = False,
        rerank: bool = False,
        where: str | None = None,
    ) -> list[list[Match]]:
        """Return the bodies closest to each description (Q, ...), closest first. For the options see `query`."""
        check_at_least(1, top=top)
        matches = []
        for query in descriptions:
            with torch.inference_mode():
                rows, distances, near = self.table.nearest(
                    query[None],
                    self.descriptor.distances,
                    top=max(top, N_RERANKED) if rerank else top,
                    candidates=CANDIDATES,
                    exact=exact,
                    where=where,
                )
                if rerank and rows:
                    distances = rerank_candidates(query[None], near, self.descriptor.distances)
            nearest_first = distances.argsort(stable=True)[:top].tolist()
            matches.append([_match(rows[i], float(distances[i])) for i in nearest_first])
        return matches

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
    ) -> tuple[Self, list[Failure]]:
        """Describe the bodies of a dataset and write a gallery. Return the gallery and the bodies that failed.

        A gallery that exists at `path` is unchanged until the new one is complete, and then becomes a version of it.
        Signatures that are not cached are computed one by one; `dataset.precompute()` computes them on all cores.

        Args:
            path: folder of the gallery, or its place in an object store.
            dataset: the bodies.
            descriptor: a name, which the gallery stores, or a descriptor, which has to be passed whenever the gallery
                is opened.
            n_workers: threads or processes that describe; all cores if None.
            strict: raise at the first body that cannot be described.
            progress: show a progress bar.
        """
        chosen = descriptor_of(descriptor)
        check_centres(chosen)
        failures: list[Failure] = []
        # Shuffled, because the map to short vectors is fitted to the first rows
        mixed = dataset.subset(np.random.default_rng(0).permutation(len(dataset)).tolist())
        kinds = further_columns(dataset.bodies)
        batches = described_rows(mixed, chosen, kinds, {}, failures, n_workers, strict, progress)
        about = about_of(dataset.config, dataset.reading, descriptor)
        try:
            tables().write(
                path,
                about,
                chosen.search_distance,
                batches,
                kinds,
                weights=chosen.search_weights,
            )
        except ValueError as error:
            if len(failures) < len(dataset):
                raise
            reason = (
                f"none of {len(failures)} bodies could be described; the first: {failures[0].error}"
            )
            raise ValueError(f"{path}: {reason}") from error
        return cls(path, descriptor), failures

    def add(
        self,
        dataset: SignatureDataset,
        *,
        n_workers: int | None = None,
        strict: bool = False,
        progress: bool = False,
    ) -> list[Failure]:
        """Add the bodies of a dataset. Return the bodies that failed. For the arguments see `build`.

        Bodies that the gallery has already are skipped, or replaced if their content has changed.

        Raises:
            ValueError: the gallery was built with other parameters of the Signatures or other options of reading.
        """
        expected = about_of(dataset.config, dataset.reading, self.descriptor)
        compared = {name: expected[name] for name in ("signature", "reading")}
        check_alike(self.path, self.about, compared)
        known = {row["id"]: row["checksum"] for row in self.rows("id", "checksum")}
        failures: list[Failure] = []
        further = further_columns(dataset.bodies, self.columns)
        for batch in described_rows(
            dataset, self.descriptor, further, known, failures, n_workers, strict, progress
        ):
            self.table.add(*batch, further)
        return failures

    def remove(self, where: str) -> int:
        """Remove the bodies that satisfy a condition, and return their number."""
        with self.table.changing(where) as table:
            return int(table.delete(where).num_deleted_rows)

    def rows(self, *columns: str) -> Iterator[dict[str, Any]]:
        """Yield some columns of each row, always in the same order."""
        for batch in self.table.batches(columns=columns):
            yield from batch.to_pylist()


def _match(row: dict[str, Any], distance: float) -> Match:
    return Match(row["name"], row["class"], Path(row["file"]), distance, row)
