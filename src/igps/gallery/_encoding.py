"""Descriptions and metadata as columns of an Arrow table, and back."""

import io
import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from igps._arrays import Singles
from igps.gallery.columns import Batch, Row
from igps.retrieval.vectors import VectorMap

try:
    import pyarrow as pa
except ImportError as error:
    raise ImportError('a gallery needs LanceDB: pip install "interior-gps[index]".') from error

ARROW_TYPES = {str: pa.string(), int: pa.int64(), float: pa.float64()}
"""Types of the columns of metadata."""

_HEAD = b"gallery"  # key of the metadata of a table
_MAX_SINGLE = 1024  # numbers; longer descriptions are stored in half precision


def map_to_table(short: VectorMap) -> Any:
    """Return an Arrow table of one row that holds a map to short vectors."""
    file = io.BytesIO()
    np.savez(file, **short.arrays())
    column = pa.array([file.getvalue()], pa.large_binary())
    return pa.table({"arrays": column})


def map_of_table(table: Any) -> VectorMap:
    """Read what `map_to_table` wrote."""
    file = io.BytesIO(table["arrays"][0].as_py())
    with np.load(file, allow_pickle=False) as arrays:
        return VectorMap.of_arrays(arrays)


def rows_of(descriptions: Tensor) -> Singles:
    """Return descriptions (N, ...) as an array (N, F)."""
    rows: Singles = descriptions.flatten(1).cpu().float().numpy()
    return rows


def encoded(batch: Batch, columns: Mapping[str, type], short: VectorMap | None) -> Any:
    """Return an Arrow table of metadata, of descriptions in `vector`, and of short vectors in `short`.

    Long descriptions are stored in half precision, which keeps each number to 0.05 %. The last component of a vector is
    the power of two that the others are multiplied by.
    """
    descriptions, rows = batch
    values = rows_of(descriptions)
    if not np.isfinite(values).all():
        raise ValueError(
            "descriptions: expected finite numbers, got NaN or infinity. Find the mesh that causes them."
        )
    table = pa.table({name: _column(name, kind, rows) for name, kind in columns.items()})
    table = _with_list(table, "vector", _scaled(values))
    if short is not None:
        # LanceDB's index leaves out rows without a vector, so that none may come without
        table = _with_list(table, "short", short(values), nullable=False)
    return table


def _column(name: str, kind: type, rows: Any) -> Any:
    values = [row.get(name) for row in rows]
    typed = [None if value is None else kind(value) for value in values]
    return pa.array(typed, ARROW_TYPES[kind])


def _scaled(values: Singles) -> Any:
    """Return values (N, F) over a power of two for each row, and the exponent of that power: (N, F + 1)."""
    if values.shape[1] <= _MAX_SINGLE:
        return np.pad(values, ((0, 0), (0, 1)))
    largest = np.abs(values).max(axis=1, keepdims=True)
    _, exponents = np.frexp(largest)
    exponents = exponents - 15  # half precision ends at 2¹⁶
    scaled = np.ldexp(values, -exponents)
    return np.hstack([scaled, exponents]).astype(np.float16)


def _with_list(table: Any, name: str, values: Any, nullable: bool = True) -> Any:
    column = pa.FixedShapeTensorArray.from_numpy_ndarray(values).storage
    return table.append_column(pa.field(name, column.type, nullable), column)


def decoded(rows: Any, shape: tuple[int, ...]) -> Tensor:
    """Return the descriptions of an Arrow table."""
    flat = np.array(rows["vector"].combine_chunks().flatten())
    n_values = math.prod(shape)
    vectors = torch.from_numpy(flat).float().reshape(len(rows), n_values + 1)
    scaled, exponents = vectors.split([n_values, 1], dim=1)
    return torch.ldexp(scaled, exponents).reshape(-1, *shape)


def with_head(schema: Any, head: Row) -> Any:
    """Return a schema that carries the metadata of a table."""
    return schema.with_metadata({_HEAD: json.dumps(dict(head))})


def head_of(schema: Any) -> dict[str, Any]:
    """Return the metadata of a table; raise an error if they are not those of a gallery."""
    # LanceDB would import and run the models that this entry names
    if b"embedding_functions" in schema.metadata:
        raise ValueError("it names models to load")
    head: dict[str, Any] = json.loads(schema.metadata[_HEAD])
    length = schema.field("vector").type.list_size
    shape = tuple(head["shape"])
    if length != np.prod(shape) + 1:
        raise ValueError(f"descriptions of {length} numbers, not of shape {shape}")
    return head


def kinds_of(schema: Any) -> dict[str, type]:
    """Return the names and types of the columns of metadata."""
    kinds = {arrow: python for python, arrow in ARROW_TYPES.items()}
    return {field.name: kinds[field.type] for field in schema if field.type in kinds}
