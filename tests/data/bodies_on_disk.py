"""Small meshes, written to files."""

from __future__ import annotations

from pathlib import Path

import trimesh


def write_body(path: Path, width: float, height: float) -> None:
    """A stretched ball of 162 vertices."""
    body = trimesh.creation.icosphere(subdivisions=2)
    body.vertices *= [1.0, width, height]
    path.parent.mkdir(parents=True, exist_ok=True)
    body.export(path)
