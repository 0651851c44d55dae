"""How a mesh is read from a file, and what may be done to it on the way."""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import trimesh
from numpy.typing import NDArray

from igps._threads import one_thread
from igps.mesh.limits import check_memory
from igps.mesh.mending import Mending, mend
from igps.mesh.mesh import Mesh, MeshError, check_arrays
from igps.mesh.surface import compact, face_parts

logger = logging.getLogger(__name__)
# What a file has against it is told by an error that names it; a traceback on the terminal, from trimesh's last resort
# where nobody has set up logging, says nothing to its reader
logging.getLogger("trimesh").addHandler(logging.NullHandler())

Component = Literal["largest"]

POINT_CLOUDS = frozenset({".xyz"})
"""Suffixes of files that hold points alone, as lines of three coordinates, or of six with normals."""

NEED_MODULES = frozenset({".3mf", ".3dxml", ".dae", ".zae", ".xaml", ".step", ".stp"})
"""Suffixes of files that trimesh reads by further modules. They are meshes where these are missing, too: a file that
cannot be read is to be named, not passed over."""

_WHOLE_NUMBERS = re.compile(r"\s*\d[\d\s]*", re.ASCII)


@dataclass(frozen=True)
class LoadOptions:
    """How a mesh file is read.

    Example:
        >>> import tempfile, trimesh
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = trimesh.creation.box((1, 2, 3)).export(f"{folder}/box.stl")  # corners of triangles, not vertices
        ...     load_mesh(f"{folder}/box.stl", LoadOptions()).notes
        ('welded 28 coincident vertices',)

    Args:
        mend: "auto" does the least that makes a body of the surface, and leaves a body as it is, see `mend`; "never"
            refuses what is no body; "always" makes every surface watertight that does not bound one body without
            crossing itself, for collections of mixed quality.
        component: "largest" keeps only the connected component of the largest area.
        allow_open: accept open boundaries; the winding number then decides what is inside.

    Raises:
        ValueError: an unknown way to mend, or an unknown component.
    """

    mend: Mending = "auto"
    component: Component | None = None
    allow_open: bool = False

    def __post_init__(self) -> None:
        if self.mend not in get_args(Mending):
            raise ValueError(f"mend: expected 'auto', 'never' or 'always', got {self.mend!r}.")
        if self.component is not None and self.component not in get_args(Component):
            raise ValueError(f"component: expected 'largest' or None, got {self.component!r}.")


@one_thread()
def load_mesh(path: str | Path, reading: LoadOptions = LoadOptions(), *, least_vertices: int = 0) -> Mesh:
    """Read a mesh file of any format that trimesh reads, or a cloud of points, and make a body of it.

    Polygons are cut into triangles. The vertices of a body keep their order and are not merged.

    Example:
        >>> import tempfile, trimesh
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = trimesh.creation.box((1, 2, 3)).export(f"{folder}/box.obj")
        ...     mesh = load_mesh(f"{folder}/box.obj")
        >>> len(mesh.vertices), round(mesh.volume, 6)
        (8, 6.0)

    Args:
        path: the file.
        reading: what may be done to it; what was done is kept in `Mesh.notes`.
        least_vertices: a body with fewer is subdivided, unless `reading` mends never.

    Raises:
        MeshError: the file is missing or unreadable, or the mesh is not usable.
    """
    vertices, faces, normals = read_surface(path)
    if reading.mend == "never" or len(faces):
        check_arrays(vertices, faces, str(path))
    notes: tuple[str, ...] = ()
    if reading.component == "largest" and len(faces):
        vertices, faces, notes = _largest_component(vertices, faces)
    if reading.allow_open and reading.mend != "always":
        try:
            return Mesh(vertices, faces, name=str(path), allow_open=True, notes=notes)
        except MeshError:
            if reading.mend == "never":
                raise
    return mend(
        vertices,
        faces,
        how=reading.mend,
        least_vertices=least_vertices,
        normals=normals,
        name=str(path),
        notes=notes,
    )


def read_surface(path: str | Path) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64] | None]:
    """What a file holds, unchecked.

    Returns:
        Vertices (V, 3); triangles (F, 3), none of a cloud of points; and the normals (V, 3) of a cloud that has them.

    Raises:
        MeshError: the file is missing or unreadable.
    """
    path = Path(path)
    if not path.is_file():
        raise MeshError(f"{path}: no such file. Check the path.")
    if path.stat().st_size == 0:
        raise MeshError(f"{path}: the file is empty (0 bytes). Export it again.")
    check_memory(path)
    try:
        return _read(path)
    except ImportError as error:
        raise MeshError(
            f"{path}: the format needs a module that is not installed ({error}). Install it, pip install "
            '"interior-gps[formats]" has those of trimesh, or convert the file to OFF, OBJ, PLY or STL.'
        ) from error
    except MemoryError:
        raise
    except Exception as error:  # the loaders of some twenty formats raise whatever they like
        raise MeshError(
            f"{path}: not readable as a mesh ({type(error).__name__}: {error}). "
            "Check that the file is complete and in a format that trimesh reads (OFF, OBJ, PLY, STL, GLB, ...)."
        ) from error


