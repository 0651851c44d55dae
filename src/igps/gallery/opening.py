"""Opening a gallery. Only what is called here needs LanceDB."""

from pathlib import Path
from typing import Any

MANIFEST = "manifest.json"
"""File by which an index of version 0.2.0 is recognised."""


def is_gallery(path: str | Path) -> bool:
    """Return whether a folder is a gallery, or an index of version 0.2.0, which `open_table` refuses."""
    return any((Path(path) / name).exists() for name in ("bodies.lance", MANIFEST))


def tables() -> Any:
    """Import the module that needs LanceDB."""
    from igps.gallery import _table

    return _table


def open_table(path: str | Path, version: int | None = None) -> Any:
    """Open the table of a gallery. Raise a ValueError for an index of version 0.2.0, which has other Signatures."""
    if not tables().exists(Path(path)) and (Path(path) / MANIFEST).exists():
        raise ValueError(
            f"{path}: an index of version 0.2.0, of other signatures. Build a gallery in a new folder."
        )
    return tables().BodyTable(path, version)
