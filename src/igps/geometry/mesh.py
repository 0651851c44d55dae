"""The checked triangle mesh that everything else trusts, and how one is read from a file."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

logger = logging.getLogger(__name__)

Component = Literal["largest"]

# A closed surface whose volume is below this share of its bounding sphere's cube is a folded sheet, not a body.
_FLAT = 1e-10
# Vertices closer than this share of the bounding box's diagonal are one vertex to `repair`.
_WELD = 1e-8


class MeshError(ValueError):
    """A mesh cannot be used; the message names the file, what is wrong, and the remedy."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh that bounds a body, checked when made and trusted after.

    Args:
        vertices: (V, 3) positions, any length unit.
        faces: (F, 3) vertex indices, counter-clockwise seen from outside. A closed mesh that is inside out is turned,
            which `notes` records.
        name: what error messages call the mesh, usually its file.
        allow_open: accept boundary edges; inside and outside are then told apart by the winding number.
        notes: what was done to the mesh on its way here, in words.

    Raises:
        MeshError: no faces, NaN or infinite vertices, out-of-range or repeated indices, unreferenced vertices,
            non-manifold edges, open boundaries, inconsistent orientation, several components, or no volume.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    name: str = "mesh"
    allow_open: bool = False
    notes: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        vertices = np.array(self.vertices, dtype=np.float64, order="C")
        faces = np.array(self.faces)
        _check_arrays(vertices, faces, self.name)
        faces = np.ascontiguousarray(faces, dtype=np.int64)
        _check_topology(faces, len(vertices), self.name, self.allow_open)
        volume = _signed_volume(vertices, faces)
        diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))
        if abs(volume) <= _FLAT * diagonal**3:
            raise MeshError(
                f"{self.name}: the surface encloses no volume ({volume:.3g} for a bounding box diagonal of "
                f"{diagonal:.3g}); a body was expected. Give a flat sheet some thickness."
            )
        if volume < 0:
            faces = np.ascontiguousarray(faces[:, ::-1])
            object.__setattr__(self, "notes", (*self.notes, "was inside out: all faces turned"))
            logger.info("%s: was inside out, all faces turned", self.name)
        vertices.flags.writeable = faces.flags.writeable = False
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)

    @property
    def area(self) -> float:
        """Surface area, length²."""
        return float(np.linalg.norm(area_vectors(self.vertices, self.faces), axis=1).sum())

    @property
    def volume(self) -> float:
        """Enclosed volume, length³ (of an open mesh: of its cone over the centre of its vertices)."""
        return _signed_volume(self.vertices, self.faces)

    def __repr__(self) -> str:
        return f"Mesh({self.name!r}, {len(self.vertices)} vertices, {len(self.faces)} faces)"


