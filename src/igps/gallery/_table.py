"""The bodies of a gallery as rows of a LanceDB table. Each change is one commit, and makes a version.

The code of a short vector stands for each description (see `VectorMap` and `igps.gallery._codes`). By the codes, which
are read once, the nearest few hundred are found, which are ranked by the distance of the descriptions themselves; of
few bodies all are compared. Writers wait for each other, and what a killed process leaves behind belongs to no version.
"""

import contextlib
import io
import json
import secrets
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import timedelta
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from igps._threads import one_thread
from igps.gallery._codes import CODE, Coder, Codes
from igps.gallery.about import KNOWN, Batch, Row, engine_errors_as
from igps.retrieval.distances import Distance
from igps.retrieval.vectors import SearchDistance

try:
    import lancedb
    import pyarrow as pa
    from filelock import FileLock
    from lancedb.index import BTree
except ImportError as error:
    raise ImportError('a gallery needs LanceDB: pip install "interior-gps[index]".') from error

_BODIES, _MAP, _ABOUT = "bodies", "map-", b"gallery"
# Fewer are all compared; fitted anew when they are so many times more; changes after which new rows come to the indices
_FEWEST_FOR_CODES, _GROWN, _CHANGES = 4096, 8, 32
_MOST_IN_FULL, _ROWS_AT_ONCE = 1024, 1024  # longer descriptions are kept in half precision
_ARROW = {str: pa.string(), int: pa.int64(), float: pa.float64(), bytes: pa.binary()}


