"""How a mesh is read from a file, and what may be repaired on the way."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import trimesh
from numpy.typing import NDArray

from igps.geometry.mesh import Mesh, MeshError, check_arrays
from igps.geometry.surface import components, diagonal, face_areas

logger = logging.getLogger(__name__)

Component = Literal["largest"]

# Vertices closer than this share of the bounding box's diagonal are one vertex to `repair`.
_WELD = 1e-8


@dataclass(frozen=True)
class MeshReading:
    """How a mesh file is read.

    Args:
        repair: weld coincident vertices, drop degenerate, duplicate and unreferenced elements, and orient the faces
            consistently.
        component: "largest" keeps only the connected component of the largest area.
        allow_open: accept open boundaries; inside and outside are then told apart by the winding number.

    Raises:
        ValueError: unknown component.
    """

    repair: bool = False
    component: Component | None = None
    allow_open: bool = False

    def __post_init__(self) -> None:
        if self.component is not None and self.component not in get_args(Component):
            raise ValueError(f"component: expected 'largest' or None, got {self.component!r}.")


def load_mesh(path: str | Path, reading: MeshReading = MeshReading()) -> Mesh:
    """Read a mesh file of any format that trimesh reads, and check it.

    Polygons are cut into triangles. Vertices keep their order, and are merged by repair alone.

    Args:
        path: the file.
        reading: what is done to it; logged, and kept in `Mesh.notes`.

    Raises:
        MeshError: the file is missing or unreadable, or the mesh is not usable (see `Mesh`).
    """
    path = Path(path)
    if not path.is_file():
        raise MeshError(f"{path}: no such file. Check the path.")
    try:
        loaded: Any = trimesh.load(path, process=False, force="mesh", **_loader_options(path))
        vertices, faces = np.asarray(loaded.vertices, dtype=np.float64), np.asarray(loaded.faces)
    except Exception as error:  # the loaders of some twenty formats raise whatever they like
        raise MeshError(
            f"{path}: not readable as a mesh ({type(error).__name__}: {error}). "
            "Check that the file is complete and in a format that trimesh reads (OFF, OBJ, PLY, STL, GLB, ...)."
        ) from error
    check_arrays(vertices, faces, str(path))
    notes: list[str] = []
    if reading.repair:
        vertices, faces = _repaired(vertices, faces, notes)
        check_arrays(vertices, faces, str(path))
    if reading.component == "largest":
        vertices, faces = _largest_component(vertices, faces, notes)
    for note in notes:
        logger.info("%s: %s", path, note)
    return Mesh(vertices, faces, name=str(path), allow_open=reading.allow_open, notes=tuple(notes))


def _loader_options(path: Path) -> dict[str, Any]:
    # Materials and texture seams would split vertices of an OBJ file that are one point of the surface.
    return {"skip_materials": True, "maintain_order": True} if path.suffix.lower() == ".obj" else {}


def _repaired(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], notes: list[str]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    # Welding happens on a lattice in units of the bounding box, because trimesh's own tolerance is an absolute length.
    centre, length = vertices.mean(axis=0), diagonal(vertices)
    lattice = np.round((vertices - centre) / (_WELD * max(length, np.finfo(float).tiny))).astype(np.int64)
    _, first, new_index = np.unique(lattice, axis=0, return_index=True, return_inverse=True)
    kept = np.sort(first)
    position = np.empty(len(first), dtype=np.int64)
    position[np.argsort(first)] = np.arange(len(first))
    if len(kept) < len(vertices):
        notes.append(f"welded {len(vertices) - len(kept)} coincident vertices")
    mesh = trimesh.Trimesh(vertices[kept], position[new_index.ravel()[faces]], process=False)

    sharp = (mesh.faces != np.roll(mesh.faces, 1, axis=1)).all(axis=1)
    for keep, what in ((sharp, "degenerate"), (None, "duplicate")):
        mask = mesh.unique_faces() if keep is None else keep
        if not mask.all():
            notes.append(f"dropped {int((~mask).sum())} {what} faces")
            mesh.update_faces(mask)
    unused = len(mesh.vertices) - len(np.unique(mesh.faces))
    if unused:
        notes.append(f"dropped {unused} unreferenced vertices")
        mesh.remove_unreferenced_vertices()
    before = mesh.faces.copy()
    trimesh.repair.fix_winding(mesh)
    turned = int((before != mesh.faces).any(axis=1).sum())
    if turned:
        notes.append(f"turned {turned} faces to orient the surface")
    return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)


def _largest_component(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], notes: list[str]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    count, label = components(faces, len(vertices))
    face_label = label[faces[:, 0]]
    area = np.bincount(face_label, weights=face_areas(vertices, faces), minlength=count)
    keep = face_label == int(np.argmax(area))
    used, new_faces = np.unique(faces[keep], return_inverse=True)
    n_dropped = len(np.unique(face_label)) - 1
    if n_dropped:
        notes.append(f"kept the largest of {n_dropped + 1} components ({len(used)} of {len(vertices)} vertices)")
    return vertices[used], new_faces.reshape(-1, 3)
