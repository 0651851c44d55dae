"""The bodies of a gallery as rows of a LanceDB table. Each change is one commit, and makes a version.

The table lies in a folder or in an object store. In a folder, writers wait for each other. Data left by a killed
process are part of no version.

A large table has short vectors beside the descriptions (see `VectorMap`). LanceDB's index of them finds a few
hundred candidates, which are ranked by the distance between full descriptions.
"""

import contextlib
import re
import secrets
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import timedelta
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from filelock import FileLock
from torch import Tensor

from igps._threads import one_thread
from igps.gallery.columns import KNOWN, Batch, Found, Row
from igps.gallery.place import address, is_remote
from igps.retrieval.distances import Distance
from igps.retrieval.vectors import SearchDistance, VectorMap

try:
    import lancedb
    import pyarrow as pa
    from lancedb.index import BTree, IvfSq

    from igps.gallery._encoding import (
        ARROW_TYPES,
        decoded,
        encoded,
        head_of,
        kinds_of,
        map_of_table,
        map_to_table,
        rows_of,
        with_head,
    )
except ImportError as error:
    raise ImportError('a gallery needs LanceDB: pip install "interior-gps[index]".') from error

_BODIES, _MAP = "bodies", "map-"
_MIN_ROWS_FOR_INDEX = 4096  # the rows of a smaller table are all compared
_REFIT_FACTOR = 8  # map and index are made again whenever the table has grown by this factor
_INDEX_INTERVAL = 32  # versions after which new rows are added to the indices
_ROWS_PER_PARTITION = 4096  # of the index
# At least this share of the partitions is searched, and at least this many of them; more, if too few rows there satisfy
# a condition
_MIN_SHARE = 1 / 12
_MIN_PROBES = 20
_BATCH_SIZE = 1024  # rows
_SOURCE_LOCATION = re.compile(r", /\S+\.rs:.*")  # at the end of LanceDB's error messages


@contextlib.contextmanager
def engine_errors_as(sentence: str) -> Iterator[None]:
    """Raise errors of LanceDB as a ValueError with a sentence, followed by the first line of the original message."""
    try:
        yield
    except (ValueError, RuntimeError, OSError, KeyError, TypeError, IndexError) as error:
        reason = type(error).__name__
        if str(error):
            first_line = str(error).splitlines()[0]
            reason = _SOURCE_LOCATION.sub("", first_line)[:200]
        raise ValueError(f"{sentence} ({reason}).") from error


