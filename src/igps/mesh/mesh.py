"""The checked triangle mesh that everything else trusts."""

from __future__ import annotations

import copy
import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from igps.mesh._arrays import Booleans, Floats, Integers
from igps.mesh.surface import (
    compact,
    components,
    diagonal,
    directed_edges,
    face_areas,
    genus,
    signed_volume,
    undirected_edges,
)
from igps.mesh.winding import winding_number

logger = logging.getLogger(__name__)

MILLIMETRES: Mapping[str, float] = {
    "m": 1e3, "cm": 10.0, "mm": 1.0, "µm": 1e-3, "um": 1e-3, "micron": 1e-3, "nm": 1e-6, "Å": 1e-7, "in": 25.4,
    "inch": 25.4, "inches": 25.4, "ft": 304.8, "feet": 304.8, "meter": 1e3, "meters": 1e3, "centimeters": 10.0,
    "millimeter": 1.0, "millimeters": 1.0, "\\u00b5m": 1e-3,
}  # fmt: skip
"""Of a unit of length, by the names that files and libraries call it."""

# What the reader of a message is to do.
_REPAIR = 'LoadOptions(mend="auto"), on the command line --mend auto,'
# A closed surface whose volume is below this share of its bounding sphere's cube is a folded sheet, not a body.
_FLAT = 1e-10
# Diagonals of the bounding box for which areas, volumes and, in single precision, eigenfunctions neither overflow nor
# lose digits, whatever the unit.
_SMALLEST, _LARGEST = 1e-30, 1e30
# A mesh so many diagonals away from the origin keeps nine digits of its coordinates, and enough of its triangles.
_FARTHEST = 1e6


