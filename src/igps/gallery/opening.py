"""Opening a gallery. Only what is called here needs LanceDB."""

from pathlib import Path
from typing import Any

from igps.gallery.place import is_remote

MANIFEST = "manifest.json"
"""File by which an index of version 0.2.0 is recognised."""


def is_gallery(path: str | Path) -> bool:
    """Return whether a place holds a gallery, or an index of version 0.2.0, which `open_table` refuses."""
    if is_remote(path):
        return bool(tables().exists(path))
    return any((Path(path) / name).exists() for name in ("bodies.lance", MANIFEST))


def tables() -> Any:
    """Import the module that needs LanceDB."""
    from igps.gallery import _table

    return _table


def open_table(path: str | Path) -> Any:
    """Open the table of a gallery. Raise a ValueError for an index of version 0.2.0, which has other Signatures."""
    if not tables().exists(path) and (Path(path) / MANIFEST).exists():
        raise ValueError(
            f"{path}: an index of version 0.2.0, of other signatures. Build a gallery in a new folder."
        )
    return tables().BodyTable(path)
