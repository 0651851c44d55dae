"""The bodies of a gallery as rows of a LanceDB table. Each change is one commit, and makes a version.

Writers wait for each other. Data left by a killed process are part of no version.
"""

import contextlib
import io
import json
import re
import secrets
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import timedelta
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from igps.gallery._codes import CODE, CodeIndex, Coder
from igps.gallery.columns import KNOWN, Batch, Row
from igps.retrieval.vectors import SearchDistance

try:
    import lancedb
    import pyarrow as pa
    from filelock import FileLock
    from lancedb.index import BTree
except ImportError as error:
    raise ImportError('a gallery needs LanceDB: pip install "interior-gps[index]".') from error

_BODIES, _MAP, _ABOUT = "bodies", "map-", b"gallery"
_MIN_ROWS_FOR_CODES = 4096  # the rows of a smaller table are all compared
_REFIT_FACTOR = 8  # the encoder is fitted again whenever the table has grown by this factor
_INDEX_INTERVAL = 32  # versions after which new rows are added to the indices of columns
_MAX_SINGLE = 1024  # numbers; longer descriptions are stored in half precision
_BATCH_SIZE = 1024  # rows
_ARROW_TYPES = {str: pa.string(), int: pa.int64(), float: pa.float64(), bytes: pa.binary()}


_SOURCE_LOCATION = re.compile(r", /\S+\.rs:.*")  # at the end of LanceDB's error messages


@contextlib.contextmanager
def engine_errors_as(sentence: str) -> Iterator[None]:
    """Raise errors of LanceDB as a ValueError with a sentence, followed by the first line of the original message."""
    try:
        yield
    except (ValueError, RuntimeError, OSError, KeyError, TypeError, IndexError) as error:
        reason = (
            _SOURCE_LOCATION.sub("", str(error).splitlines()[0])[:200]
            if str(error)
            else type(error).__name__
        )
        raise ValueError(f"{sentence} ({reason}).") from error


