"""A part of an index on disk: descriptions, short vectors and entries that are written once and never change."""

from __future__ import annotations

import mmap
import os
import sqlite3
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from igps.retrieval.vectors import VectorMap

_DESCRIPTIONS, _SCALES, _VECTORS = "descriptions.raw", "scales.raw", "vectors.raw"
_NEAREST, _ENTRIES = "nearest.faiss", "entries.sqlite"
_ROWS_AT_ONCE = 4096

# Numbers of a description that is kept in single precision: with so many, a million take 4 GB.
_MOST_IN_FULL = 1024
# Up to so many vectors all are compared, within ten milliseconds; of more, those of the closest clusters.
_MOST_FLAT = 50_000
# Vectors to learn each cluster from, as FAISS advises at the least, and clusters looked into.
_TRAINED_ON = 39
_PROBED = 32
# Of k-means, which hardly moves any more after so many.
_ROUNDS = 10
# FAISS compares vectors number by number, four times as slowly, unless their length is a multiple of this.
_STEP = 16


@dataclass(frozen=True)
class Entry:
    """What is known of an indexed description.

    Args:
        id: tells entries apart; a second one of the same id takes the place of the first.
        name: for people.
        label: class, if it is known.
        mark: of what was described, such as a checksum: the same id with the same mark is the same.
    """

    id: str
    name: str
    label: str | None = None
    mark: str = ""


class PartWriter:
    """Writes the descriptions of a part as they come.

    Args:
        folder: made; must not be there yet.
        n_cells: numbers of a description. Many are kept in half precision, times a power of two that brings the largest
            of a description near the largest of that format: to 0.05 % each.
    """

    def __init__(self, folder: Path, n_cells: int) -> None:
        folder.mkdir()
        self.folder, self.n_cells, self.half = folder, n_cells, n_cells > _MOST_IN_FULL
        self.n = 0
        self._descriptions = (folder / _DESCRIPTIONS).open("wb")
        self._scales = (folder / _SCALES).open("wb") if self.half else None
        self._entries = sqlite3.connect(folder / _ENTRIES)
        self._entries.executescript(
            "PRAGMA journal_mode=OFF; PRAGMA synchronous=OFF;"
            "CREATE TABLE entry (position INTEGER PRIMARY KEY, id TEXT, name TEXT, label TEXT, mark TEXT);"
        )

    def append(self, descriptions: NDArray[np.float32], entries: Sequence[Entry]) -> None:
        """Add descriptions (N, cells) and what is known of each."""
        if descriptions.shape != (len(entries), self.n_cells):
            raise ValueError(
                f"descriptions: expected shape {(len(entries), self.n_cells)}, got {descriptions.shape}. Make them by "
                "one descriptor, with an entry for each."
            )
        if not np.isfinite(descriptions).all():
            raise ValueError("descriptions: expected finite numbers, got others. Look for the mesh that gives them.")
        if self._scales is None:
            self._descriptions.write(np.ascontiguousarray(descriptions, dtype="<f4").data)
        else:
            _, exponents = np.frexp(np.abs(descriptions).max(axis=1, initial=0))
            scales = np.ldexp(np.float32(1), exponents - 15).astype("<f4")
            self._descriptions.write((descriptions / scales[:, None]).astype("<f2").data)
            self._scales.write(scales.data)
        rows = [(self.n + i, *asdict(entry).values()) for i, entry in enumerate(entries)]
        self._entries.executemany("INSERT INTO entry VALUES (?, ?, ?, ?, ?)", rows)
        self.n += len(entries)

    def finish(self) -> None:
        """Close what is written, so that it can be read as a `Part` without vectors."""
        self._descriptions.close()
        if self._scales is not None:
            self._scales.close()
        self._entries.execute("CREATE INDEX by_id ON entry (id)")
        self._entries.commit()
        self._entries.close()


def add_vectors(part: Part, vector_map: VectorMap, seed: int = 0, *, progress: bool = False) -> None:
    """Write the short vectors of a part that has none yet, and what finds the nearest among many of them."""
    if vector_map.changes:
        with (
            (part.folder / _VECTORS).open("wb") as file,
            tqdm(total=len(part), desc="short vectors", disable=not progress) as bar,
        ):
            for rows in part.chunks():
                file.write(vector_map(part.descriptions(rows)).astype("<f4").data)
                part.forget()
                bar.update(len(rows))
    n_numbers = len(vector_map.components) if vector_map.components is not None else part.n_cells
    if len(part) > _MOST_FLAT:
        _write_clusters(part.folder, vectors_of(part.folder, len(part), n_numbers, vector_map), seed, progress)