class BodyTable:
    """The rows of the gallery in a folder, of the last version or an earlier one; errors are those of `Gallery`."""

    def __init__(self, path: str | Path, version: int | None = None) -> None:
        self.path = Path(path)
        if not exists(self.path):
            raise FileNotFoundError(f"{path}: no gallery there, or its building was not finished. Build it.")
        with self._errors_told(None):
            self.table = lancedb.connect(self.path).open_table(_BODIES)
        with engine_errors_as(f"version: expected one of those that `igps gallery versions` lists, got {version}"):
            self.table.checkout(self.table.version if version is None else version)
        self._read_head()

    def _read_head(self) -> None:
        with self._errors_told(None):
            schema = self.table.schema
            if b"embedding_functions" in schema.metadata:  # LanceDB would load the models that they name
                raise ValueError("it names models to be loaded")
            self.head: dict[str, Any] = json.loads(schema.metadata[_ABOUT])
            self.about, self.shape = self.head["about"], tuple(self.head["shape"])
            self.coder: Coder | None = None
            self._codes: Codes | None = None
            self.columns = {one.name: kind for one in schema for kind, known in _ARROW.items() if known == one.type}
            if schema.field("vector").type.list_size != np.prod(self.shape) + 1:
                raise ValueError(f"descriptions of {schema.field('vector').type}, not of shape {self.shape}")
            if name := self.head["map"]:
                kept = lancedb.connect(self.path).open_table(name).to_arrow()["arrays"][0].as_py()
                with np.load(io.BytesIO(kept), allow_pickle=False) as arrays:
                    self.coder = Coder.of_arrays(arrays)

    def __len__(self) -> int:
        return int(self.table.count_rows())

    def batches(self, where: str | None = None, columns: Sequence[str] = ()) -> Iterator[Any]:
        """Arrow tables of the rows, some at a time; of all that `decoded` needs if no columns are named."""
        with self._errors_told(where):
            asked = self._asked(where, *(columns or (*self.columns, "vector")))
            yield from (pa.Table.from_batches([one]) for one in asked.to_batches(_ROWS_AT_ONCE) if one.num_rows)

    def _asked(self, where: str | None, *columns: str) -> Any:
        """A search for rows; the condition is read to its end, as LanceDB passes over what follows it."""
        asked = self.table.search().select([*columns])
        if where is not None:
            self.table.search().where(f"CAST({where}\nAS BOOLEAN)").explain_plan()
            asked = asked.where(where)
        return asked.with_row_id("_rowid" in columns)

    def _numbered(self, where: str | None, *columns: str) -> Any:
        """An Arrow table of rows with LanceDB's numbers of them."""
        with self._errors_told(where):
            return self._asked(where, "_rowid", *columns).to_arrow()

    def decoded(self, rows: Any) -> tuple[Tensor, list[dict[str, Any]]]:
        """Descriptions, and what is known of each, of an Arrow table of rows."""
        return self._descriptions(rows), rows.select(list(self.columns)).to_pylist()

    def _descriptions(self, rows: Any) -> Tensor:
        values = torch.from_numpy(np.array(rows["vector"].combine_chunks().flatten())).float().reshape(len(rows), -1)
        return torch.ldexp(values[:, :-1], values[:, -1:]).reshape(-1, *self.shape)

    @one_thread()
    def search(
        self, query: Tensor, distance: Distance, *, top: int, candidates: int = 512, exact: bool = False,
        where: str | None = None,
    ) -> tuple[list[dict[str, Any]], Tensor, Tensor]:  # fmt: skip
        """Rows, distances (M,) and descriptions (M, ...) of the M ≤ top closest to a description (1, ...), ties by id.

        Of as many as `candidates`, or twice top, that seem near by their codes; of all if exact, or if there are none.
        """
        self._check_shape(query)
        groups = self.batches(where, ("_rowid", "vector"))
        if not exact and self.coder is not None:
            named = None if where is None else self._numbered(where)["_rowid"].to_numpy()
            codes = self._all_codes(self.coder)
            near = codes.nearest(query.reshape(-1).cpu().float().numpy(), max(candidates, 2 * top), named)
            groups = iter([self._taken(near, "vector")] if len(near) else [])
        ids, distances, kept = np.zeros(0, np.uint64), torch.zeros(0), torch.zeros(0, *self.shape)
        for group in groups:
            ids, kept = np.append(ids, group["_rowid"].to_numpy()), torch.cat([kept, self._descriptions(group)])
            distances = distance(query, kept.to(query.device)).cpu()[0]
            best = distances <= distances.kthvalue(min(top, len(ids))).values
            ids, distances, kept = ids[best.numpy()], distances[best], kept[best]
        rows = {row.pop("_rowid"): row for row in (self._taken(ids, *self.columns).to_pylist() if len(ids) else ())}
        told = [rows[one] for one in ids.tolist()]
        first = np.lexsort(([row["id"] for row in told], distances.numpy()))[:top]
        return [told[i] for i in first], distances[first], kept[first]

    def _all_codes(self, coder: Coder) -> Codes:
        if self._codes is None:
            rows = self._numbered(None, "code")
            with self._errors_told(None):
                codes = rows["code"].combine_chunks().flatten().to_numpy()
                self._codes = Codes(coder, codes.view(CODE), rows["_rowid"].to_numpy())
        return self._codes

    def _taken(self, row_ids: Any, *columns: str) -> Any:
        """An Arrow table of rows by LanceDB's numbers of them; few columns are read sooner than many."""
        with self._errors_told(None):
            return self.table.take_row_ids(np.asarray(row_ids).tolist()).with_row_id().select([*columns]).to_arrow()

    def add(self, descriptions: Tensor, rows: Sequence[Row], further: Mapping[str, type]) -> None:
        """Add rows, no id twice, in place of those of the same id; of columns beside `KNOWN`, further by name."""
        with self.changing():
            self._check_shape(descriptions)
            n_before = len(self)
            self.check_kinds(further)
            if new := further.keys() - self.columns.keys():
                self.table.add_columns(pa.schema([(name, _ARROW[further[name]]) for name in sorted(new)]))
                self._read_head()
            arrow = _encoded((descriptions, rows), self.columns, self.coder).select(self.table.schema.names)
            merging = self.table.merge_insert("id").when_matched_update_all().when_not_matched_insert_all()
            merging.execute(arrow.cast(self.table.schema))
            steps = _FEWEST_FOR_CODES * _GROWN ** np.arange(10)
            if self.head["searched_by"] and ((n_before < steps) & (steps <= len(self))).any():
                some = np.linspace(0, len(self) - 1, _FEWEST_FOR_CODES).astype(int).tolist()
                sample = self._descriptions(self.table.take_offsets(some).select(["vector"]).to_arrow())
                _overwrite(self.path, self.head, map(self.decoded, self.batches()), self.columns, sample)

    @contextlib.contextmanager
    def changing(self, where: str | None = None) -> Iterator[Any]:
        """LanceDB's table, alone among those who write, from the last version to the next."""
        with alone(self.path):
            self.table.checkout_latest()
            self._read_head()
            with contextlib.nullcontext() if where is None else self._errors_told(where):
                self._asked(where, "id")
                yield self.table
            self.table.checkout_latest()
            _index(self.table)
            self.table.checkout(self.table.version)
            self._read_head()

    def check_kinds(self, further: Mapping[str, type]) -> None:
        """Raise a ValueError where a column of numbers would get text."""
        for name, kind in further.items():
            if self.columns.get(name, kind) not in (kind, str):
                raise ValueError(f"{name}: expected numbers as in {self.path}, got text. Correct the labels.")

    def _check_shape(self, descriptions: Tensor) -> None:
        if (found := tuple(descriptions.shape[1:])) != self.shape:
            raise ValueError(f"descriptions: expected shape {self.shape} as in {self.path}, got {found}.")

    def _errors_told(self, where: str | None) -> contextlib.AbstractContextManager[None]:
        if where is None:
            return engine_errors_as(f"{self.path}: the gallery is damaged. Restore a version of it, or build it again")
        return engine_errors_as(f"where: expected a condition on the columns {', '.join(self.columns)}, got {where!r}")


