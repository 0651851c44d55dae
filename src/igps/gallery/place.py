"""Where a gallery lies: in a folder or in an object store."""

import re
from pathlib import Path

_SCHEME = re.compile(r"([a-z][a-z0-9+-]+):/+")  # two letters at least: C:/ is a drive


def is_remote(path: str | Path) -> bool:
    """Return whether a place is in an object store, such as s3://bucket/gallery."""
    return _SCHEME.match(str(path)) is not None


def address(path: str | Path) -> str:
    """Return a place as LanceDB takes it. A `Path` has lost one slash of s3://bucket/gallery."""
    if isinstance(path, Path) and is_remote(path):
        return _SCHEME.sub(r"\1://", str(path), count=1)
    return str(path)
