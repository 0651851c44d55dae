"""BinaryCIF: the tables of mmCIF as packed columns in a MessagePack file (Sehnal et al. 2020)."""

from collections.abc import Iterator
from itertools import count, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

# The largest entries have 5 million atoms, in some 20 bytes and 20 columns each.
MAX_BYTES = 2**27
_MAX_ROWS = 2**23
_MAX_VALUES = 2**27  # of a table
_MAX_OBJECTS = 2**17  # lists and maps of a file: some 20 for each column

_TYPES = {1: "i1", 2: "<i2", 3: "<i4", 4: "u1", 5: "<u2", 6: "<u4", 32: "<f4", 33: "<f8"}
_MISSING = {1: False, 2: None}  # gemmi writes them as "." and "?"

Table = dict[str, list[Any]]
Numbers = NDArray[Any]


def read_binary_cif(content: bytes) -> Iterator[tuple[str, dict[str, Table]]]:
    """Yield the name of each data block, and its tables by name, each with its columns by name.

    Raises:
        ValueError: the file is damaged, or claims more than a structure has.
        ImportError: msgpack is not installed.
    """
    try:
        import msgpack
    except ImportError as error:
        raise ImportError(
            'BinaryCIF needs msgpack: pip install "interior-gps[molecules]".'
        ) from error
    n_objects = count()

    def counted(item: Any) -> Any:
        if next(n_objects) > _MAX_OBJECTS:
            raise ValueError(f"more than {_MAX_OBJECTS} lists and maps")
        return item

    try:
        file = msgpack.unpackb(content, object_hook=counted, list_hook=counted)
        for block in file["dataBlocks"]:
            tables = {str(table["name"]): _columns(table) for table in block["categories"]}
            yield str(block["header"]), tables
    except (KeyError, TypeError, AttributeError, ArithmeticError) as error:
        raise ValueError(f"no BinaryCIF: {type(error).__name__} {error}") from error


def _columns(table: dict[str, Any]) -> Table:
    n_rows = table["rowCount"]
    if n_rows * len(table["columns"]) > _MAX_VALUES:
        raise ValueError(f"{table['name']} has more than {_MAX_VALUES} values")
    columns = {}
    for column in table["columns"]:
        values = _decoded(column["data"])
        if column["mask"]:
            mask = _decoded(column["mask"])
            values = [_MISSING.get(m, value) for m, value in zip(mask, values, strict=True)]
        if len(values) != n_rows:
            raise ValueError(f"{table['name']}.{column['name']} has not {n_rows} rows")
        columns[str(column["name"])] = values
    return columns


def _decoded(packed: dict[str, Any]) -> list[Any]:
    """Return the values of a column, which are numbers or strings."""
    data = packed["data"]
    encoding = packed["encoding"]
    last = encoding[0]
    if last["kind"] != "StringArray":
        return _numbers(data, encoding).tolist()
    ends = _numbers(last["offsets"], last["offsetEncoding"]).tolist()
    strings = dict(enumerate(last["stringData"][start:end] for start, end in pairwise(ends)))
    strings[-1] = ""
    return [strings[i] for i in _numbers(data, last["dataEncoding"]).tolist()]


def _numbers(data: bytes, encoding: list[dict[str, Any]]) -> Numbers:
    """Return the numbers of packed bytes: their encodings are undone, the last one first."""
    *others, bytes_of = encoding
    values = np.frombuffer(data, _TYPES[bytes_of["type"]])
    for step in reversed(others):
        match step["kind"]:
            case "IntegerPacking":
                values = _unpacked(values)
            case "Delta":
                values = step["origin"] + np.cumsum(values, dtype=np.int64)
            case "RunLength":
                values = _repeated(values[::2], values[1::2])
            case "FixedPoint":
                values = values / step["factor"]
            case "IntervalQuantization":
                width = (step["max"] - step["min"]) / (step["numSteps"] - 1)
                values = step["min"] + width * values
            case kind:
                raise ValueError(f"unknown encoding {kind}")
    return values


def _unpacked(values: Numbers) -> Numbers:
    """Return the sums of runs of the largest or smallest number of a type with the number that follows."""
    limits = np.iinfo(values.dtype)
    goes_on = values == limits.max
    if limits.min < 0:
        goes_on |= values == limits.min
    sums = np.cumsum(values, dtype=np.int64)
    return np.diff(sums[~goes_on], prepend=0)


def _repeated(values: Numbers, counts: Numbers) -> Numbers:
    if counts.sum(dtype=np.float64) > _MAX_ROWS:
        raise ValueError(f"more than {_MAX_ROWS} rows")
    return np.repeat(values, counts)
