"""`igps cache`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from igps.cli.reading import Folder, signatures
from igps.descriptors import descriptor as descriptor_of


def cache_export(root: Path, out: Path, descriptors: list[str] | None = None, **reading: Any) -> None:
    """Write the signatures of a folder to one file, which every command takes in place of the folder.

    The file is read by memory map, runs no code, and holds no path: meshes that cannot be used are left out.

    Args:
        root: folder of meshes, with or without classes.
        out: the file, such as signatures.igps.
        descriptors: whose needs the signatures shall satisfy; pretrained if not given.
    """
    chosen = [descriptor_of(name) for name in descriptors or ["pretrained"]]
    dataset, failures = signatures(Folder(root), chosen, **reading)
    out.parent.mkdir(parents=True, exist_ok=True)
    dataset.to_file(out)
    print(f"{len(dataset)} signatures written to {out}; {len(failures)} meshes skipped")