class MeshError(ValueError):
    """A mesh cannot be used; the message names the file, what is wrong, and the remedy.

    Example:
        >>> try:
        ...     Mesh(np.zeros((3, 3)), np.array([[0, 1, 5], [0, 2, 5]]))
        ... except MeshError as error:
        ...     print(error)  # names the file, if it is of one
        mesh: 2 faces refer to vertices out of range (0 to 2 exist, 0 to 5 are used). The file is damaged; export it
        again.
    """


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh that bounds a body, checked when made and trusted after.

    Example:
        >>> import trimesh
        >>> box = trimesh.creation.box((1, 2, 3))
        >>> mesh = Mesh(box.vertices, box.faces)
        >>> round(mesh.volume, 6), round(mesh.area, 6), mesh.genus
        (6.0, 22.0, 0)

    Args:
        vertices: (V, 3) positions, any length unit.
        faces: (F, 3) vertex indices, counter-clockwise seen from outside. A closed mesh that is inside out is turned,
            which `notes` records.
        name: what error messages call the mesh, usually its file.
        allow_open: accept boundary edges; the winding number then decides what is inside.
        notes: what was done to the mesh on its way here, in words.
        unit: of length, such as "mm"; None where it is not known.
        cavities: accept closed surfaces inside the largest, turned the other way, which bound hollows of the body.

    Raises:
        MeshError: no faces, NaN or infinite vertices, out-of-range or repeated indices, unreferenced vertices,
            non-manifold edges, open boundaries, inconsistent orientation, several components, no volume, or a size or
            a distance from the origin at which numbers lose their digits.
    """

    vertices: Floats
    faces: Integers
    name: str = "mesh"
    allow_open: bool = False
    notes: tuple[str, ...] = field(default=())
    unit: str | None = None
    cavities: bool = False

    def __post_init__(self) -> None:
        vertices = np.array(self.vertices, dtype=np.float64, order="C")
        faces = np.array(self.faces)
        check_arrays(vertices, faces, self.name)
        faces = np.ascontiguousarray(faces, dtype=np.int64)
        _check_topology(faces, len(vertices), self.name, self.allow_open, self.cavities)
        check_size(vertices, self.name)
        volume = signed_volume(vertices, faces)
        if abs(volume) <= _FLAT * diagonal(vertices) ** 3:
            raise MeshError(
                f"{self.name}: the surface encloses no volume ({volume:.3g} for a bounding box diagonal of "
                f"{diagonal(vertices):.3g}); a body was expected. Give a flat sheet some thickness."
            )
        if volume < 0:
            faces = np.ascontiguousarray(faces[:, ::-1])
            object.__setattr__(self, "notes", (*self.notes, "was inside out: all faces turned"))
            logger.info("%s: was inside out, all faces turned", self.name)
        if self.cavities:
            _check_cavities(vertices, faces, self.name)
        vertices.flags.writeable = faces.flags.writeable = False
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)

    @classmethod
    def of(cls, body: Any) -> Mesh:
        """The Mesh of a body as another library keeps it; a Mesh is given back as it is.

        Example:
            >>> import trimesh
            >>> Mesh.of(trimesh.creation.box((1, 2, 3)))
            Mesh('mesh', 8 vertices, 12 faces)

        Args:
            body: a Mesh, or a closed surface as a trimesh.Trimesh, a pyvista.PolyData or a nibabel.GiftiImage. Polygons
                are cut into triangles. Its file, if it knows one, becomes the name.

        Raises:
            TypeError: it is something else.
            MeshError: it is not one closed surface, see `Mesh`.
        """
        if isinstance(body, cls):
            return body
        from igps.mesh.objects import raw_of

        name, raw = raw_of(body)
        return cls(raw.vertices, raw.faces, name=name, unit=raw.unit)

    def told(self, *, notes: tuple[str, ...] = (), unit: str | None = None) -> Mesh:
        """The same mesh with more notes, before its own, and with a unit if one is given; nothing is checked again."""
        other = copy.copy(self)
        object.__setattr__(other, "notes", (*notes, *self.notes))
        object.__setattr__(other, "unit", unit or self.unit)
        return other

    def numbered_by_faces(self) -> Mesh:
        """The same mesh with its vertices in the order in which the faces first use them."""
        used, first = np.unique(self.faces, return_index=True)
        order = used[np.argsort(first)]
        rank = np.empty(len(self.vertices), dtype=np.int64)
        rank[order] = np.arange(len(order))
        other = copy.copy(self)
        object.__setattr__(other, "vertices", self.vertices[order])
        object.__setattr__(other, "faces", rank[self.faces])
        return other

    def outer(self) -> tuple[Mesh, Booleans]:
        """The body without its cavities, and which of the vertices (V,) are its."""
        n_components, owner = components(self.faces, len(self.vertices)) if self.cavities else (1, None)
        if n_components == 1:
            return self, np.ones(len(self.vertices), dtype=bool)
        assert owner is not None
        surfaces = [self.faces[owner[self.faces[:, 0]] == k] for k in range(n_components)]
        outermost = int(np.argmax([signed_volume(self.vertices, faces) for faces in surfaces]))
        vertices, faces = compact(self.vertices, surfaces[outermost])
        return replace(self, vertices=vertices, faces=faces, cavities=False), owner == outermost

    @cached_property
    def area(self) -> float:
        """Surface area, length²."""
        return float(face_areas(self.vertices, self.faces).sum())

    @property
    def volume(self) -> float:
        """Enclosed volume, length³ (of an open mesh: of its cone over the centre of its vertices)."""
        return signed_volume(self.vertices, self.faces)

    @property
    def diagonal(self) -> float:
        """Diagonal of the bounding box, length."""
        return diagonal(self.vertices)

    @property
    def genus(self) -> int:
        """Number of handles, of a closed mesh; of one with cavities those of all its surfaces.

        Raises:
            MeshError: the mesh is open.
        """
        if len(undirected_edges(self.faces, len(self.vertices))[0]) * 2 != len(self.faces) * 3:
            raise MeshError(f"{self.name}: an open surface has no genus; a closed one was expected. Close the holes.")
        return genus(self.faces, len(self.vertices))

    def __repr__(self) -> str:
        return f"Mesh({self.name!r}, {len(self.vertices)} vertices, {len(self.faces)} faces)"


def check_arrays(vertices: ArrayLike, faces: ArrayLike, name: str) -> None:
    """Raise a MeshError unless the arrays have the shapes of a mesh, indices in range and finite coordinates."""
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


def check_size(vertices: Floats, name: str) -> None:
    """Raise a MeshError where a surface is too small, too large or too far away to compute with."""
    with np.errstate(over="ignore"):
        length, distance = diagonal(vertices), float(np.abs(vertices).max())
    if not _SMALLEST <= length <= _LARGEST:
        raise MeshError(
            f"{name}: the diagonal of the bounding box is {length:.3g}; {_SMALLEST:g} to {_LARGEST:g} expected, where "
            "areas and eigenfunctions can be told in floating point. Scale the mesh, or remove stray vertices."
        )
    if distance > _FARTHEST * length:
        raise MeshError(
            f"{name}: the mesh lies {distance / length:.3g} times its own size away from the origin, where its "
            f"coordinates are mostly rounded off; at most {_FARTHEST:g} times expected. Move it to the origin before "
            "it is written."
        )


def _check_topology(faces: Integers, n_vertices: int, name: str, allow_open: bool, cavities: bool) -> None:
    repeated = int((faces == np.roll(faces, 1, axis=1)).any(axis=1).sum())
    if repeated:
        raise MeshError(f"{name}: {repeated} faces use a vertex twice. Read the file with {_REPAIR} to drop them.")
    unused = n_vertices - len(np.unique(faces))
    if unused:
        raise MeshError(f"{name}: {unused} vertices belong to no face. Read the file with {_REPAIR} to drop them.")
    start, end = directed_edges(faces)
    _, edge_of = undirected_edges(faces, n_vertices)
    count = np.bincount(edge_of)
    crowded = int((count > 2).sum())
    if crowded:
        raise MeshError(
            f"{name}: {crowded} non-manifold edges (shared by more than two faces). Read the file with {_REPAIR} "
            "to drop duplicate faces; if edges remain, separate the sheets that meet there in a modelling tool."
        )
    boundary = int((count == 1).sum())
    if boundary and not allow_open:
        raise MeshError(
            f"{name}: open surface with {boundary} boundary edges. Close the holes; or read the file with "
            f"{_REPAIR} if vertices are only duplicated there (as in every STL file); or with allow_open=True, "
            "--allow_open, to tell inside from outside by the winding number."
        )
    balance = np.bincount(edge_of, weights=np.where(start < end, 1.0, -1.0), minlength=len(count))
    twisted = int(((count == 2) & (balance != 0)).sum())
    if twisted:
        raise MeshError(
            f"{name}: inconsistent orientation, {twisted} edges are run through twice in the same direction. "
            f"Read the file with {_REPAIR} to orient the faces."
        )
    n_components, _ = components(faces, n_vertices)
    if n_components > 1 and not cavities:
        raise MeshError(
            f"{name}: {n_components} connected components; the commute time between them is infinite. Read the "
            "file with LoadOptions(component='largest'), on the command line --component largest, to keep one; with "
            f"{_REPAIR} if coincident vertices are merely not welded; or join them."
        )


def _check_cavities(vertices: Floats, faces: Integers, name: str) -> None:
    n_components, owner = components(faces, len(vertices))
    if n_components == 1:
        return
    owner = owner[faces[:, 0]]
    surfaces = [compact(vertices, faces[owner == k]) for k in range(n_components)]
    volumes = [signed_volume(*surface) for surface in surfaces]
    outer = int(np.argmax(volumes))
    for k, (points, _) in enumerate(surfaces):
        # About a point of a cavity's own surface the winding number of that surface is anything from 0 to 1
        around = {other: winding_number(*surfaces[other], points) for other in range(n_components) if other != k}
        if k != outer and (volumes[k] >= 0 or around.pop(outer).min() < 0.5 or any(
            abs(winding).max() > 0.5 for winding in around.values()
        )):  # fmt: skip
            raise MeshError(
                f"{name}: one of {n_components} closed surfaces is no cavity of the body: it is turned outwards, lies "
                f"outside the largest, or in another cavity. Read the file with {_REPAIR}, or without cavities."
            )
