"""Make a body of a surface by as few repairs as possible: weld, fill, unite, smooth, or make watertight.

A mesh that is a body already and not noisy is returned bit for bit. Every repair is recorded in the notes of the mesh,
and `repair_steps` returns the repairs that notes record.
"""

import logging
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, get_args

import numpy as np

from igps._arrays import Floats, Integers
from igps._parameters import check_one_of
from igps.mesh._tidying import (
    closed_by_rims,
    drop_hidden_parts,
    fill_small_holes,
    orient,
    tidy,
    weld,
)
from igps.mesh._union import unite_parts
from igps.mesh.denoising import is_noisy, remove_noise
from igps.mesh.errors import MeshError
from igps.mesh.mesh import Mesh, check_arrays, check_coordinates, check_size
from igps.mesh.options import Cavities, Mending
from igps.mesh.surface import signed_volume
from igps.mesh.watertight import crosses_itself, watertight

logger = logging.getLogger(__name__)

Step = Literal["welded", "filled", "united", "smoothed", "subdivided", "watertight"]

MENDING_VERSION = 12
"""Part of the cache keys of mended bodies; incremented whenever mending a surface gives another body."""

# Steps by the first words of their notes
_STARTS: dict[str, Step] = {step: step for step in get_args(Step)}
_STARTS |= {"dropped": "welded", "turned": "welded", "made watertight": "watertight"}

# A shell is named open if this share of its surface is missing, and it has less than this share of
# the volume within.
_MIN_MISSING = 0.05
_MAX_SHELL = 0.5


def mend(
    vertices: Floats,
    faces: Integers | None,
    *,
    how: Mending = "auto",
    normals: Floats | None = None,
    cavities: Cavities = "fill",
    denoise: bool = True,
    name: str = "mesh",
) -> Mesh:
    """Make a body of a surface in any state, by as few repairs as possible.

    Repairs are made in this order, until the surface is a body: weld coincident vertices, drop degenerate and duplicate
    faces, and orient the faces; drop fins and specks; fill small holes; drop closed parts inside the body; unite
    overlapping closed parts; make it `watertight`. A body that is rough with scanner noise is smoothed, because noise
    adds area.

    Args:
        vertices: (V, 3) positions, any length unit.
        faces: (F, 3) vertex indices; None or empty for a point cloud, which is made watertight.
        how: "auto": as above. "never": accept bodies only. "always": make every surface watertight that, after welding,
            does not bound one body or intersects itself; "auto" does not check for intersections.
        normals: (V, 3) normals of a point cloud, if known.
        cavities: "fill" drops closed parts inside the body. "keep" makes them the surfaces of hollows, unless the body
            is made watertight.
        denoise: smooth a surface that is rough with noise. Thin branches made of voxels look like noise.
        name: name of the surface in error messages, usually its file.

    Raises:
        MeshError: the surface is not a body (with "never"), or no body can be made of it.
    """
    check_one_of(get_args(Mending), how=how)
    if how == "never":
        return Mesh(vertices, np.asarray(faces), name=name, cavities=cavities == "keep")
    if faces is None or np.size(faces) == 0:
        vertices = np.asarray(vertices, dtype=np.float64)
        if vertices.size == 0:
            raise MeshError(
                f"{name}: the file is empty: no vertices and no faces. Export it again."
            )
        check_coordinates(vertices, name)
        check_size(vertices, name)
        mesh = watertight(vertices, normals=normals, name=name)
    else:
        check_arrays(vertices, faces, name)
        vertices = np.asarray(vertices, dtype=np.float64)
        triangles = np.asarray(faces, dtype=np.int64)
        if len(triangles) == 1:
            raise MeshError(
                f"{name}: expected a closed surface, got a single triangle. Export it again."
            )
        corners = vertices[triangles]
        if (corners == corners[:, :1]).all():
            raise MeshError(
                f"{name}: expected a surface, but all faces lie in one point. Check the file."
            )
        check_size(corners.reshape(-1, 3), name)  # before squares of lengths overflow or vanish
        mending = _Mending(name, cavities == "keep", denoise)
        repair = mending.remade if how == "always" else mending.mended
        mesh = repair(vertices, triangles)
    for note in mesh.notes:
        logger.info("%s: %s", name, note)
    return mesh


