"""A gallery: a database of described bodies, with the descriptor that described them."""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from igps._parameters import check_at_least
from igps.data.dataset import Failure, SignatureDataset
from igps.data.sources import is_number
from igps.descriptors import descriptor as descriptor_of
from igps.descriptors.fingerprint import fingerprint, name_of
from igps.descriptors.registry import is_file
from igps.gallery._search import nearest_rows
from igps.gallery.about import about_of, check_alike
from igps.gallery.columns import KNOWN, Batch
from igps.gallery.opening import open_table, tables
from igps.gallery.rows import described_rows, further_columns
from igps.mesh.options import LoadOptions
from igps.nn.description import check_centres, describe
from igps.nn.descriptor import Descriptor, EmbeddedDescriptor
from igps.retrieval.ranking import SearchResult
from igps.retrieval.reranking import N_RERANKED, rerank_candidates
from igps.signature.signature import SignatureConfig

Found = tuple[list[dict[str, Any]], Tensor, Tensor]
"""Rows with their distances (M,) and descriptions (M, ...), closest first."""

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
        path: folder of the gallery.
        descriptor: the descriptor that the gallery was built with; not needed if that is a named one.
        version: number of an earlier version, see `versions`; the last version if None.

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
        version: int | None = None,
    ) -> None:
        self.path, self.table = Path(path), open_table(path, version)
        about = self.about
        descriptor = about["descriptor"] if descriptor is None else descriptor
        if isinstance(descriptor, Descriptor) or not is_file(descriptor):  # a file may have moved
            check_alike(path, about, {"descriptor": name_of(descriptor)})
        self.descriptor = descriptor_of(descriptor)
        check_alike(path, about, {"model": fingerprint(self.descriptor)})
        parameters = dict(about["signature"])
        version, current = parameters.pop("algorithm_version"), SignatureConfig.ALGORITHM_VERSION
        if version != current:
            raise ValueError(
                f"{path}: expected signatures of version {current}, got {version}. Build it again."
            )
        self.config = SignatureConfig(
            **{**parameters, "attributes": tuple(parameters["attributes"])}
        )
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
            n_near = max(top, N_RERANKED) if rerank else top
            rows, distances, near = self.search(query[None], top=n_near, exact=exact, where=where)
            order = list(range(len(rows)))
            if rerank and rows:
                ranking, n = (
                    SearchResult(torch.arange(len(rows))[None], distances[None]),
                    min(top, len(rows)),
                )
                with torch.inference_mode():
                    reranked = rerank_candidates(
                        query[None], ranking, near.__getitem__, self.descriptor.distances, top=n
                    )
                order, distances = reranked.indices[0].tolist(), reranked.distances[0]
            matches.append(
                [
                    Match(
                        rows[i]["name"], rows[i]["class"], Path(rows[i]["file"]), distance, rows[i]
                    )
                    for i, distance in zip(order, distances.tolist(), strict=True)
                ]
            )
        return matches

    def search(
        self, query: Tensor, *, top: int, exact: bool = False, where: str | None = None
    ) -> Found:
        """Return the rows, distances and descriptions of the bodies closest to a description (1, ...)."""
        # The cosine distance, which finds the candidates, only approximates the distance of a head
        n = 4 * CANDIDATES if isinstance(self.descriptor, EmbeddedDescriptor) else CANDIDATES
        with torch.inference_mode():
            distance = self.descriptor.distances
            return nearest_rows(
                self.table, query, distance, top=top, exact=exact, candidates=n, where=where
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
    ) -> tuple[Self, list[Failure]]:
        """Describe the bodies of a dataset and write a gallery. Return the gallery and the bodies that failed.

        A gallery that exists at `path` is unchanged until the new one is complete, and then becomes a version of it.
        Signatures that are not cached are computed one by one; `dataset.precompute()` computes them on all cores.

        Args:
            path: folder of the gallery.
            dataset: the bodies.
            descriptor: a name, which the gallery stores, or a descriptor, which has to be passed whenever the gallery
                is opened.
            n_workers: threads or processes that describe; all cores if None.
            strict: raise at the first body that cannot be described.
            progress: show a progress bar.
        """
        chosen, failures = descriptor_of(descriptor), list[Failure]()
        check_centres(chosen)
        # Shuffled, because the encoder of short vectors is fitted to the first rows
        mixed = dataset.subset(np.random.default_rng(0).permutation(len(dataset)).tolist())
        kinds = further_columns(dataset.bodies)
        batches = described_rows(mixed, chosen, kinds, {}, failures, n_workers, strict, progress)
        about = about_of(dataset.config, dataset.reading, descriptor)
        try:
            tables().write(Path(path), about, chosen.search_distance, batches, kinds)
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
        check_alike(
            self.path, self.about, {name: expected[name] for name in ("signature", "reading")}
        )
        known = {row["id"]: row["checksum"] for row in self.rows("id", "checksum")}
        failures, further = list[Failure](), further_columns(dataset.bodies, self.columns)
        for batch in described_rows(
            dataset, self.descriptor, further, known, failures, n_workers, strict, progress
        ):
            self.table.add(*batch, further)
        return failures

    @classmethod
    def merge(
        cls,
        path: str | Path,
        others: Sequence[str | Path],
        descriptor: str | Descriptor | None = None,
        *,
        progress: bool = False,
    ) -> Self:
        """Add the bodies of other galleries to the gallery at `path`, which is created if it does not exist.

        The other galleries stay as they are.

        Raises:
            ValueError: the galleries have different descriptors or Signatures, or `others` is empty.
        """
        sources = [open_table(other) for other in others]
        if not sources:
            raise ValueError("others: expected at least one gallery, got none.")
        with contextlib.suppress(FileNotFoundError):
            sources.insert(0, open_table(path))
        first, is_new = sources[0], len(sources) == len(others)
        for table in sources:
            check_alike(table.path, table.about, {**first.about, "names": table.about.get("names")})
        owners = {
            name: table for table in reversed(sources) for name in table.columns
        }  # the first to have a column
        for table in sources:
            for name, kind in table.columns.items():
                owners[name].check_kinds({name: kind})
        with tqdm(
            total=sum(map(len, sources[not is_new :])), desc="entries", disable=not progress
        ) as bar:

            def batches(table: Any) -> Iterator[Batch]:
                for rows in table.batches():
                    yield table.decoded(rows)
                    bar.update(len(rows))

            further = [
                {name: table.columns[name] for name in table.columns.keys() - KNOWN.keys()}
                for table in sources
            ]
            if is_new:
                tables().write(
                    Path(path), first.about, first.head["searched_by"], batches(first), further[0]
                )
            target = open_table(path)
            for table, kinds in zip(sources[1:], further[1:], strict=True):
                for batch in batches(table):
                    target.add(*batch, kinds)
        return cls(path, descriptor)

    def remove(self, where: str) -> int:
        """Remove the bodies that satisfy a condition, and return their number."""
        with self.table.changing(where) as table:
            return int(table.delete(where).num_deleted_rows)

    def update(self, where: str, values: Mapping[str, str | float | None]) -> int:
        """Set columns, such as {"class": "femur"}, of the bodies that satisfy a condition. Return their number."""
        read_only = ("id", "checksum", "bytes", "modified", "thumbnail")
        kinds = {name: kind for name, kind in self.columns.items() if name not in read_only}
        if not values:
            raise ValueError("values: expected at least one column, got none.")
        if wrong := values.keys() - kinds.keys():
            raise ValueError(f"{min(wrong)}: expected one of the columns {', '.join(kinds)}.")
        if empty := [name for name in ("name", "file") if values.get(name, name) is None]:
            raise ValueError(f"{empty[0]}: expected a value, got none; it identifies the body.")
        if bad := [
            name for name, value in values.items() if kinds[name] is float and not is_number(value)
        ]:
            raise ValueError(
                f"values: expected numbers in columns of numbers, got {values[bad[0]]!r} for {bad[0]}."
            )
        typed = {
            name: None if value is None else kinds[name](value) for name, value in values.items()
        }
        with self.table.changing(where) as table:
            return int(table.update(where=where, values=typed).rows_updated)

    def versions(self) -> list[dict[str, Any]]:
        """Return number, time and count of bodies of each version, oldest first. Versions are kept for a month."""
        return [
            {
                "version": version["version"],
                "time": f"{version['timestamp']:%Y-%m-%d %H:%M:%S}",
                "bodies": int(version["metadata"]["total_rows"]),
            }
            for version in self.table.table.list_versions()
        ]

    def restore(self, version: int) -> None:
        """Return to an earlier version, as a new version with its content."""
        open_table(self.path, version)  # raises an error for an unknown version
        with self.table.changing() as table:
            table.restore(version)

    def rows(self, *columns: str) -> Iterator[dict[str, Any]]:
        """Yield some columns of each row, always in the same order."""
        for batch in self.table.batches(columns=columns):
            yield from batch.to_pylist()