class BodyTable:
    """The rows of the gallery in a folder or object store, in its last version. Raises the errors of `Gallery`."""

    def __init__(self, path: str | Path) -> None:
        self.path = path
        if not exists(path):
            raise FileNotFoundError(
                f"{path}: no gallery there, or one whose build did not finish. Build it."
            )
        with self._translated_errors(None):
            self.table = _database(path).open_table(_BODIES)
            self.table.checkout(self.table.version)
        self._read_head()

    def _read_head(self) -> None:
        with self._translated_errors(None):
            schema = self.table.schema
            self.head = head_of(schema)
            self.about: dict[str, Any] = self.head["about"]
            self.shape: tuple[int, ...] = tuple(self.head["shape"])
            self.columns = kinds_of(schema)
            self.short: VectorMap | None = None
            if self.head["map"]:
                stored = _database(self.path).open_table(self.head["map"])
                self.short = map_of_table(stored.to_arrow())

    def __len__(self) -> int:
        return int(self.table.count_rows())

    def batches(self, where: str | None = None, columns: Sequence[str] = ()) -> Iterator[Any]:
        """Yield Arrow tables of rows in batches; without `columns`, with all columns that `decoded` needs."""
        names = columns or (*self.columns, "vector")
        with self._translated_errors(where):
            request = self._restricted(self.table.search().select([*names]), where)
            request = request.with_row_id("_rowid" in names)
            for batch in request.to_batches(_BATCH_SIZE):
                if batch.num_rows:
                    yield pa.Table.from_batches([batch])

    def _restricted(self, request: Any, where: str | None) -> Any:
        if where is None:
            return request
        # LanceDB ignores text after a complete condition, but inside a cast it has to parse all of it
        self.table.search().where(f"CAST({where}\nAS BOOLEAN)").explain_plan()
        return request.where(where)

    def decoded(self, rows: Any) -> tuple[Tensor, list[dict[str, Any]]]:
        """Return the descriptions and the metadata of an Arrow table of rows."""
        return decoded(rows, self.shape), rows.select(list(self.columns)).to_pylist()

    @one_thread()
    def nearest(
        self,
        query: Tensor,
        distance: Distance,
        *,
        top: int,
        candidates: int = 512,
        exact: bool = False,
        where: str | None = None,
    ) -> Found:
        """Return the rows closest to a query (1, ...), their distances (M,) and descriptions (M, ...), M ≤ top.

        Ties are ordered by id. Only the max(candidates, 2 * top) rows that are nearest by their short vectors are
        compared, or all rows if `exact` is set or the table has no short vectors.
        """
        self._check_shape(query)
        if exact or self.short is None:
            groups = self.batches(where, ("_rowid", "vector"))
        else:
            groups = iter([self._candidates(query, max(candidates, 2 * top), where)])
        ids = np.zeros(0, np.uint64)
        distances = torch.zeros(0)
        nearest = torch.zeros(0, *self.shape)
        for group in groups:
            ids = np.append(ids, group["_rowid"].to_numpy())
            nearest = torch.cat([nearest, decoded(group, self.shape)])
            if not len(ids):
                continue
            distances = distance(query, nearest.to(query.device)).cpu()[0]
            best = distances <= distances.kthvalue(min(top, len(ids))).values
            ids = ids[best.numpy()]
            distances = distances[best]
            nearest = nearest[best]
        rows = self._rows_of(ids)
        order = np.lexsort(([row["id"] for row in rows], distances.numpy()))[:top]
        return [rows[i] for i in order], distances[order], nearest[order]

    def _candidates(self, query: Tensor, n: int, where: str | None) -> Any:
        """Return an Arrow table of the n rows with the short vectors nearest to that of a query (1, ...)."""
        assert self.short is not None
        vector = self.short(rows_of(query))[0]
        n_probes = max(_MIN_PROBES, int(_MIN_SHARE * _n_partitions(len(self))))
        with self._translated_errors(where):
            request = self.table.search(vector, vector_column_name="short").distance_type("l2")
            request = request.minimum_nprobes(n_probes).maximum_nprobes(0)  # 0: as many as needed
            request = self._restricted(request, where).limit(n)
            return request.with_row_id(True).select(["vector", "_distance"]).to_arrow()

    def _rows_of(self, row_ids: Any) -> list[dict[str, Any]]:
        """Return the metadata of the rows with some LanceDB row ids, in their order."""
        if not len(row_ids):
            return []
        with self._translated_errors(None):
            request = self.table.take_row_ids(row_ids.tolist()).with_row_id()
            found = request.select(list(self.columns)).to_arrow().to_pylist()
        by_id = {row.pop("_rowid"): row for row in found}
        return [by_id[row_id] for row_id in row_ids.tolist()]

    def add(self, descriptions: Tensor, rows: Sequence[Row], further: Mapping[str, type]) -> None:
        """Add rows with distinct ids, in place of rows of these ids. `further` has types of columns beside `KNOWN`."""
        with self.changing():
            self._check_shape(descriptions)
            self._check_kinds(further)
            n_before = len(self)
            new = sorted(further.keys() - self.columns.keys())
            if new:
                fields = [(name, ARROW_TYPES[further[name]]) for name in new]
                self.table.add_columns(pa.schema(fields))
                self._read_head()
            schema = self.table.schema
            arrow = encoded((descriptions, rows), self.columns, self.short)
            merging = self.table.merge_insert("id").when_matched_update_all()
            merging = merging.when_not_matched_insert_all()
            merging.execute(arrow.select(schema.names).cast(schema))
            steps = _MIN_ROWS_FOR_INDEX * _REFIT_FACTOR ** np.arange(10)
            passed = (n_before < steps) & (steps <= len(self))
            if self.head["searched_by"] and passed.any():
                self._refit()

    def _refit(self) -> None:
        """Write all rows again, with short vectors by a map that is fitted to the present rows."""
        chosen = np.linspace(0, len(self) - 1, _MIN_ROWS_FOR_INDEX).astype(int).tolist()
        sample = decoded(self.table.take_offsets(chosen).select(["vector"]).to_arrow(), self.shape)
        batches = map(self.decoded, self.batches())
        _overwrite(self.path, self.head, batches, self.columns, sample)

    @contextlib.contextmanager
    def changing(self, where: str | None = None) -> Iterator[Any]:
        """Yield LanceDB's table, at its last version and locked for other writers, and commit a new version."""
        with write_lock(self.path):
            self.table.checkout_latest()
            self._read_head()
            # Without a condition, an error here has another cause than the condition
            translated: contextlib.AbstractContextManager[None] = contextlib.nullcontext()
            if where is not None:
                translated = self._translated_errors(where)
            with translated:
                self._restricted(self.table.search(), where)
                yield self.table
            self.table.checkout_latest()
            _index(self.table)
            self.table.checkout(self.table.version)
            self._read_head()

    def _check_kinds(self, further: Mapping[str, type]) -> None:
        """Raise a ValueError if a column of numbers would get text."""
        for name, kind in further.items():
            if self.columns.get(name, kind) not in (kind, str):
                raise ValueError(
                    f"{name}: expected numbers as in {self.path}, got text. Correct the labels."
                )

    def _check_shape(self, descriptions: Tensor) -> None:
        shape = tuple(descriptions.shape[1:])
        if shape != self.shape:
            raise ValueError(
                f"descriptions: expected shape {self.shape} as in {self.path}, got {shape}."
            )

    def _translated_errors(self, where: str | None) -> contextlib.AbstractContextManager[None]:
        if where is None:
            return engine_errors_as(
                f"{self.path}: the gallery is damaged. Restore a version of it, or build it again"
            )
        names = ", ".join(self.columns)
        return engine_errors_as(
            f"where: expected a condition on the columns {names}, got {where!r}"
        )


