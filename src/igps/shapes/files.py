"""Writing meshes so that an interrupted run leaves nothing half done."""

from __future__ import annotations

import uuid
from pathlib import Path

from igps.shapes.meshing import Faces
from igps.shapes.solids import Array


def off_text(vertices: Array, faces: Faces) -> str:
    """A mesh in the Object File Format; 17 digits give the same float64 values back."""
    lines = [f"OFF\n{len(vertices)} {len(faces)} 0"]
    lines += [f"{x:.17g} {y:.17g} {z:.17g}" for x, y, z in vertices.tolist()]
    lines += [f"3 {a} {b} {c}" for a, b, c in faces.tolist()]
    return "\n".join(lines) + "\n"


def is_whole_off(path: Path) -> bool:
    """Whether an OFF file is there with as many lines as its header promises."""
    if not path.is_file():
        return False
    text = path.read_bytes()
    header = text[:64].split()
    if len(header) < 3 or header[0] != b"OFF":
        return False
    return text.endswith(b"\n") and text.count(b"\n") == 2 + int(header[1]) + int(header[2])


def write_whole(path: Path, text: str) -> None:
    """Write a file under another name and move it into place, so that nobody sees a part of it."""
    temporary = path.with_name(f".{path.name}-{uuid.uuid4().hex}")
    try:
        temporary.write_text(text, encoding="utf-8", newline="\n")
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