def repair_steps(notes: Iterable[str]) -> tuple[Step, ...]:
    """Return the repairs that the notes of a `Mesh` or `Signature` record, in order and without repetition."""
    found: dict[Step, None] = {}
    for note in notes:
        for start, step in _STARTS.items():
            if note.startswith(start):
                found[step] = None
    return tuple(found)


@dataclass(frozen=True)
class _Mending:
    """Ways to make a body of the triangles of a surface; for the fields see `mend`."""

    name: str
    cavities: bool
    denoise: bool

    def mended(self, vertices: Floats, faces: Integers) -> Mesh:
        """Return the body after as few repairs as possible."""
        notes: list[str] = []
        original = vertices, faces
        drop_hidden = partial(drop_hidden_parts, cavities=self.cavities)
        for step in (None, weld, tidy, fill_small_holes, drop_hidden):
            if step is not None and len(faces):
                vertices, faces = step(vertices, faces, notes)
            body = self._body(vertices, faces, notes)
            if body is not None:
                return body
        united: list[str] = []
        body = self._body(*unite_parts(*original, united), united)
        if body is not None:
            return body
        smooth = self._smooth(vertices, faces, notes)
        body = watertight(smooth, faces, name=self.name)
        notes += _open_notes(vertices, faces, body.volume)
        return body.annotated(notes=tuple(notes))

    def remade(self, vertices: Floats, faces: Integers) -> Mesh:
        """Return the welded and smooth body, watertight only if that is no body, or one that crosses itself."""
        notes: list[str] = []
        surface = vertices, faces
        # The grid is the last resort: it would join parts that are nearer than a cell, such as the coils of a spring.
        for step in (None, weld):
            if step is not None:
                surface = step(vertices, faces, notes)
            body = self._body(*surface, notes)
            if body is not None and not crosses_itself(body.vertices, body.faces):
                return body
            notes = []
        smooth = self._smooth(*surface, notes)
        last = (smooth, surface[1]) if notes else (vertices, faces)
        body = watertight(*last, name=self.name)
        return body.annotated(notes=tuple(notes))

    def _body(self, vertices: Floats, faces: Integers, notes: list[str]) -> Mesh | None:
        """Return the body with this surface, smoothed if it is noisy, or None if the surface bounds no body."""
        try:
            mesh = Mesh(vertices, faces, name=self.name, notes=tuple(notes), cavities=self.cavities)
        except MeshError:
            return None
        smooth = self._smooth(mesh.vertices, mesh.faces, notes)
        if smooth is mesh.vertices:
            return mesh
        return replace(mesh, vertices=smooth, notes=tuple(notes))

    def _smooth(self, vertices: Floats, faces: Integers, notes: list[str]) -> Floats:
        if not self.denoise or not len(faces) or not is_noisy(vertices, faces):
            return vertices
        notes.append("smoothed: the surface was rough with noise")
        return remove_noise(vertices, faces)


def _open_notes(vertices: Floats, faces: Integers, volume: float) -> list[str]:
    """Return a note if an open surface became a thin shell, although closed by its rims it would hold far more."""
    if not len(faces):
        return []
    points, triangles, missing = closed_by_rims(vertices, orient(faces, []))
    inside = abs(signed_volume(points, triangles))
    if missing < _MIN_MISSING or volume > _MAX_SHELL * inside:
        return []
    share = f"open: {missing:.0%} of the surface is missing"
    return [f"{share}, so it became a shell around {inside:.3g}; close it if it is a solid body"]