class BodyTable:
    """The rows of the gallery in a folder, in its last version or an earlier one. Raises the errors of `Gallery`."""

    def __init__(self, path: str | Path, version: int | None = None) -> None:
        self.path = Path(path)
        if not exists(self.path):
            raise FileNotFoundError(
                f"{path}: no gallery there, or one whose build did not finish. Build it."
            )
        with self._translated_errors(None):
            self.table = lancedb.connect(self.path).open_table(_BODIES)
        with engine_errors_as(
            f"version: expected one that `igps gallery versions` lists, got {version}"
        ):
            self.table.checkout(self.table.version if version is None else version)
        self._read_head()

    def _read_head(self) -> None:
        with self._translated_errors(None):
            schema = self.table.schema
            if (
                b"embedding_functions" in schema.metadata
            ):  # LanceDB would import and run the models that it names
                raise ValueError("it names models to load")
            self.head: dict[str, Any] = json.loads(schema.metadata[_ABOUT])
            self.about, self.shape = self.head["about"], tuple(self.head["shape"])
            self.coder: Coder | None = None
            self._codes: CodeIndex | None = None
            types = {arrow: python for python, arrow in _ARROW_TYPES.items()}
            self.columns = {
                column.name: types[column.type] for column in schema if column.type in types
            }
            if schema.field("vector").type.list_size != np.prod(self.shape) + 1:
                raise ValueError(
                    f"descriptions of {schema.field('vector').type}, not of shape {self.shape}"
                )
            if name := self.head["map"]:
                file = lancedb.connect(self.path).open_table(name).to_arrow()["arrays"][0].as_py()
                with np.load(io.BytesIO(file), allow_pickle=False) as arrays:
                    self.coder = Coder.of_arrays(arrays)

    def __len__(self) -> int:
        return int(self.table.count_rows())

    def batches(self, where: str | None = None, columns: Sequence[str] = ()) -> Iterator[Any]:
        """Yield Arrow tables of rows in batches; without `columns`, with all columns that `decoded` needs."""
        with self._translated_errors(where):
            request = self._request(where, *(columns or (*self.columns, "vector")))
            yield from (
                pa.Table.from_batches([batch])
                for batch in request.to_batches(_BATCH_SIZE)
                if batch.num_rows
            )

    def _request(self, where: str | None, *columns: str) -> Any:
        request = self.table.search().select([*columns])
        if where is not None:
            # LanceDB ignores text after a complete condition, but inside a cast it has to parse all of it
            self.table.search().where(f"CAST({where}\nAS BOOLEAN)").explain_plan()
            request = request.where(where)
        return request.with_row_id("_rowid" in columns)

    def with_row_ids(self, where: str | None, *columns: str) -> Any:
        """Return an Arrow table of rows with their LanceDB row ids."""
        with self._translated_errors(where):
            return self._request(where, "_rowid", *columns).to_arrow()

    def decoded(self, rows: Any) -> tuple[Tensor, list[dict[str, Any]]]:
        """Return the descriptions and the metadata of an Arrow table of rows."""
        return self.descriptions(rows), rows.select(list(self.columns)).to_pylist()

    def descriptions(self, rows: Any) -> Tensor:
        values = (
            torch.from_numpy(np.array(rows["vector"].combine_chunks().flatten()))
            .float()
            .reshape(len(rows), -1)
        )
        return torch.ldexp(values[:, :-1], values[:, -1:]).reshape(-1, *self.shape)

    def code_index(self) -> CodeIndex | None:
        """Return the codes of all rows, which are read once; None for a table without codes."""
        if self._codes is None and self.coder is not None:
            rows = self.with_row_ids(None, "code")
            with self._translated_errors(None):
                codes = rows["code"].combine_chunks().flatten().to_numpy()
                self._codes = CodeIndex(self.coder, codes.view(CODE), rows["_rowid"].to_numpy())
        return self._codes

    def take(self, row_ids: Any, *columns: str) -> Any:
        """Return an Arrow table of the rows with some LanceDB row ids."""
        with self._translated_errors(None):
            return (
                self.table.take_row_ids(np.asarray(row_ids).tolist())
                .with_row_id()
                .select([*columns])
                .to_arrow()
            )

    def add(self, descriptions: Tensor, rows: Sequence[Row], further: Mapping[str, type]) -> None:
        """Add rows with distinct ids, in place of rows of these ids. `further` has types of columns beside `KNOWN`."""
        with self.changing():
            self.check_shape(descriptions)
            n_before = len(self)
            self.check_kinds(further)
            if new := further.keys() - self.columns.keys():
                self.table.add_columns(
                    pa.schema([(name, _ARROW_TYPES[further[name]]) for name in sorted(new)])
                )
                self._read_head()
            arrow = _encoded((descriptions, rows), self.columns, self.coder).select(
                self.table.schema.names
            )
            merging = (
                self.table.merge_insert("id")
                .when_matched_update_all()
                .when_not_matched_insert_all()
            )
            merging.execute(arrow.cast(self.table.schema))
            steps = _MIN_ROWS_FOR_CODES * _REFIT_FACTOR ** np.arange(10)
            if self.head["searched_by"] and ((n_before < steps) & (steps <= len(self))).any():
                offsets = np.linspace(0, len(self) - 1, _MIN_ROWS_FOR_CODES).astype(int).tolist()
                sample = self.descriptions(
                    self.table.take_offsets(offsets).select(["vector"]).to_arrow()
                )
                _overwrite(
                    self.path, self.head, map(self.decoded, self.batches()), self.columns, sample
                )

    @contextlib.contextmanager
    def changing(self, where: str | None = None) -> Iterator[Any]:
        """Yield LanceDB's table, at its last version and locked for other writers, and commit a new version."""
        with write_lock(self.path):
            self.table.checkout_latest()
            self._read_head()
            with contextlib.nullcontext() if where is None else self._translated_errors(where):
                self._request(where, "id")
                yield self.table
            self.table.checkout_latest()
            _index(self.table)
            self.table.checkout(self.table.version)
            self._read_head()

    def check_kinds(self, further: Mapping[str, type]) -> None:
        """Raise a ValueError if a column of numbers would get text."""
        for name, kind in further.items():
            if self.columns.get(name, kind) not in (kind, str):
                raise ValueError(
                    f"{name}: expected numbers as in {self.path}, got text. Correct the labels."
                )

    def check_shape(self, descriptions: Tensor) -> None:
        if (shape := tuple(descriptions.shape[1:])) != self.shape:
            raise ValueError(
                f"descriptions: expected shape {self.shape} as in {self.path}, got {shape}."
            )

    def _translated_errors(self, where: str | None) -> contextlib.AbstractContextManager[None]:
        if where is None:
            return engine_errors_as(
                f"{self.path}: the gallery is damaged. Restore a version of it, or build it again"
            )
        return engine_errors_as(
            f"where: expected a condition on the columns {', '.join(self.columns)}, got {where!r}"
        )


def check_place(path: Path) -> None:
    """Raise a ValueError if no gallery can be built at a path."""
    foreign = (
        ["a file"]
        if path.is_file()
        else [
            f"a folder with {entry.name}"
            for entry in path.glob("*")
            if not entry.name.startswith((_BODIES, _MAP, "lock"))
        ]
    )
    if foreign:
        raise ValueError(
            f"{path}: expected a gallery or a new folder, got {min(foreign)}. Name another."
        )


