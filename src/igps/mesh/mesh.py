"""The triangle mesh: checked when it is made, trusted by all other code."""

import copy
import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from igps._arrays import Booleans, Floats, Integers
from igps._text import counted
from igps.mesh.errors import MeshError
from igps.mesh.surface import (
    components,
    connected,
    diagonal,
    directed_edges,
    face_areas,
    has_twins,
    signed_volume,
    undirected_edges,
)
from igps.mesh.winding import winding_number

logger = logging.getLogger(__name__)

Frame = Literal["RAS"] | None
"""Axes of a patient (x to the right, y to the front, z up), or None if they are not known."""

_PREFIXES = {"": 1e3, "centi": 10.0, "milli": 1.0, "micro": 1e-3, "nano": 1e-6}
_WRITTEN_OUT = {
    f"{prefix}{ending}": length
    for prefix, length in _PREFIXES.items()
    for ending in ("meter", "meters", "metre", "metres")
}
MILLIMETRES: Mapping[str, float] = {
    "m": 1e3,
    "cm": 10.0,
    "mm": 1.0,
    "µm": 1e-3,
    "\u03bcm": 1e-3,  # with the Greek letter, not the sign of micro
    "\\u00B5m": 1e-3,
    "um": 1e-3,
    "micron": 1e-3,
    "microns": 1e-3,
    "nm": 1e-6,
    "Å": 1e-7,
    "in": 25.4,
    "inch": 25.4,
    "inches": 25.4,
    "ft": 304.8,
    "feet": 304.8,
    **_WRITTEN_OUT,
}
"""Length of units in millimetres, by the names that bodies carry."""


def millimetres(unit: str | None) -> float:
    """Return the length of a unit in millimetres, 1 if the unit is unknown."""
    return MILLIMETRES.get(unit or "mm", 1.0)


def unit_of_length(name: str) -> float | None:
    """Return the length in millimetres of a unit by its name in a file, in any case; None if it is no known unit.

    Example:
        >>> unit_of_length("Microns"), unit_of_length("nanometre"), unit_of_length("pixel")
        (0.001, 1e-06, None)
    """
    name = name.strip()
    return MILLIMETRES.get(name, MILLIMETRES.get(name.lower()))