def _read(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64] | None]:
    """Vertices (V, 3), faces (F, 3), none of a cloud of points, and the normals (V, 3) of one that has them."""
    if path.suffix.lower() in POINT_CLOUDS:
        rows = np.loadtxt(path, ndmin=2, comments=("#", "//"), encoding="latin-1")  # which has a letter for any byte
        if rows.shape[1] not in (3, 6):
            raise ValueError(f"expected lines of 3 numbers, or of 6 with normals, got {rows.shape[1]}")
        return rows[:, :3], np.zeros((0, 3), dtype=np.int64), rows[:, 3:] if rows.shape[1] == 6 else None
    if path.suffix.lower() == ".off" and (plain := _plain_off(path)) is not None:
        return *plain, None
    scene = _scene(path)
    parts = list(scene.geometry.values())
    if parts and all(isinstance(part, trimesh.PointCloud) for part in parts):
        points = np.concatenate([np.asarray(part.vertices, dtype=np.float64) for part in parts])
        return points, np.zeros((0, 3), dtype=np.int64), _normals(scene, len(points))
    mesh = scene.to_mesh()
    return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces), None


def _scene(path: Path) -> Any:
    """What trimesh reads."""
    options = {"process": False, "force": "scene", **_loader_options(path)}
    try:
        return trimesh.load(path, **options)
    except UnicodeDecodeError:
        if path.suffix.lower() != ".ply":
            raise
        # of other text it guesses the encoding, but the header of a PLY file must be UTF-8
        head, end, body = path.read_bytes().partition(b"end_header")
        return trimesh.load(BytesIO(head.decode("latin-1").encode() + end + body), file_type="ply", **options)


def _plain_off(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]] | None:
    """What trimesh reads of an OFF file of coordinates and triangles alone, in a tenth of the time.

    None where it holds anything else, or is broken.
    """
    try:
        head, counts, *lines = path.read_text(encoding="utf-8").splitlines()
        n_vertices, n_faces, _ = map(int, counts.split())
        places, rows = lines[: max(n_vertices, 0)], lines[max(n_vertices, 0) :]
        # Of no lines NumPy warns, and an older one makes whole numbers of broken ones
        plain = head.strip() == "OFF" and "".join(places[:1]).strip() and _WHOLE_NUMBERS.fullmatch("\n".join(rows))
        if not plain:
            return None
        vertices = np.loadtxt(places, np.float64, comments=None, ndmin=2)
        faces = np.loadtxt(rows, np.int64, comments=None, ndmin=2)
    except ValueError:  # comments, colours, polygons of several sizes, or no text
        return None
    if vertices.shape != (n_vertices, 3) or faces.shape != (n_faces, 4) or (faces[:, 0] != 3).any():
        return None
    return (vertices, np.ascontiguousarray(faces[:, 1:])) if faces[:, 1:].max() < n_vertices else None


def _normals(cloud: Any, n_points: int) -> NDArray[np.float64] | None:
    """Those of a PLY file, which trimesh keeps as they were read, (n_points, 3)."""
    found = [geometry.metadata.get("_ply_raw", {}) for geometry in (cloud, *cloud.geometry.values())]
    for raw in found:
        rows = raw.get("vertex", {}).get("data")
        try:
            normals = np.column_stack([np.asarray(rows[name], dtype=np.float64) for name in ("nx", "ny", "nz")])
        except (KeyError, ValueError, IndexError, TypeError):
            continue
        if normals.shape == (n_points, 3):
            return normals
    return None


def _loader_options(path: Path) -> dict[str, Any]:
    # Materials and texture seams would split vertices of an OBJ file that are one point of the surface.
    return {"skip_materials": True, "maintain_order": True} if path.suffix.lower() == ".obj" else {}


def _largest_component(
    vertices: NDArray[np.float64], faces: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int64], tuple[str, ...]]:
    part, areas = face_parts(vertices, faces)
    if len(areas) == 1:
        return vertices, faces, ()
    kept, new_faces = compact(vertices, faces[part == int(np.argmax(areas))])
    note = f"kept the largest of {len(areas)} components ({len(kept)} of {len(vertices)} vertices)"
    return kept, new_faces, (note,)