def check_place(path: Path) -> None:
    """Raise a ValueError where no gallery can be made."""
    strange = ["a file"] if path.is_file() else [f"one with {one.name}" for one in path.glob("*")
                                                 if not one.name.startswith((_BODIES, _MAP, "lock"))]  # fmt: skip
    if strange:
        raise ValueError(f"{path}: expected a gallery or a new folder, got {min(strange)}. Name another.")


def write(
    path: Path, about: Row, searched_by: SearchDistance | None, batches: Iterable[Batch], further: Mapping[str, type]
) -> None:
    """Make a table, in place of the one that is there, which stays an earlier version of it.

    Of what its users want to know of it, for JSON, the distance that finds candidates (None: all will be compared), and
    at least one row; the first few thousand should be like the others. Further columns are those beside `KNOWN`.
    """
    check_place(path)
    batches, first = (batch for batch in batches if len(batch[1])), list[Batch]()
    while sum(len(rows) for _, rows in first) < _FEWEST_FOR_CODES and (batch := next(batches, None)):
        first.append(batch)
    if not first:
        raise ValueError("descriptions: expected at least one for the gallery, got none.")
    sample = torch.cat([some for some, _ in first])
    head = {"about": dict(about), "shape": list(sample.shape[1:]), "searched_by": searched_by}
    with alone(path):
        _index(_overwrite(path, head, chain(first, batches), {**KNOWN, **further}, sample))


def _overwrite(path: Path, head: Row, batches: Iterable[Batch], columns: Mapping[str, type], sample: Tensor) -> Any:
    """Under the lock: a version of these rows alone; if they are many, with codes fitted to some of them."""
    coder, name = None, None
    if head["searched_by"] and len(sample) >= _FEWEST_FOR_CODES:
        coder = Coder.fit(sample.flatten(1).float().numpy(), head["searched_by"])
        file, name = io.BytesIO(), _MAP + secrets.token_hex(8)
        np.savez(file, **coder.arrays())
        lancedb.connect(path).create_table(name, pa.table({"arrays": pa.array([file.getvalue()], pa.large_binary())}))
    schema = _encoded((sample[:1], [{}]), columns, coder).schema
    schema = schema.with_metadata({_ABOUT: json.dumps({**head, "map": name})})
    rows = (one for batch in batches for one in _encoded(batch, columns, coder).cast(schema).to_batches())
    reader = pa.RecordBatchReader.from_batches(schema, rows)
    mode = "overwrite" if exists(path) else "create"
    return lancedb.connect(path).create_table(_BODIES, reader, mode=mode)


def _index(table: Any) -> None:
    """Under the lock: a large table gets indices; now and then new rows come to them, and versions of a month go."""
    n, listed = table.count_rows(), {one.columns[0] for one in table.list_indices()}
    for one in table.schema.names if n >= _FEWEST_FOR_CODES else ():
        if one not in {"vector", "code", "thumbnail", *listed}:
            table.create_index(one, config=BTree())
    if table.version % _CHANGES == 0:
        table.optimize(cleanup_older_than=timedelta(days=30))


def _encoded(batch: Batch, columns: Mapping[str, type], coder: Coder | None) -> Any:
    """An Arrow table; long descriptions in half precision, each number to 0.05 %, behind them the power of two."""
    descriptions, rows = batch
    values = descriptions.flatten(1).cpu().float().numpy()
    if not np.isfinite(values).all():
        raise ValueError("descriptions: expected finite numbers, got others. Look for the mesh that gives them.")
    told = {name: pa.array([None if row.get(name) is None else kind(row[name]) for row in rows], _ARROW[kind])
            for name, kind in columns.items()}  # fmt: skip
    is_long = values.shape[1] > _MOST_IN_FULL
    scale = is_long * (np.frexp(np.abs(values).max(axis=1, keepdims=True))[1] - 15)
    numbers = {"vector": np.hstack([np.ldexp(values, -scale), scale]).astype("f2" if is_long else "f4")}
    if coder is not None:
        numbers["code"] = coder(values).view(np.uint8).reshape(len(rows), -1)
    lists = {name: pa.FixedShapeTensorArray.from_numpy_ndarray(one).storage for name, one in numbers.items()}
    return pa.table({**told, **lists})


def exists(path: Path) -> bool:
    return (path / f"{_BODIES}.lance" / "_versions").is_dir()


def alone(path: Path) -> FileLock:
    """Alone among all processes that write; the system unlocks what a killed process had locked."""
    path.mkdir(parents=True, exist_ok=True)
    # Looked at often: a process that writes change after change is off the lock for a millisecond, and others starve.
    return FileLock(path / "lock", is_singleton=True, poll_interval=0.001)