_REPAIR = 'LoadOptions(mend="auto"), on the command line --mend auto,'
# Of a body, over the cube of its diagonal; surfaces with less are folded sheets
_MIN_VOLUME = 1e-10
# Between these diagonals, areas, volumes and eigenfunctions in single precision neither overflow
# nor lose digits.
_MIN_DIAGONAL = 1e-30
_MAX_DIAGONAL = 1e30
_MAX_DISTANCE = 1e6  # from the origin, in diagonals; the mesh keeps nine digits of its coordinates, which suffice


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangle mesh that bounds a body, checked when it is made.

    Example:
        >>> import trimesh
        >>> box = trimesh.creation.box((1, 2, 3))
        >>> mesh = Mesh(box.vertices, box.faces)
        >>> round(mesh.volume, 6), round(mesh.area, 6), mesh.genus
        (6.0, 22.0, 0)

    Args:
        vertices: (V, 3) positions, any length unit.
        faces: (F, 3) vertex indices, counter-clockwise seen from outside. A mesh that is inside out is reversed, and
            `notes` says so.
        name: name of the mesh in error messages, usually its file.
        allow_open: accept boundary edges; the winding number then tells inside from outside.
        notes: earlier changes of the mesh, in words.
        unit: unit of length, such as "mm"; None if unknown.
        cavities: accept closed surfaces inside the largest, oriented inward, which bound hollows of the body.
        frame: "RAS" if x points to the patient's right, y to the front and z up; None if this is not known.
        fine_area: area, length², of the finer surface that these triangles stand for, which `area` then returns.
        given: numbers by name that its source knows and its surface does not tell, such as the volume of its voxels.

    Raises:
        MeshError: no faces, NaN or infinite vertices, out-of-range or repeated indices, unreferenced vertices,
            non-manifold edges, open boundaries, inconsistent orientation, several components, no volume, or a size or
            a distance from the origin at which floating-point numbers lose precision.
    """

    vertices: Floats
    faces: Integers
    name: str = "mesh"
    allow_open: bool = False
    notes: tuple[str, ...] = field(default=())
    unit: str | None = None
    cavities: bool = False
    frame: Frame = None
    fine_area: float | None = None
    given: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        vertices = np.array(self.vertices, dtype=np.float64, order="C")
        faces = np.array(self.faces)
        check_arrays(vertices, faces, self.name)
        faces = np.ascontiguousarray(faces, dtype=np.int64)
        _check_topology(faces, len(vertices), self.name, self.allow_open, self.cavities)
        check_size(vertices, self.name)
        volume = signed_volume(vertices, faces)
        if abs(volume) <= _MIN_VOLUME * diagonal(vertices) ** 3:
            sizes = f"{volume:.3g} for a bounding box diagonal of {diagonal(vertices):.3g}"
            raise MeshError(
                f"{self.name}: expected a body, but it encloses no volume ({sizes}). Thicken flat sheets."
            )
        if volume < 0:
            faces = np.ascontiguousarray(faces[:, ::-1])
            vars(self).update(notes=(*self.notes, "was inside out: all faces turned"))
            logger.info("%s: was inside out, all faces turned", self.name)
        if self.cavities:
            _check_cavities(vertices, faces, self.name)
        vertices.flags.writeable = faces.flags.writeable = False
        vars(self).update(vertices=vertices, faces=faces)  # the class is frozen

    def annotated(
        self,
        *,
        notes: tuple[str, ...] = (),
        unit: str | None = None,
        frame: Frame = None,
        fine_area: float | None = None,
        given: Mapping[str, float] | None = None,
    ) -> Self:
        """Return the mesh with `notes` before its own, and with what else is not None, not checked again."""
        return self._changed(
            notes=(*notes, *self.notes),
            unit=unit or self.unit,
            frame=frame or self.frame,
            fine_area=fine_area or self.fine_area,
            given=given or self.given,
        )

    def numbered_by_faces(self) -> Self:
        """Return the mesh with its vertices in the order in which the faces first use them."""
        _, first = np.unique(self.faces, return_index=True)
        order = np.argsort(first)
        rank = np.argsort(order)
        return self._changed(vertices=self.vertices[order], faces=rank[self.faces])

    def _changed(self, **fields: object) -> Self:
        other = copy.copy(self)
        vars(other).update(fields)
        return other

    def outer(self) -> tuple[Self, Booleans]:
        """Return the body without its cavities, and which vertices (V,) belong to its outer surface."""
        surfaces = connected(self.vertices, self.faces) if self.cavities else []
        if len(surfaces) < 2:
            return self, np.ones(len(self.vertices), dtype=bool)
        volumes = [signed_volume(*surface) for surface in surfaces]
        outermost = int(np.argmax(volumes))
        vertices, faces = surfaces[outermost]
        _, surface_of_vertex = components(self.faces, len(self.vertices))
        body = replace(self, vertices=vertices, faces=faces, cavities=False, fine_area=None)
        return body, surface_of_vertex == outermost

    @property
    def area(self) -> float:
        """Surface area, length²: `fine_area` if it is known, else the sum over the triangles."""
        return self._area_of_triangles if self.fine_area is None else self.fine_area

    @cached_property
    def _area_of_triangles(self) -> float:
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
        """Number of handles of all surfaces together; a MeshError for an open mesh."""
        n_vertices = len(self.vertices)
        n_faces = len(self.faces)
        edges, _ = undirected_edges(self.faces)
        if len(edges) * 2 != n_faces * 3:
            raise MeshError(
                f"{self.name}: an open surface has no genus; a closed one was expected. Close the holes."
            )
        # Euler's formula for C surfaces, V - E + F = 2 C - 2 genus, with 2 E = 3 F.
        n_surfaces, _ = components(self.faces, n_vertices)
        characteristic = n_vertices - n_faces // 2
        return n_surfaces - characteristic // 2

    def __repr__(self) -> str:
        return f"Mesh({self.name!r}, {len(self.vertices)} vertices, {len(self.faces)} faces)"


def check_arrays(vertices: ArrayLike, faces: ArrayLike, name: str) -> None:
    """Raise a MeshError unless the arrays are finite coordinates (V, 3), and faces (F, 3) with indices in range."""
    v = np.asarray(vertices)
    f = np.asarray(faces)
    check_coordinates(v, name)
    if f.size == 0:
        raise MeshError(
            f"{name}: no faces. A surface is needed; a point cloud must be meshed first."
        )
    if f.ndim != 2 or f.shape[1] != 3 or not np.issubdtype(f.dtype, np.integer):
        raise MeshError(
            f"{name}: faces: expected integers of shape (F, 3), got {f.dtype} of shape {f.shape}."
        )
    if f.min() < 0 or f.max() >= len(v):
        is_bad = ((f < 0) | (f >= len(v))).any(axis=1)
        n_bad = int(is_bad.sum())
        raise MeshError(
            f"{name}: {counted(n_bad, 'face')} with vertices out of range "
            f"(0 to {len(v) - 1} exist, {f.min()} to {f.max()} are "
            "used). The file is damaged; export it again."
        )


def check_coordinates(vertices: NDArray[Any], name: str) -> None:
    """Raise a MeshError unless the vertices are finite coordinates (V, 3)."""
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise MeshError(f"{name}: vertices: expected shape (V, 3), got {vertices.shape}.")
    finite = np.isfinite(vertices).all(axis=1)
    if not finite.all():
        fault = (
            f"{name}: {counted(int((~finite).sum()), 'vertex')} with NaN or infinite coordinates"
        )
        raise MeshError(
            f"{fault}, the first is vertex {int(np.argmin(finite))}. Remove them or export the file again."
        )


def check_size(vertices: Floats, name: str) -> None:
    """Raise a MeshError if a surface is too small, too large or too far from the origin to compute with."""
    with np.errstate(over="ignore"):
        length = diagonal(vertices)
        distance = float(np.abs(vertices).max())
    if not _MIN_DIAGONAL <= length <= _MAX_DIAGONAL:
        fault = (
            f"{name}: expected a bounding box diagonal from {_MIN_DIAGONAL:g} to {_MAX_DIAGONAL:g}"
        )
        raise MeshError(f"{fault}, got {length:.3g}. Scale the mesh, or remove stray vertices.")
    if distance > _MAX_DISTANCE * length:
        fault = f"{name}: expected a distance from the origin of at most {_MAX_DISTANCE:g} times the size of the mesh"
        rounded = f"got {distance / length:.3g} times, where coordinates are mostly rounded off"
        raise MeshError(f"{fault}, {rounded}. Move the mesh to the origin before writing the file.")


def _check_topology(
    faces: Integers, n_vertices: int, name: str, allow_open: bool, cavities: bool
) -> None:
    n_repeated = int(has_twins(faces).sum())
    n_unused = n_vertices - len(np.unique(faces))
    start, end = directed_edges(faces)
    _, edge_of = undirected_edges(faces)
    count = np.bincount(edge_of)
    n_non_manifold = int((count > 2).sum())
    n_boundary = int((count == 1).sum())
    direction = np.where(start < end, 1, -1)
    balance = np.bincount(edge_of, weights=direction)
    is_inconsistent = (count == 2) & (balance != 0)
    n_inconsistent = int(is_inconsistent.sum())
    n_components, _ = components(faces, n_vertices)
    read = f"Read the file with {_REPAIR}"
    for is_wrong, message in (
        (n_repeated, f"{counted(n_repeated, 'face')} with a vertex twice. {read} to drop them."),
        (n_unused, f"{counted(n_unused, 'vertex')} in no face. {read} to drop them."),
        (
            n_non_manifold,
            f"{counted(n_non_manifold, 'non-manifold edge')} (shared by more than two faces). {read} to drop "
            "duplicate faces; if edges remain, separate the sheets that meet there in a modelling tool.",
        ),
        (
            n_boundary and not allow_open,
            f"open surface with {counted(n_boundary, 'boundary edge')}. Close the holes; or read the "
            f"file with {_REPAIR} if vertices are only duplicated there (as in every STL file); "
            "or with allow_open=True, "
            "--allow_open, to tell inside from outside by the winding number.",
        ),
        (
            n_inconsistent,
            f"inconsistent orientation, two faces go along {counted(n_inconsistent, 'edge')} in the same direction. "
            f"{read} to orient the faces.",
        ),
        (
            n_components > 1 and not cavities,
            f"{n_components} connected components; the commute time between them is "
            "infinite. Read the file with LoadOptions(bodies='pieces'), "
            "on the command line --bodies pieces, to "
            f"make a body of each; with {_REPAIR} if coincident vertices are merely not welded; or join them.",
        ),
    ):
        if is_wrong:
            raise MeshError(f"{name}: {message}")


def _check_cavities(vertices: Floats, faces: Integers, name: str) -> None:
    import igl

    surfaces = connected(vertices, faces)
    volumes = [signed_volume(*surface) for surface in surfaces]
    outer = int(np.argmax(volumes))
    for k, (points, triangles) in enumerate(surfaces):
        if k == outer:
            continue
        # Surfaces that meet in a vertex are one connected surface, but not one patch.
        _, patch = igl.bfs_orient(triangles)
        patches = [triangles[patch == i] for i in range(patch.max() + 1)]
        is_outward = any(signed_volume(points, faces) >= 0 for faces in patches)
        lies_inside = winding_number(*surfaces[outer], points).min() >= 0.5
        lies_in_another = False
        for i, other in enumerate(surfaces):
            # The cavity's own winding number may be anything from 0 to 1 at its vertices.
            if i not in (k, outer):
                winding = winding_number(*other, points)
                lies_in_another |= bool(np.abs(winding).max() > 0.5)
        if is_outward or not lies_inside or lies_in_another:
            raise MeshError(
                f"{name}: one of {len(surfaces)} closed surfaces bounds no cavity: it is oriented "
                "outward, outside the largest surface, or inside another cavity. "
                f"Read the file with {_REPAIR} or without cavities."
            )