def write(
    path: Path,
    about: Row,
    searched_by: SearchDistance | None,
    batches: Iterable[Batch],
    further: Mapping[str, type],
) -> None:
    """Write a table of at least one row. A table that exists already becomes an earlier version of it.

    Candidates are found by the distance `searched_by`, if it is given. The encoder is fitted to the first few thousand
    rows, which should be typical. The metadata `about` are stored as JSON; `further` is that of `BodyTable.add`.
    """
    check_place(path)
    batches, first = (batch for batch in batches if len(batch[1])), list[Batch]()
    while sum(len(rows) for _, rows in first) < _MIN_ROWS_FOR_CODES and (
        batch := next(batches, None)
    ):
        first.append(batch)
    if not first:
        raise ValueError("descriptions: expected at least one for the gallery, got none.")
    sample = torch.cat([descriptions for descriptions, _ in first])
    head = {"about": dict(about), "shape": list(sample.shape[1:]), "searched_by": searched_by}
    with write_lock(path):
        _index(_overwrite(path, head, chain(first, batches), {**KNOWN, **further}, sample))


def _overwrite(
    path: Path, head: Row, batches: Iterable[Batch], columns: Mapping[str, type], sample: Tensor
) -> Any:
    """Write a version with only these rows, under the lock; fit an encoder to the sample if it is large enough."""
    coder, name = None, None
    if head["searched_by"] and len(sample) >= _MIN_ROWS_FOR_CODES:
        coder = Coder.fit(sample.flatten(1).float().numpy(), head["searched_by"])
        file, name = io.BytesIO(), _MAP + secrets.token_hex(8)
        np.savez(file, **coder.arrays())
        lancedb.connect(path).create_table(
            name, pa.table({"arrays": pa.array([file.getvalue()], pa.large_binary())})
        )
    schema = _encoded((sample[:1], [{}]), columns, coder).schema
    schema = schema.with_metadata({_ABOUT: json.dumps({**head, "map": name})})
    rows = (
        part
        for batch in batches
        for part in _encoded(batch, columns, coder).cast(schema).to_batches()
    )
    reader = pa.RecordBatchReader.from_batches(schema, rows)
    mode = "overwrite" if exists(path) else "create"
    return lancedb.connect(path).create_table(_BODIES, reader, mode=mode)


def _index(table: Any) -> None:
    """Index the columns of a large table, under the lock; now and then update the indices and drop old versions."""
    indexed = {index.columns[0] for index in table.list_indices()}
    for column in table.schema.names if table.count_rows() >= _MIN_ROWS_FOR_CODES else ():
        if column not in {"vector", "code", "thumbnail", *indexed}:
            table.create_index(column, config=BTree())
    if table.version % _INDEX_INTERVAL == 0:
        table.optimize(cleanup_older_than=timedelta(days=30))


def _encoded(batch: Batch, columns: Mapping[str, type], coder: Coder | None) -> Any:
    """Return an Arrow table of descriptions and metadata.

    Long descriptions are stored in half precision, which keeps each number to 0.05 %. The last component of a vector is
    the power of two that the others are multiplied by.
    """
    descriptions, rows = batch
    values = descriptions.flatten(1).cpu().float().numpy()
    if not np.isfinite(values).all():
        raise ValueError(
            "descriptions: expected finite numbers, got NaN or infinity. Find the mesh that causes them."
        )
    metadata = {
        name: pa.array(
            [None if row.get(name) is None else kind(row[name]) for row in rows], _ARROW_TYPES[kind]
        )
        for name, kind in columns.items()
    }
    is_long = values.shape[1] > _MAX_SINGLE
    scale = is_long * (np.frexp(np.abs(values).max(axis=1, keepdims=True))[1] - 15)
    numbers = {
        "vector": np.hstack([np.ldexp(values, -scale), scale]).astype("f2" if is_long else "f4")
    }
    if coder is not None:
        numbers["code"] = coder(values).view(np.uint8).reshape(len(rows), -1)
    lists = {
        name: pa.FixedShapeTensorArray.from_numpy_ndarray(array).storage
        for name, array in numbers.items()
    }
    return pa.table({**metadata, **lists})


def exists(path: Path) -> bool:
    return (path / f"{_BODIES}.lance" / "_versions").is_dir()


def write_lock(path: Path) -> FileLock:
    """Lock a gallery for other writers. The operating system releases the lock of a killed process."""
    path.mkdir(parents=True, exist_ok=True)
    # Polled often, because a process that writes repeatedly releases the lock only for a millisecond
    return FileLock(path / "lock", is_singleton=True, poll_interval=0.001)
