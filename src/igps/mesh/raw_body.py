"""A body as a reader of files returns it, and what readers share."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from igps._arrays import Booleans, Floats, Integers
from igps._files import table_text
from igps._text import counted
from igps.mesh._tidying import are_specks, places
from igps.mesh.errors import MeshError
from igps.mesh.mesh import Frame, Mesh, check_arrays
from igps.mesh.surface import compact, face_parts, stacked


@dataclass(frozen=True, eq=False)
class LabelVoxels:
    """Voxels of a label, and their place in the volume."""

    mask: Booleans  # (X, Y, Z) true at the voxels of the label, in their bounding box
    low: Integers  # (3,) index of the first voxel of the bounding box
    grid: tuple[int, ...]  # shape of the whole volume
    affine: Floats  # (4, 4) from voxel indices of the volume to world coordinates


UnitSource = Literal["header", "format", "default"]
"""What states the unit of a body: its file, its format, or nothing, where readers agree on millimetres."""

ONLY_LINES = "it holds lines, such as centre lines, which bound no body; export the surface instead"


@dataclass(frozen=True, eq=False)
class RawBody:
    """A surface as it was read, not yet checked; a point cloud has no faces."""

    vertices: Floats = field(default_factory=lambda: np.zeros((0, 3)))  # (V, 3) length
    # (F, 3) vertex indices
    faces: Integers = field(default_factory=lambda: np.zeros((0, 3), dtype=np.int64))
    part: str | None = None  # name among the bodies of the file; None if the file is a single body
    unit: str | None = None  # unit of length, such as "mm"; None if the file does not state it
    unit_from: UnitSource = "format"  # what states the unit, if there is one
    normals: Floats | None = None  # (V, 3), of a point cloud whose file has them
    notes: tuple[str, ...] = ()  # remarks made while reading, for the user
    fault: MeshError | None = None  # why this body has no surface, while others of its file may
    make: Callable[[], RawBody] | None = None  # computes the surface if that takes time; see `made`
    voxels: Callable[[], LabelVoxels] | None = None  # returns the voxels of a label
    # Whether the surface may be noisy; False if it was computed from voxels or atoms
    denoise: bool = True
    frame: Frame = None  # see `Mesh`
    fine_area: float | None = None  # see `Mesh`
    given: Mapping[str, float] = field(default_factory=dict)  # see `Mesh`
    number: str | None = None  # of a label, by which it is found like by its name

    def made(self) -> RawBody:
        """Return this body with its surface, or with the fault that left it without one."""
        return self if self.make is None else self.make()


def deferred(
    make: Callable[[], Mesh],
    part: str | None,
    unit: str | None,
    voxels: Callable[[], LabelVoxels] | None = None,
    unit_from: UnitSource = "format",
) -> RawBody:
    """Return a body whose surface is computed on demand; if that fails, the file's other bodies can still be read."""

    def compute() -> RawBody:
        try:
            mesh = make()
        except MeshError as fault:
            return RawBody(part=part, fault=fault, voxels=voxels)
        return RawBody(
            mesh.vertices,
            mesh.faces,
            part,
            unit,
            unit_from,
            notes=mesh.notes,
            voxels=voxels,
            denoise=False,
            frame=mesh.frame,
            fine_area=mesh.fine_area,
            given=mesh.given,
        )

    return RawBody(part=part, make=compute, voxels=voxels)


def joined(bodies: Sequence[RawBody]) -> RawBody:
    """Join bodies into one: those with faces, or point clouds if none has faces."""
    bodies = [body.made() for body in bodies]
    if len(bodies) == 1:
        return replace(bodies[0], part=None)
    meshes = [body for body in bodies if len(body.faces)]
    joinable = meshes or [body for body in bodies if len(body.vertices)]
    if not joinable:
        faults = [body.fault for body in bodies if body.fault]
        return RawBody(fault=faults[0] if faults else None)
    for body in meshes:
        # Other numbers would refer to another body
        if body.faces.min() < 0 or body.faces.max() >= len(body.vertices):
            raise ValueError(f"{body.part} refers to vertices that are not there")
    units = {body.unit for body in joinable}
    frames = {body.frame for body in joinable}
    normals = [body.normals for body in joinable if body.normals is not None]
    notes = [note for body in joinable for note in body.notes]
    vertices, faces = stacked([(body.vertices, body.faces) for body in joinable])
    return RawBody(
        vertices,
        faces,
        unit=units.pop() if len(units) == 1 else None,
        frame=frames.pop() if len(frames) == 1 else None,
        unit_from=joinable[0].unit_from,
        normals=np.concatenate(normals) if len(normals) == len(joinable) else None,
        notes=tuple(dict.fromkeys(notes)),
        denoise=any(body.denoise for body in joinable),
    )


def pieces(whole: RawBody) -> list[RawBody]:
    """Split a body into its connected components, "piece 1" and so on in the order of the file; specks are dropped."""
    vertices = whole.vertices
    faces = whole.faces
    if not len(faces):
        return [whole]
    check_arrays(vertices, faces, "the whole")
    # Unused vertices would widen the bounding box, which scales `places`
    vertices, faces = compact(vertices, faces)
    # Triangles need not share vertices: they are connected by position
    part, areas = face_parts(vertices, places(vertices)[faces])
    is_speck = are_specks(areas)
    notes = whole.notes
    if is_speck.any():
        notes = (*notes, f"left out {counted(int(is_speck.sum()), 'speck')}")
    _, first_face = np.unique(part, return_index=True)
    order = np.argsort(first_face)
    bodies = []
    for number, k in enumerate(order[~is_speck[order]], start=1):
        points, triangles = compact(vertices, faces[part == k])
        name = f"piece {number}"
        body = replace(whole, vertices=points, faces=triangles, part=name, notes=notes)
        bodies.append(body)
    return bodies


def distinct(names: Iterable[str]) -> list[str]:
    """Make names distinct by numbers: a second "part" becomes "part (2)"."""
    counts: dict[str, int] = {}
    for name in names:
        new = name
        while new in counts:
            counts[name] += 1
            new = f"{name} ({counts[name]})"
        counts[new] = 1
    return list(counts)


def text_of(path: Path) -> str:
    """Return the text of a file, see `table_text`, with line feeds in place of carriage returns."""
    return table_text(path).replace("\r", "\n")
