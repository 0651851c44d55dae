"""The bodies of a collection in a database, with the descriptor that they were described by."""

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
from igps.gallery.about import KNOWN, Batch, about_of, check_alike, open_table, tables
from igps.gallery.rows import described_rows, further_columns
from igps.mesh.options import LoadOptions
from igps.nn.description import check_centres, describe
from igps.nn.descriptor import Descriptor, EmbeddedDescriptor
from igps.retrieval.ranking import SearchResult
from igps.retrieval.reranking import N_RERANKED, rerank_found
from igps.signature.signature import SignatureConfig

Found = tuple[list[dict[str, Any]], Tensor, Tensor]
"""Rows, their distances (M,) and descriptions (M, ...), the closest first."""

CANDIDATES = 640
"""Bodies whose short vectors are the nearest, which are ranked again by the distance itself."""


@dataclass(frozen=True)
class Match:
    """A body that a query found."""

    name: str  # in its collection
    label: str | None  # its class, if it is known
    path: Path  # its file when it was described, which may have been moved since
    distance: float  # from the query, by the descriptor's own distance; or re-ranked, without unit
    # All that the gallery tells of it, by column
    row: Mapping[str, Any] = field(default_factory=dict, repr=False, compare=False)


class Gallery:
    """Described bodies, opened for queries, which need neither their files nor their Signatures.

    Args:
        path: its folder.
        descriptor: the one that it was built with. It may be left out if the gallery knows it by its name.
        version: an earlier one of its `versions`; the last if None.

    Raises:
        FileNotFoundError: there is no gallery.
        ValueError: it is damaged, or of another descriptor, another version of it, or another version of Signatures.
        ImportError: LanceDB is not installed.
    """

    def __init__(
        self, path: str | Path, descriptor: str | Descriptor | None = None, version: int | None = None
    ) -> None:
        self.path, self.table = Path(path), open_table(path, version)
        about = self.about
        given = about["descriptor"] if descriptor is None else descriptor
        if isinstance(given, Descriptor) or not is_file(given):  # a file may have moved
            check_alike(path, about, {"descriptor": name_of(given)})
        self.descriptor = descriptor_of(given)
        check_alike(path, about, {"model": fingerprint(self.descriptor)})
        here = SignatureConfig.ALGORITHM_VERSION
        if about["signature"]["algorithm_version"] != here:
            raise ValueError(
                f"{path}: the gallery is of version {about['signature']['algorithm_version']} of the signatures, not "
                f"{here} as here. Build it again."
            )
        parameters = {name: value for name, value in about["signature"].items() if name != "algorithm_version"}
        self.config = SignatureConfig(**{**parameters, "attributes": tuple(parameters["attributes"])})
        self.reading = LoadOptions(**about["reading"], names=about.get("names"))

    @property
    def about(self) -> dict[str, Any]:
        """What it records of how its descriptions were made."""
        return self.table.about

    @property
    def columns(self) -> dict[str, type]:
        """What it tells of each body, and of which type."""
        return self.table.columns

    def __len__(self) -> int:
        return len(self.table)

    def query(
        self, mesh: str | Path, *, top: int = 10, cache_dir: str | Path | None = None, exact: bool = False,
        rerank: bool = False, where: str | None = None,
    ) -> list[Match]:  # fmt: skip
        """The bodies closest to that of a file, closest first.

        Args:
            mesh: a file, read as those of the gallery were.
            top: how many; all if there are fewer.
            cache_dir: of Signatures; the user's cache directory if None.
            exact: compare with all, which takes long in a large gallery.
            rerank: put the nearest in order by what neighbours they have in common, see `rerank_found`.
            where: only among those that satisfy this condition, such as "class = 'femur' AND volume > 2e5".

        Raises:
            MeshError: the mesh cannot be used.
            ValueError: a condition that cannot be understood.
        """
        dataset = SignatureDataset([mesh], self.config, cache_dir, descriptor=self.descriptor, reading=self.reading)
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
        """For each of the descriptions (Q, ...) the bodies closest to it, closest first; options as of `query`."""
        check_at_least(1, top=top)
        matches = []
        for query in descriptions:
            n_near = max(top, N_RERANKED) if rerank else top
            rows, distances, near = self.search(query[None], top=n_near, exact=exact, where=where)
            order = list(range(len(rows)))
            if rerank and rows:
                whole, n = SearchResult(torch.arange(len(rows))[None], distances[None]), min(top, len(rows))
                with torch.inference_mode():
                    found = rerank_found(query[None], whole, near.__getitem__, self.descriptor.distances, top=n)
                order, distances = found.indices[0].tolist(), found.distances[0]
            matches.append([
                Match(rows[i]["name"], rows[i]["class"], Path(rows[i]["file"]), distance, rows[i])
                for i, distance in zip(order, distances.tolist(), strict=True)
            ])  # fmt: skip
        return matches

    def search(self, query: Tensor, *, top: int, exact: bool = False, where: str | None = None) -> Found:
        """Rows, distances and descriptions of the bodies closest to a description (1, ...)."""
        # More are ranked under a head, whose distance may be only near the cosine's.
        n = 4 * CANDIDATES if isinstance(self.descriptor, EmbeddedDescriptor) else CANDIDATES
        with torch.inference_mode():
            return self.table.search(query, self.descriptor.distances, top=top, exact=exact, candidates=n, where=where)

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
        """Describe the bodies of a dataset into a gallery; also returns those that failed.

        A gallery that is there keeps its state until the new one is complete, and becomes an earlier version of it.
        Signatures that are not cached are computed on the way; `dataset.precompute()` does that on all cores.

        Args:
            descriptor: a name, which the gallery keeps, or a descriptor, which then is given whenever it is opened.
            n_workers: threads or processes that describe; all cores if None.
            strict: raise at the first body that cannot be described.
        """
        chosen, failures = descriptor_of(descriptor), list[Failure]()
        check_centres(chosen)
        # In any order, as short vectors are fitted to the first
        mixed = dataset.subset(np.random.default_rng(0).permutation(len(dataset)).tolist())
        kinds = further_columns(dataset.bodies)
        batches = described_rows(mixed, chosen, kinds, {}, failures, n_workers, strict, progress)
        about = about_of(dataset.config, dataset.reading, descriptor)
        try:
            tables().write(Path(path), about, chosen.searched_by, batches, kinds)
        except ValueError as error:
            if len(failures) < len(dataset):
                raise
            told = f"none of {len(failures)} bodies could be described; the first: {failures[0].error}"
            raise ValueError(f"{path}: {told}") from error
        return cls(path, descriptor), failures

    def add(
        self, dataset: SignatureDataset, *, n_workers: int | None = None, strict: bool = False, progress: bool = False
    ) -> list[Failure]:
        """Add the bodies of a dataset; returns those that failed. Arguments as of `build`.

        Bodies that it has already are passed over, and replaced where their content has changed.

        Raises:
            ValueError: the gallery is of other Signatures.
        """
        wanted = about_of(dataset.config, dataset.reading, self.descriptor)
        check_alike(self.path, self.about, {name: wanted[name] for name in ("signature", "reading")})
        known = {one["id"]: one["checksum"] for one in self.rows("id", "checksum")}
        failures, further = list[Failure](), further_columns(dataset.bodies, self.columns)
        for some in described_rows(dataset, self.descriptor, further, known, failures, n_workers, strict, progress):
            self.table.add(*some, further)
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
        """A gallery of the bodies of others, which stay as they are, added to that at `path`, if there is one.

        Raises:
            ValueError: they are of different descriptors or Signatures, or none is given.
        """
        opened = [open_table(other) for other in others]
        if not opened:
            raise ValueError("others: expected at least one gallery, got none.")
        with contextlib.suppress(FileNotFoundError):
            opened.insert(0, open_table(path))
        first, is_new = opened[0], len(opened) == len(others)
        for one in opened:
            check_alike(one.path, one.about, {**first.about, "names": one.about.get("names")})
        owners = {name: one for one in reversed(opened) for name in one.columns}  # the first to have a column
        for one in opened:
            for name, kind in one.columns.items():
                owners[name].check_kinds({name: kind})
        with tqdm(total=sum(map(len, opened[not is_new :])), desc="entries", disable=not progress) as bar:

            def batches(table: Any) -> Iterator[Batch]:
                for some in table.batches():
                    yield table.decoded(some)
                    bar.update(len(some))

            further = [{name: one.columns[name] for name in one.columns.keys() - KNOWN.keys()} for one in opened]
            if is_new:
                tables().write(Path(path), first.about, first.head["searched_by"], batches(first), further[0])
            into = open_table(path)
            for one, kinds in zip(opened[1:], further[1:], strict=True):
                for some in batches(one):
                    into.add(*some, kinds)
        return cls(path, descriptor)

    def remove(self, where: str) -> int:
        """Remove the bodies that satisfy a condition; how many."""
        with self.table.changing(where) as table:
            return int(table.delete(where).num_deleted_rows)

    def update(self, where: str, values: Mapping[str, str | float | None]) -> int:
        """Set columns of the bodies that satisfy a condition, such as {"class": "femur"}; of how many."""
        ours = ("id", "checksum", "bytes", "modified", "thumbnail")
        kinds = {name: kind for name, kind in self.columns.items() if name not in ours}
        if not values:
            raise ValueError("values: expected at least one column, got none.")
        if wrong := values.keys() - kinds.keys():
            raise ValueError(f"{min(wrong)}: expected one of the columns {', '.join(kinds)}.")
        if empty := [name for name in ("name", "file") if values.get(name, name) is None]:
            raise ValueError(f"{empty[0]}: expected a value, got none; every body has one, by which it is told.")
        if bad := [name for name, value in values.items() if kinds[name] is float and not is_number(value)]:
            raise ValueError(f"values: expected numbers in columns of numbers, got {values[bad[0]]!r} for {bad[0]}.")
        typed = {name: None if value is None else kinds[name](value) for name, value in values.items()}
        with self.table.changing(where) as table:
            return int(table.update(where=where, values=typed).rows_updated)

    def versions(self) -> list[dict[str, Any]]:
        """Number, time and bodies of each version, the oldest first; those of the last month are kept."""
        return [
            {"version": one["version"], "time": f"{one['timestamp']:%Y-%m-%d %H:%M:%S}",
             "bodies": int(one["metadata"]["total_rows"])}
            for one in self.table.table.list_versions()
        ]  # fmt: skip

    def restore(self, version: int) -> None:
        """Make an earlier version the last; those between stay."""
        open_table(self.path, version)
        with self.table.changing() as table:
            table.restore(version)

    def rows(self, *columns: str) -> Iterator[dict[str, Any]]:
        """Some of what it tells of each body, always in the same order."""
        for some in self.table.batches(columns=columns):
            yield from some.to_pylist()
