"""Opening a gallery. Only what is called here needs LanceDB."""

from pathlib import Path
from typing import Any

from igps.gallery.place import is_remote


def is_gallery(path: str | Path) -> bool:
    """Return whether a place holds a gallery."""
    if is_remote(path):
        return bool(tables().exists(path))
    return (Path(path) / "bodies.lance").exists()


def tables() -> Any:
    """Import the module that needs LanceDB."""
    from igps.gallery import table

    return table
