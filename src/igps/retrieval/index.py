"""An index of descriptions on disk: the nearest of a million within milliseconds, in parts that can be added.

A short vector stands for each description (see `VectorMap`). FAISS finds those of the nearest few hundred, which are
then ranked by the distance of the descriptions themselves. A small index needs no vectors: all are compared.

The index is a folder of parts that never change and a manifest that names them. A change writes new parts beside the
old ones and then replaces the manifest in one step, so that a process that is killed leaves the last good state, and
those that read have the state of when they opened it. One process writes at a time; others wait for it.
"""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import shutil
import sqlite3
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from igps.retrieval.distances import Distance
from igps.retrieval.index_part import (
    Entry,
    Part,
    PartWriter,
    add_vectors,
    check_sizes,
    flush,
    sizes,
)
from igps.retrieval.ranking import SearchResult, rank
from igps.retrieval.vectors import SearchDistance, VectorMap

__all__ = ["CANDIDATES", "Entry", "VectorIndex"]

CANDIDATES = 512
"""Entries whose short vectors are the nearest, which are ranked again by the distance itself."""

Batches = Iterable[tuple[Tensor, Sequence[Entry]]]
"""Descriptions (N, ...), some at a time, and what is known of each."""

_FORMAT = "igps-index-2"
_MANIFEST, _LOCK, _STAGED, _PART = "manifest.json", "lock", "staged-", "part-"
_OURS = (_MANIFEST, _LOCK, _STAGED, _PART, "map-")
# Fewer are all compared; the map of more is fitted to no more than so many.
_FEWEST_FOR_VECTORS = 2 * CANDIDATES
_MOST_FITTED_TO = 4096
_ATTEMPTS = 5
# Of a part; with more it is written anew.
_MOST_REMOVED = 0.1