def check_place(path: str | Path) -> None:
    """Raise a ValueError if no gallery can be built at a place."""
    if is_remote(path):
        return
    if Path(path).is_file():
        raise ValueError(f"{path}: expected a gallery or a new folder, got a file. Name another.")
    names = [entry.name for entry in Path(path).glob("*")]
    foreign = [name for name in names if not name.startswith((_BODIES, _MAP, "lock"))]
    if foreign:
        raise ValueError(
            f"{path}: expected a gallery or a new folder, got a folder with {min(foreign)}. "
            "Name another."
        )


def write(
    path: str | Path,
    about: Row,
    searched_by: SearchDistance | None,
    batches: Iterable[Batch],
    further: Mapping[str, type],
    *,
    weights: Callable[[int], Sequence[float] | None] | None = None,
) -> None:
    """Write a table of at least one row. A table that exists already becomes an earlier version of it.

    Candidates are found by the distance `searched_by`, if it is given, of descriptions times
    `weights`, a function of their width. The map to short vectors is fitted to the first
    few thousand rows, which should be typical. The metadata `about` are stored as JSON; `further` is that of
    `BodyTable.add`.
    """
    check_place(path)
    batches = (batch for batch in batches if len(batch[1]))
    first: list[Batch] = []
    n_first = 0
    for batch in batches:
        first.append(batch)
        n_first += len(batch[1])
        if n_first >= _MIN_ROWS_FOR_INDEX:
            break
    if not first:
        raise ValueError("descriptions: expected at least one for the gallery, got none.")
    sample = torch.cat([descriptions for descriptions, _ in first])
    head = {
        "about": dict(about),
        "shape": list(sample.shape[1:]),
        "searched_by": searched_by,
        "weights": None if weights is None else weights(sample[0].numel()),
    }
    with write_lock(path):
        table = _overwrite(path, head, chain(first, batches), {**KNOWN, **further}, sample)
        _index(table)


def _overwrite(
    path: str | Path,
    head: Row,
    batches: Iterable[Batch],
    columns: Mapping[str, type],
    sample: Tensor,
) -> Any:
    """Write a version with only these rows, under the lock; fit a map to the sample if it is large enough."""
    database = _database(path)
    short = name = None
    if head["searched_by"] and len(sample) >= _MIN_ROWS_FOR_INDEX:
        short = VectorMap.fit(rows_of(sample), head["searched_by"], head["weights"])
        name = _MAP + secrets.token_hex(8)
        database.create_table(name, map_to_table(short))
    example = encoded((sample[:1], [{}]), columns, short)
    schema = with_head(example.schema, {**head, "map": name})

    def parts() -> Iterator[Any]:
        for batch in batches:
            yield from encoded(batch, columns, short).cast(schema).to_batches()

    reader = pa.RecordBatchReader.from_batches(schema, parts())
    mode = "overwrite" if exists(path) else "create"
    return database.create_table(_BODIES, reader, mode=mode)


def _index(table: Any) -> None:
    """Index the columns of a large table, under the lock; now and then update the indices and drop old versions."""
    n_rows = table.count_rows()
    if n_rows >= _MIN_ROWS_FOR_INDEX:
        indexed = {index.columns[0] for index in table.list_indices()}
        for column in table.schema.names:
            if column in {"vector", *indexed}:
                continue
            config: BTree | IvfSq = BTree()
            if column == "short":
                config = IvfSq(distance_type="l2", num_partitions=_n_partitions(n_rows))
            table.create_index(column, config=config)
    if table.version % _INDEX_INTERVAL == 0:
        table.optimize(cleanup_older_than=timedelta(days=30))


def _n_partitions(n_rows: int) -> int:
    return max(1, n_rows // _ROWS_PER_PARTITION)


def _database(path: str | Path) -> Any:
    return lancedb.connect(address(path))


def exists(path: str | Path) -> bool:
    """Return whether a place holds a complete table."""
    if is_remote(path):
        return _BODIES in _database(path).list_tables().tables
    return (Path(path) / f"{_BODIES}.lance" / "_versions").is_dir()


def write_lock(path: str | Path) -> contextlib.AbstractContextManager[Any]:
    """Lock a gallery in a folder for other writers. The operating system releases the lock of a killed process."""
    if is_remote(path):
        return contextlib.nullcontext()
    Path(path).mkdir(parents=True, exist_ok=True)
    # Polled often, because a process that writes repeatedly releases the lock only for a millisecond
    return FileLock(Path(path) / "lock", is_singleton=True, poll_interval=0.001)
