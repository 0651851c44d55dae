"""The columns of a gallery."""

from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor

KNOWN: dict[str, type] = {
    "id": str,
    "name": str,
    "class": str,
    "file": str,
    "part": str,
    "checksum": str,
    "bytes": int,
    "modified": int,
    "area": float,
    "volume": float,
    "unit": str,
}
"""Names and types of the columns that every gallery has, beside the description."""

Row = Mapping[str, Any]
Batch = tuple[Tensor, Sequence[Row]]
"""Descriptions (N, ...) and their rows: the columns `KNOWN`, and further ones of text or numbers."""

Found = tuple[list[dict[str, Any]], Tensor, Tensor]
"""Rows with their distances (M,) and descriptions (M, ...), closest first."""