class VectorIndex:
    """An index as it is when it is opened.

    Args:
        path: its folder.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is damaged, or no index.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        for attempt in range(_ATTEMPTS):
            manifest = _manifest(self.path)
            if manifest is None:
                raise FileNotFoundError(f"{self.path}: no index there, or its building was not finished. Build it.")
            try:
                self._open(manifest)
                return
            except FileNotFoundError as error:
                # Its parts were replaced since the manifest was read: the new one names others.
                if attempt + 1 == _ATTEMPTS or _manifest(self.path) == manifest:
                    raise ValueError(f"{self.path}: the index is damaged ({error}). Build it again.") from error
            except (OSError, ValueError, KeyError, RuntimeError, sqlite3.Error) as error:
                words = str(error).splitlines()[0] if str(error) else type(error).__name__
                raise ValueError(f"{self.path}: the index is damaged ({words}). Build it again.") from error

    def _open(self, manifest: dict[str, Any]) -> None:
        self.about: dict[str, Any] = manifest["about"]
        self.shape: tuple[int, ...] = tuple(manifest["shape"])
        self.searched_by: SearchDistance | None = manifest["searched_by"]
        self.vector_map = _load_map(self.path, manifest["map"])
        self.manifest = manifest
        self.parts = []
        for part in manifest["parts"]:
            check_sizes(self.path / part["folder"], part["files"])
            self.parts.append(
                Part(self.path / part["folder"], part["n"], _cells(self.shape), self.vector_map, part["removed"])
            )
        self._starts = np.cumsum([0, *map(len, self.parts)])

    def __len__(self) -> int:
        return sum(len(part) - len(part.removed) for part in self.parts)

    def search(
        self,
        queries: Tensor,
        distance: Distance,
        *,
        top: int,
        candidates: int = CANDIDATES,
        exact: bool = False,
    ) -> SearchResult:
        """The `top` closest entries of every query, ties in the order of the index.

        Args:
            queries: (Q, ...) descriptions.
            distance: that of the descriptions.
            top: how many to return, 1 to as many as there are.
            candidates: entries of the nearest vectors that are ranked by the distance itself.
            exact: rank all entries, which takes long in a large index.

        Returns:
            `indices` are positions, see `entries`.

        Raises:
            ValueError: a wrong top, or descriptions of another shape.
        """
        if not 1 <= top <= len(self):
            raise ValueError(f"top: expected 1 to {len(self)}, the entries of the index, got {top}.")
        if tuple(queries.shape[1:]) != self.shape:
            raise ValueError(
                f"queries: expected descriptions of shape {self.shape} as in the index, got {tuple(queries.shape[1:])}."
            )
        if exact or self.vector_map is None:
            found = [self._ranked(query[None], self._chunks(), distance, top) for query in queries]
        else:
            flat = queries.reshape(len(queries), -1).cpu().float().numpy()
            # Where fewer are near than are wanted, all are ranked.
            found = [
                self._ranked(query[None], [near] if len(near) >= top else self._chunks(), distance, top)
                for query, near in zip(queries, self._nearest(flat, max(candidates, top)), strict=True)
            ]
        return SearchResult(torch.stack([one.indices for one in found]), torch.stack([one.distances for one in found]))

    def entries(self, indices: Sequence[int] | NDArray[np.int64]) -> list[Entry]:
        """What is known of the positions that a search found, in their order."""
        positions = np.asarray(indices, dtype=np.int64)
        of_part = np.searchsorted(self._starts, positions, side="right") - 1
        found: dict[int, Entry] = {}
        for number in np.unique(of_part):
            here = positions[of_part == number]
            found.update(zip(here.tolist(), self.parts[number].entries(here - self._starts[number]), strict=True))
        return [found[i] for i in positions.tolist()]

    def marks(self, ids: Sequence[str]) -> dict[str, str]:
        """The marks of those of the ids that are in the index."""
        return {name: mark for part in self.parts for name, (_, mark) in part.positions(ids).items()}

    def batches(self) -> Iterator[tuple[NDArray[np.int64], Tensor]]:
        """Positions (N,) and descriptions (N, ...) of all entries, some thousand at a time."""
        for positions in self._chunks():
            yield positions, self.descriptions(positions)

    def descriptions(self, positions: NDArray[np.int64]) -> Tensor:
        """(N, ...) descriptions of the positions (N,)."""
        of_part = np.searchsorted(self._starts, positions, side="right") - 1
        numbers = np.unique(of_part)
        if len(numbers) == 1:  # most are in the largest part
            rows = self.parts[numbers[0]].descriptions(positions - self._starts[numbers[0]])
            return torch.from_numpy(rows).reshape(-1, *self.shape)
        rows = np.empty((len(positions), _cells(self.shape)), dtype=np.float32)
        for number in numbers:
            here = of_part == number
            rows[here] = self.parts[number].descriptions(positions[here] - self._starts[number])
        return torch.from_numpy(rows).reshape(-1, *self.shape)

    def _chunks(self) -> Iterator[NDArray[np.int64]]:
        for start, part in zip(self._starts, self.parts, strict=False):
            for positions in part.chunks():
                yield part.left(positions) + start

    def _nearest(self, queries: NDArray[np.float32], candidates: int) -> list[NDArray[np.int64]]:
        """Positions of the candidates of each query, in ascending order, so that ties keep the order of the index."""
        assert self.vector_map is not None
        vectors = self.vector_map(queries)
        of_parts = [list(part.nearest(vectors, candidates)) for part in self.parts]
        chosen = []
        for found in zip(*of_parts, strict=True):
            distances = np.concatenate([one for one, _ in found])
            positions = np.concatenate([one + start for (_, one), start in zip(found, self._starts, strict=False)])
            chosen.append(np.sort(positions[np.argsort(distances, kind="stable")[:candidates]]))
        return chosen

    def _ranked(self, query: Tensor, groups: Iterable[NDArray[np.int64]], distance: Distance, top: int) -> SearchResult:
        positions = np.zeros(0, dtype=np.int64)
        distances = torch.zeros(1, 0)
        for group in groups:
            found = distance(query, self.descriptions(group).to(query.device)).cpu()
            distances = torch.cat([distances.to(found.dtype), found], dim=1)
            positions = np.concatenate([positions, group])
            best = rank(distances)[:, :top]
            distances, positions = distances.gather(1, best), positions[best[0].numpy()]
        return SearchResult(torch.from_numpy(positions), distances[0])


def write_index(
    path: str | Path,
    about: Mapping[str, Any],
    searched_by: SearchDistance | None,
    batches: Batches,
    *,
    progress: bool = False,
) -> VectorIndex:
    """Build an index, in place of the one that is there.

    Args:
        path: its folder.
        about: what its users want to know of it, for JSON.
        searched_by: the distance by which candidates are found; None where neither serves: all will be compared.
        batches: at least one description.
        progress: show bars of what is done once the descriptions are there.

    Raises:
        ValueError: nothing to index.
    """
    return _changed(Path(path), dict(about), searched_by, batches, keep=False, progress=progress)


def extend_index(
    path: str | Path, about: Mapping[str, Any], batches: Batches, *, progress: bool = False
) -> VectorIndex:
    """Add entries to an index. One of the id of an earlier one takes its place, unless its mark is the same.

    Args:
        path, about, batches, progress: see `write_index`.

    Raises:
        FileNotFoundError: there is no index.
        ValueError: it is one of something else: what it says about itself differs.
    """
    before = VectorIndex(path)
    check_alike(before, about)
    return _changed(before.path, dict(about), before.searched_by, batches, keep=True, progress=progress)


def merge_indices(path: str | Path, others: Sequence[str | Path], *, progress: bool = False) -> VectorIndex:
    """An index of the entries of others, which stay as they are; added to the one at `path`, if there is one.

    Args:
        path: its folder.
        others: folders of the others.
        progress: show bars.

    Raises:
        ValueError: none is given, or they are not of the same kind.
    """
    path = Path(path)
    opened = [VectorIndex(other) for other in others]
    if not opened:
        raise ValueError("others: expected at least one index to merge, got none.")
    there = [VectorIndex(path)] if _manifest(path) is not None else []
    first = (there or opened)[0]
    for one in opened:
        check_alike(one, first.about)
    with tqdm(total=sum(map(len, opened)), desc="entries", disable=not progress) as bar:

        def batches() -> Batches:
            for one in opened:
                for positions, descriptions in one.batches():
                    yield descriptions, one.entries(positions)
                    bar.update(len(positions))

        return _changed(path, first.about, first.searched_by, batches(), keep=bool(there), progress=progress)


def check_alike(index: VectorIndex, about: Mapping[str, Any]) -> None:
    """Raise a ValueError that names the first difference between an index and what is expected of it."""
    wanted, found = _flat(json.loads(json.dumps(dict(about)))), _flat(index.about)
    for name, value in wanted.items():
        if found.get(name) != value:
            raise ValueError(
                f"{index.path}: the index is of another {name}: it has {_short(found.get(name))}, not {_short(value)}. "
                "Ask it with its own, or build another."
            )


def _flat(about: Mapping[str, Any]) -> dict[str, Any]:
    """By name, and what has names within by both."""
    inner = {f"{name}.{k}": v for name, value in about.items() if isinstance(value, dict) for k, v in value.items()}
    return {**{name: value for name, value in about.items() if not isinstance(value, dict)}, **inner}


def _changed(
    path: Path, about: dict[str, Any], searched_by: SearchDistance | None, batches: Batches, keep: bool, progress: bool
) -> VectorIndex:
    path.mkdir(parents=True, exist_ok=True)
    strangers = sorted(found.name for found in path.iterdir() if not found.name.startswith(_OURS))
    if strangers:
        raise ValueError(f"{path}: expected an index or a new folder, got one that holds {strangers[0]}. Name another.")
    staged = path / f"{_STAGED}{secrets.token_hex(8)}"
    with _locked(staged.with_suffix(".lock")):
        try:
            shape, n = _write_staged(staged, batches)
            with _locked(path / _LOCK):
                _remove_abandoned(path)
                manifest = _manifest(path) if keep else None
                _commit(path, staged, n, shape, about, searched_by, manifest, progress)
        finally:
            shutil.rmtree(staged, ignore_errors=True)
            staged.with_suffix(".lock").unlink(missing_ok=True)
    return VectorIndex(path)


def _write_staged(folder: Path, batches: Batches) -> tuple[tuple[int, ...] | None, int]:
    """Write the descriptions as they come; their shape, None where there are none, and number."""
    writer: PartWriter | None = None
    shape: tuple[int, ...] | None = None
    for descriptions, entries in batches:
        if not len(entries):
            continue
        if writer is None or shape is None:
            shape = tuple(descriptions.shape[1:])
            writer = PartWriter(folder, _cells(shape))
        if tuple(descriptions.shape[1:]) != shape:
            raise ValueError(f"descriptions: expected shape {shape} as before, got {tuple(descriptions.shape[1:])}.")
        writer.append(descriptions.reshape(len(entries), -1).cpu().float().numpy(), entries)
    if writer is None:
        return None, 0
    writer.finish()
    return shape, writer.n


def _commit(
    path: Path,
    staged: Path,
    n: int,
    shape: tuple[int, ...] | None,
    about: dict[str, Any],
    searched_by: SearchDistance | None,
    before: dict[str, Any] | None,
    progress: bool,
) -> None:
    """Under the lock: the staged part joins those of the manifest, and a new manifest takes the place of the old."""
    if shape is None:
        if before is None:
            raise ValueError("descriptions: expected at least one to index, got none.")
        return
    index = VectorIndex(path) if before is not None else None
    if index is not None and shape != index.shape:
        raise ValueError(f"descriptions: expected shape {index.shape} as in {path}, got {shape}.")
    added = Part(staged, n, _cells(shape))
    old = [] if index is None else index.parts
    added = _without_the_known(added, old)
    parts = [part for part in [*old, added] if len(part) > len(part.removed)]
    vector_map, fitted_to = _map_for(parts, searched_by, index)
    if index is not None and vector_map is index.vector_map:
        joined = _joined_sizes([len(part) for part in parts])
    else:
        joined = [len(parts)]  # the vectors of all are made again
    listed, start = [], 0
    for n_joined in joined:
        group, start = parts[start : start + n_joined], start + n_joined
        if n_joined == 1 and group[0] is not added and len(group[0].removed) < _MOST_REMOVED * len(group[0]):
            listed.append(group[0])
            continue
        listed.append(_written(path, group, vector_map, progress))
    map_name = None
    if vector_map is not None:
        map_name = before["map"]["file"] if index is not None and vector_map is index.vector_map and before else None
        map_name = map_name or _save_map(path, vector_map)
    _write_manifest(path, {
        "format": _FORMAT,
        "about": about,
        "shape": list(shape),
        "searched_by": searched_by,
        "map": None if map_name is None else {"file": map_name, "fitted_to": fitted_to},
        "parts": [
            {
                "folder": part.folder.name,
                "n": len(part),
                "removed": sorted(part.removed),
                "files": sizes(part.folder),
            }
            for part in listed
        ],
    })  # fmt: skip
    _remove_unlisted(path)


def _without_the_known(added: Part, old: list[Part]) -> Part:
    """The new part without entries that are known; of `old`, in place, those lose entries that have new ones."""
    seen: dict[str, int] = {}
    skipped: set[int] = set()
    lost: list[set[int]] = [set() for _ in old]
    for rows in added.chunks():
        entries = added.entries(rows)
        known = [part.positions([entry.id for entry in entries]) for part in old]
        for row, entry in zip(rows.tolist(), entries, strict=True):
            if entry.id in seen:
                skipped.add(seen[entry.id])
            seen[entry.id] = row
            for part_lost, ids in zip(lost, known, strict=True):
                position, mark = ids.get(entry.id, (-1, ""))
                if position >= 0 and mark == entry.mark:
                    skipped.add(row)
                elif position >= 0:
                    part_lost.add(position)
    for i, part in enumerate(old):
        part.removed |= lost[i]
    added.removed = frozenset(skipped)
    return added


def _map_for(
    parts: list[Part], searched_by: SearchDistance | None, index: VectorIndex | None
) -> tuple[VectorMap | None, int]:
    """The map of short vectors, and to how many it was fitted; the old one until there are four times as many."""
    total = sum(len(part) - len(part.removed) for part in parts)
    if searched_by is None or total < _FEWEST_FOR_VECTORS:
        return None, 0
    if index is not None and index.vector_map is not None:
        fitted_to = index.manifest["map"]["fitted_to"]
        if not index.vector_map.changes or fitted_to >= _MOST_FITTED_TO or total < 4 * fitted_to:
            return index.vector_map, fitted_to
    generator = np.random.default_rng(0)
    share = min(1.0, _MOST_FITTED_TO / total)
    rows = []
    for part in parts:
        here = part.left(np.arange(len(part)))
        rows.append(part.descriptions(np.sort(generator.choice(here, int(np.ceil(share * len(here))), False))))
        part.forget()
    sample = np.concatenate(rows)
    return VectorMap.fit(sample, searched_by), len(sample)


def _joined_sizes(counts: Sequence[int]) -> list[int]:
    """How many neighbours to join, so that each part is at least twice as large as the next: few parts, few copies."""
    groups: list[tuple[int, int]] = []
    for count in counts:
        groups.append((1, count))
        while len(groups) > 1 and groups[-2][1] < 2 * groups[-1][1]:
            (n, last), (m, before) = groups.pop(), groups.pop()
            groups.append((n + m, last + before))
    return [n for n, _ in groups]


def _written(path: Path, group: Sequence[Part], vector_map: VectorMap | None, progress: bool) -> Part:
    """One part of the entries of several that are left, with vectors."""
    folder = path / f"{_PART}{secrets.token_hex(8)}"
    n_cells = group[0].n_cells
    if len(group) == 1 and not group[0].removed and group[0].folder.name.startswith(_STAGED):
        os.replace(group[0].folder, folder)
        n = len(group[0])
    else:
        writer = PartWriter(folder, n_cells)
        for part in group:
            for rows in part.chunks():
                left = part.left(rows)
                writer.append(part.descriptions(left), part.entries(left))
                part.forget()
        writer.finish()
        n = writer.n
    if vector_map is not None:
        add_vectors(Part(folder, n, n_cells), vector_map, progress=progress)
    flush(folder)
    return Part(folder, n, n_cells, vector_map)


def _save_map(path: Path, vector_map: VectorMap) -> str:
    name = f"map-{secrets.token_hex(8)}.npz"
    with (path / name).open("xb") as file:
        np.savez(file, **vector_map.arrays())
        file.flush()
        os.fsync(file.fileno())
    return name


def _load_map(path: Path, told: Mapping[str, Any] | None) -> VectorMap | None:
    if told is None:
        return None
    try:
        with np.load(path / told["file"], allow_pickle=False) as arrays:
            return VectorMap.of_arrays(arrays)
    except (EOFError, OSError, ValueError, zipfile.BadZipFile) as error:
        if isinstance(error, FileNotFoundError):
            raise
        raise ValueError(f"{path / told['file']} cannot be read") from error


def _manifest(path: Path) -> dict[str, Any] | None:
    """What the manifest says, None where there is none."""
    try:
        text = (path / _MANIFEST).read_text()
    except FileNotFoundError:
        return None
    except NotADirectoryError as error:
        raise ValueError(f"{path}: expected an index, which is a folder, got a file.") from error
    try:
        manifest: dict[str, Any] = json.loads(text)
        if manifest["format"] != _FORMAT:
            raise ValueError(manifest["format"])
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: its {_MANIFEST} is damaged or of another version. Build the index again.") from error
    return manifest


def _write_manifest(path: Path, manifest: Mapping[str, Any]) -> None:
    temporary = path / f"{_MANIFEST}.partial"
    with temporary.open("w") as file:
        file.write(json.dumps(manifest, indent=1) + "\n")
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path / _MANIFEST)
    if os.name != "nt":
        handle = os.open(path, os.O_RDONLY)
        os.fsync(handle)
        os.close(handle)


def _remove_unlisted(path: Path) -> None:
    """Under the lock: what no manifest names, left by a change before or by a process that was killed."""
    manifest = _manifest(path) or {"parts": [], "map": None}
    kept = {part["folder"] for part in manifest["parts"]} | {(manifest["map"] or {}).get("file")}
    for found in [*path.glob(f"{_PART}*"), *path.glob("map-*.npz")]:
        if found.name not in kept:
            shutil.rmtree(found, ignore_errors=True) if found.is_dir() else found.unlink(missing_ok=True)


def _remove_abandoned(path: Path) -> None:
    """Under the lock: what processes staged that no longer live, which their locks tell."""
    _remove_unlisted(path)
    filelock = _import_filelock()
    for lock in path.glob(f"{_STAGED}*.lock"):
        with contextlib.suppress(filelock.Timeout, OSError), filelock.FileLock(lock, timeout=0):
            shutil.rmtree(lock.with_suffix(""), ignore_errors=True)
            lock.unlink(missing_ok=True)


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Alone among all processes; the system unlocks what a killed process had locked."""
    with _import_filelock().FileLock(path):
        yield


def _import_filelock() -> Any:
    try:
        import filelock
    except ImportError as error:
        raise ImportError('an index needs filelock: pip install "interior-gps[index]".') from error
    return filelock


def _cells(shape: Sequence[int]) -> int:
    return int(np.prod(shape, dtype=np.int64))


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) < 80 else f"{text[:77]}..."