def _write_clusters(folder: Path, vectors: NDArray[np.float32], seed: int, progress: bool) -> None:
    faiss = import_faiss()
    n_clusters = 2 ** round(np.log2(4 * np.sqrt(len(vectors))))
    index = faiss.index_factory(-(-vectors.shape[1] // _STEP) * _STEP, f"IVF{n_clusters},SQ8")
    index.cp.seed, index.cp.niter = seed + 1, _ROUNDS
    chosen = np.random.default_rng(seed).choice(len(vectors), min(len(vectors), _TRAINED_ON * n_clusters), False)
    with tqdm(total=len(vectors), desc="clusters", disable=not progress) as bar:
        index.train(_widened(vectors[np.sort(chosen)], index.d))
        for i in range(0, len(vectors), 16 * _ROWS_AT_ONCE):
            rows = vectors[i : i + 16 * _ROWS_AT_ONCE]
            index.add(_widened(rows, index.d))
            _forget(vectors)
            bar.update(len(rows))
    index.nprobe = _PROBED
    faiss.write_index(index, str(folder / _NEAREST))


class Part:
    """A part that is written; several processes may read it at once.

    Args:
        folder: of a `PartWriter` that has finished.
        n, n_cells: how many descriptions of how many numbers.
        vector_map: of the short vectors; None where it has none.
        removed: positions of entries that are there no longer.

    Raises:
        OSError, ValueError, RuntimeError: a file is missing or damaged.
    """

    def __init__(
        self, folder: Path, n: int, n_cells: int, vector_map: VectorMap | None = None, removed: Collection[int] = ()
    ) -> None:
        self.folder, self.n_cells, self.removed = folder, n_cells, frozenset(removed)
        half = n_cells > _MOST_IN_FULL
        self._n = n
        self._rows = _mapped(folder / _DESCRIPTIONS, "<f2" if half else "<f4", (n, n_cells))
        self._scales = _mapped(folder / _SCALES, "<f4", (n,)) if half else None
        # Nobody writes to it: no lock is needed, and none would be had on a file system that is read only.
        address = f"{(folder / _ENTRIES).absolute().as_uri()}?mode=ro&immutable=1"
        self._entries = sqlite3.connect(address, uri=True, check_same_thread=False)
        self._entries.execute("SELECT id FROM entry LIMIT 1").fetchone()  # opens the file, which may be removed later
        self._vectors: NDArray[np.float32] | None = None
        self._clusters: Any = None
        if vector_map is not None:
            width = n_cells if vector_map.components is None else len(vector_map.components)
            self._vectors = vectors_of(folder, n, width, vector_map)
            if (folder / _NEAREST).exists():
                faiss = import_faiss()
                self._clusters = faiss.read_index(str(folder / _NEAREST), faiss.IO_FLAG_MMAP)

    def __len__(self) -> int:
        """Entries, with those that were removed."""
        return self._n

    def chunks(self) -> Iterator[NDArray[np.int64]]:
        """Positions of all entries, some thousand at a time."""
        for i in range(0, self._n, _ROWS_AT_ONCE):
            yield np.arange(i, min(i + _ROWS_AT_ONCE, self._n))

    def left(self, positions: NDArray[np.int64]) -> NDArray[np.int64]:
        """Those of the positions that were not removed."""
        if not self.removed:
            return positions
        return positions[~np.isin(positions, list(self.removed))]

    def descriptions(self, positions: NDArray[np.int64]) -> NDArray[np.float32]:
        """(N, cells) of the positions (N,)."""
        rows = np.take(self._rows, positions, axis=0)
        if self._scales is None:
            return rows
        # NumPy widens half precision one number at a time
        return torch.from_numpy(rows).float().mul_(torch.from_numpy(self._scales[positions, None])).numpy()

    def forget(self) -> None:
        """Give back the memory of the descriptions that were read, which a pass over all of them fills."""
        _forget(self._rows)

    def entries(self, positions: Sequence[int] | NDArray[np.int64]) -> list[Entry]:
        """What is known of the positions, in their order."""
        wanted = [int(i) for i in positions]
        found = {}
        for i in range(0, len(wanted), 500):  # SQLite takes no more than 999 parameters everywhere
            few = wanted[i : i + 500]
            marks = ",".join("?" * len(few))
            found.update(
                {
                    row[0]: Entry(*row[1:])
                    for row in self._entries.execute(f"SELECT * FROM entry WHERE position IN ({marks})", few)
                }
            )
        return [found[i] for i in wanted]

    def positions(self, ids: Sequence[str]) -> dict[str, tuple[int, str]]:
        """Position and mark of those of the ids that are here and were not removed."""
        found = {}
        for i in range(0, len(ids), 500):
            few = list(ids[i : i + 500])
            marks = ",".join("?" * len(few))
            for name, position, mark in self._entries.execute(
                f"SELECT id, position, mark FROM entry WHERE id IN ({marks})", few
            ):
                if position not in self.removed:
                    found[name] = (position, mark)
        return found

    def nearest(self, vectors: NDArray[np.float32], n_wanted: int) -> Iterator[tuple[NDArray[Any], NDArray[Any]]]:
        """For each of the vectors (Q, D), squared distances and positions of about so many entries, the closest."""
        faiss = import_faiss()
        if self._clusters is not None:
            options = faiss.SearchParametersIVF(nprobe=self._clusters.nprobe)
            if self.removed:
                options.sel = faiss.IDSelectorNot(faiss.IDSelectorBatch(np.array(sorted(self.removed))))
            # faiss.contrib.torch_utils, which other libraries import, replaces `search` by one that takes no options
            search = getattr(self._clusters, "search_numpy", self._clusters.search)
            found = search(_widened(vectors, self._clusters.d), n_wanted, params=options)
        else:
            found = faiss.knn(vectors, self._vectors, min(n_wanted + len(self.removed), self._n))
        for distances, positions in zip(*found, strict=True):
            kept = (positions >= 0) & ~np.isin(positions, list(self.removed))
            yield distances[kept][:n_wanted], positions[kept][:n_wanted]


def import_faiss() -> Any:
    """FAISS; an ImportError that names the extra where it is not installed."""
    try:
        import faiss
    except ImportError as error:
        raise ImportError('a large index needs FAISS: pip install "interior-gps[index]".') from error
    return faiss


def vectors_of(folder: Path, n: int, n_numbers: int, vector_map: VectorMap) -> NDArray[np.float32]:
    """The short vectors (N, D) of a part, mapped into memory."""
    return _mapped(folder / (_VECTORS if vector_map.changes else _DESCRIPTIONS), "<f4", (n, n_numbers))


def sizes(folder: Path) -> dict[str, int]:
    """Bytes of each file of a part."""
    return {path.name: path.stat().st_size for path in sorted(folder.iterdir())}


def check_sizes(folder: Path, expected: Mapping[str, int]) -> None:
    """Raise a FileNotFoundError or a ValueError unless the files of a part are there in full."""
    for name, size in expected.items():
        found = (folder / name).stat().st_size
        if found != size:
            raise ValueError(f"{folder / name} has {found} bytes of {size}")


def flush(folder: Path) -> None:
    """Have the files of a folder written to the disk itself."""
    for path in [*folder.iterdir(), folder]:
        if path.is_dir() and os.name == "nt":
            continue  # Windows opens no folders
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _widened(vectors: NDArray[np.float32], width: int) -> NDArray[np.float32]:
    """(N, D) with zeros behind, (N, width), which changes no distance."""
    return np.ascontiguousarray(np.pad(vectors, ((0, 0), (0, width - vectors.shape[1]))))


def _mapped(path: Path, dtype: str, shape: tuple[int, ...]) -> NDArray[Any]:
    if path.stat().st_size < np.dtype(dtype).itemsize * int(np.prod(shape)):
        raise ValueError(f"{path} is too short for {shape[0]} entries")
    if not shape[0]:
        return np.zeros(shape, dtype)
    with path.open("rb") as file:
        memory = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    return np.frombuffer(memory, dtype, int(np.prod(shape))).reshape(shape)


def _forget(mapped: NDArray[Any]) -> None:
    """Drop the pages of a mapped file, which count as memory of the process; they are read again where asked for."""
    memory: Any = mapped
    while isinstance(memory, np.ndarray | memoryview):
        memory = memory.base if isinstance(memory, np.ndarray) else memory.obj
    if isinstance(memory, mmap.mmap) and hasattr(mmap, "MADV_DONTNEED"):
        memory.madvise(mmap.MADV_DONTNEED)