def area_vectors(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    """Normal of each face times its area: (F, 3), length²."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return np.cross(b - a, c - a) / 2


def load_mesh(
    path: str | Path,
    *,
    repair: bool = False,
    component: Component | None = None,
    allow_open: bool = False,
) -> Mesh:
    """Read a mesh file of any format that trimesh reads, and check it.

    Polygons are cut into triangles. Vertices keep their order and are not merged unless `repair` is set.

    Args:
        path: the file.
        repair: weld coincident vertices, drop degenerate, duplicate and unreferenced elements, and orient the faces
            consistently; what was done is logged and kept in `Mesh.notes`.
        component: "largest" keeps only the connected component of the largest area.
        allow_open: accept open boundaries.

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
    _check_arrays(vertices, faces, str(path))
    notes: list[str] = []
    if repair:
        vertices, faces = _repaired(vertices, faces, notes)
        _check_arrays(vertices, faces, str(path))
    if component is not None:
        if component != "largest":
            raise ValueError(f"component: expected 'largest' or None, got {component!r}.")
        vertices, faces = _largest_component(vertices, faces, notes)
    for note in notes:
        logger.info("%s: %s", path, note)
    return Mesh(vertices, faces, name=str(path), allow_open=allow_open, notes=tuple(notes))


def simplify(mesh: Mesh, max_vertices: int) -> Mesh:
    """The mesh with at most `max_vertices` vertices, by quadric edge collapse (Garland and Heckbert 1997).

    A mesh that is small enough is returned as it is. No collapse changes the topology (libigl's `qslim` checks each),
    so that a closed manifold stays one; the result is checked again like any mesh.

    Raises:
        ImportError: libigl is not installed.
        MeshError: `max_vertices` cannot be reached, or the simplified surface is not a body any more.
    """
    if max_vertices < 4:
        raise ValueError(f"max_vertices: expected at least 4, got {max_vertices}.")
    surplus = len(mesh.vertices) - max_vertices
    if surplus <= 0:
        return mesh
    try:
        import igl
    except ImportError as error:
        raise ImportError('simplify needs libigl: pip install "interior-gps[igl]".') from error
    # In unit scale, because quadrics are sums of squares. A collapse on a closed surface takes a vertex and two faces.
    centre, scale = mesh.vertices.mean(axis=0), float(np.ptp(mesh.vertices, axis=0).max())
    points = np.asfortranarray((mesh.vertices - centre) / scale)
    points, faces, *_ = igl.qslim(points, np.asfortranarray(mesh.faces), max(len(mesh.faces) - 2 * surplus, 4))
    if len(points) > max_vertices:
        raise MeshError(
            f"{mesh.name}: could not be simplified to {max_vertices} vertices without changing its topology "
            f"({len(points)} were reached). Raise max_vertices."
        )
    note = f"simplified from {len(mesh.vertices)} to {len(points)} vertices"
    try:
        return replace(mesh, vertices=points * scale + centre, faces=faces, notes=(*mesh.notes, note))
    except MeshError as error:
        raise MeshError(f"{error} This came of simplifying to max_vertices={max_vertices}: raise it.") from error


def _loader_options(path: Path) -> dict[str, Any]:
    # Materials and texture seams would split vertices of an OBJ file that are one point of the surface.
    return {"skip_materials": True, "maintain_order": True} if path.suffix.lower() == ".obj" else {}


def _check_arrays(vertices: ArrayLike, faces: ArrayLike, name: str) -> None:
    v, f = np.asarray(vertices), np.asarray(faces)
    if v.ndim != 2 or v.shape[1] != 3:
        raise MeshError(f"{name}: vertices: expected shape (V, 3), got {v.shape}.")
    if f.size == 0:
        raise MeshError(f"{name}: no faces. A surface is needed; a point cloud must be meshed first.")
    if f.ndim != 2 or f.shape[1] != 3 or not np.issubdtype(f.dtype, np.integer):
        raise MeshError(f"{name}: faces: expected integers of shape (F, 3), got {f.dtype} of shape {f.shape}.")
    if f.min() < 0 or f.max() >= len(v):
        bad = int(((f < 0) | (f >= len(v))).any(axis=1).sum())
        raise MeshError(
            f"{name}: {bad} faces refer to vertices out of range (0 to {len(v) - 1} exist, "
            f"{f.min()} to {f.max()} are used). The file is damaged; export it again."
        )
    finite = np.isfinite(v).all(axis=1)
    if not finite.all():
        raise MeshError(
            f"{name}: {int((~finite).sum())} vertices have NaN or infinite coordinates, the first is vertex "
            f"{int(np.argmin(finite))}. Remove them or export the file again."
        )


def _check_topology(faces: NDArray[np.int64], n_vertices: int, name: str, allow_open: bool) -> None:
    repeated = int((faces == np.roll(faces, 1, axis=1)).any(axis=1).sum())
    if repeated:
        raise MeshError(f"{name}: {repeated} faces use a vertex twice. Pass repair=True to drop them.")
    unused = n_vertices - len(np.unique(faces))
    if unused:
        raise MeshError(f"{name}: {unused} vertices belong to no face. Pass repair=True to drop them.")
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    undirected = np.minimum(start, end) * n_vertices + np.maximum(start, end)
    edges, edge_of, count = np.unique(undirected, return_inverse=True, return_counts=True)
    crowded = int((count > 2).sum())
    if crowded:
        raise MeshError(
            f"{name}: {crowded} non-manifold edges (shared by more than two faces). Pass repair=True to drop duplicate "
            "faces; if edges remain, separate the sheets that meet there in a modelling tool."
        )
    boundary = int((count == 1).sum())
    if boundary and not allow_open:
        raise MeshError(
            f"{name}: open surface with {boundary} boundary edges. Close the holes; pass repair=True if vertices are "
            "only duplicated there (as in every STL file); or pass allow_open=True to tell inside from outside by the "
            "winding number."
        )
    balance = np.bincount(edge_of, weights=np.where(start < end, 1.0, -1.0), minlength=len(edges))
    twisted = int(((count == 2) & (balance != 0)).sum())
    if twisted:
        raise MeshError(
            f"{name}: inconsistent orientation, {twisted} edges are run through twice in the same direction. "
            "Pass repair=True to orient the faces."
        )
    n_components, _ = _components(faces, n_vertices)
    if n_components > 1:
        raise MeshError(
            f"{name}: {n_components} connected components; the commute time between them is infinite. Pass "
            "component='largest' to keep one, repair=True if coincident vertices are merely not welded, or join them."
        )


def _components(faces: NDArray[np.int64], n_vertices: int) -> tuple[int, NDArray[np.int32]]:
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    graph = sparse.coo_matrix((np.ones(len(start), dtype=np.int8), (start, end)), shape=(n_vertices, n_vertices))
    count, label = sparse.csgraph.connected_components(graph, directed=False)
    return int(count), label


def _signed_volume(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> float:
    centred = vertices - vertices.mean(axis=0)
    return float(np.einsum("ij,ij->", centred[faces[:, 0]], area_vectors(centred, faces)) / 3)


def _repaired(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], notes: list[str]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    # Welding happens on a lattice in units of the bounding box, because trimesh's own tolerance is an absolute length.
    centre, diagonal = vertices.mean(axis=0), float(np.linalg.norm(np.ptp(vertices, axis=0)))
    lattice = np.round((vertices - centre) / (_WELD * max(diagonal, np.finfo(float).tiny))).astype(np.int64)
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
    count, label = _components(faces, len(vertices))
    face_label = label[faces[:, 0]]
    area = np.bincount(face_label, weights=np.linalg.norm(area_vectors(vertices, faces), axis=1), minlength=count)
    keep = face_label == int(np.argmax(area))
    used, new_faces = np.unique(faces[keep], return_inverse=True)
    n_dropped = len(np.unique(face_label)) - 1
    if n_dropped:
        notes.append(f"kept the largest of {n_dropped + 1} components ({len(used)} of {len(vertices)} vertices)")
    return vertices[used], new_faces.reshape(-1, 3)
