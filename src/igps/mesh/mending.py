"""The least that makes a body of a surface: as it is, welded, filled, united, smoothed, subdivided, or watertight.

A mesh that is a body already and not noisy is left as it is, bit for bit. Every step says in the mesh's notes what it
did, and `repair_steps` tells from the notes which steps were needed.
"""

import logging
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from typing import Literal, get_args

import numpy as np

from igps._arrays import Floats, Integers
from igps._parameters import check_one_of
from igps.mesh._tidying import tidied, welded, with_small_holes_filled, without_hidden
from igps.mesh._union import united, without_walls
from igps.mesh.denoising import denoised, is_noisy
from igps.mesh.mesh import Mesh, MeshError, check_arrays, check_places, check_size
from igps.mesh.simplification import subdivided
from igps.mesh.watertight import crosses_itself, watertight

logger = logging.getLogger(__name__)

Mending = Literal["auto", "never", "always"]
Cavities = Literal["fill", "keep"]
Step = Literal["welded", "filled", "united", "smoothed", "subdivided", "watertight"]

MENDING_VERSION = 8
"""Raised whenever a surface that is mended would give another body: part of the cache keys of such bodies alone."""

# The first words of the notes of each step.
_WORDS: dict[str, Step] = {step: step for step in get_args(Step)}
_WORDS |= {"dropped": "welded", "turned": "welded", "made watertight": "watertight"}
# A mesh that is subdivided gets so many vertices for each that is needed: with just enough the last eigenfunctions
# would be those of the triangles.
_PLENTY = 4


def mend(
    vertices: Floats, faces: Integers | None, *, how: Mending = "auto", least_vertices: int = 0,
    normals: Floats | None = None, cavities: Cavities = "fill", denoise: bool = True, name: str = "mesh",
    notes: tuple[str, ...] = (),
) -> Mesh:  # fmt: skip
    """A body from a surface in any state, by the least that helps.

    In this order, and no further than needed: the surface as it is; coincident vertices welded, degenerate and doubled
    faces, fins, specks and closed parts inside the body dropped, faces turned; small holes filled; walls inside dropped
    or closed parts that overlap united, where that makes a body; `watertight`. A surface that is rough with a scanner's
    noise is smoothed, because noise adds area. One of fewer than `least_vertices` is subdivided, longest edges first.

    Args:
        vertices: (V, 3) positions, any length unit.
        faces: (F, 3) vertex indices; None or empty for a cloud of points, which is made watertight.
        how: "auto" for the above; "never" takes bodies only; "always" makes watertight what after welding is not the
            boundary of one body that does not cross itself, which "auto" does not ask.
        least_vertices: such as the number of eigenpairs plus two; not with "never".
        normals: (V, 3) of a cloud of points, if known.
        cavities: "fill" drops closed parts inside the body; "keep" takes them for the surfaces of hollows, unless it is
            made watertight.
        denoise: whether a surface that is rough with noise is smoothed; thin branches made of voxels look like noise.
        name: what error messages call the surface, usually its file.
        notes: what was done to it before.

    Raises:
        MeshError: the surface is not a body (with "never"), or nothing can be made of it.
    """
    check_one_of(get_args(Mending), how=how)
    if how == "never":
        return Mesh(vertices, np.asarray(faces), name=name, notes=notes, cavities=cavities == "keep")
    if faces is None or np.size(faces) == 0:
        vertices = np.asarray(vertices, dtype=np.float64)
        if vertices.size == 0:
            raise MeshError(f"{name}: the file is empty: no vertices and no faces. Export it again.")
        check_places(vertices, name)
        check_size(vertices, name)
        mesh = watertight(vertices, normals=normals, name=name)
    else:
        check_arrays(vertices, faces, name)
        vertices, triangles = np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64)
        if len(triangles) == 1:
            raise MeshError(f"{name}: a single triangle is no body. Check that the export is complete.")
        corners = vertices[triangles]
        if (corners == corners[:, :1]).all():
            raise MeshError(f"{name}: all faces are in one point; a surface was expected. Check the file.")
        check_size(corners.reshape(-1, 3), name)  # before squares of its lengths overflow or vanish
        mesh = (_remade if how == "always" else _mended)(vertices, triangles, name, cavities == "keep", denoise)
    n_outer = int(mesh.outer()[1].sum())
    if n_outer < least_vertices:
        mesh = subdivided(mesh, _PLENTY * least_vertices + len(mesh.vertices) - n_outer)
    for note in mesh.notes:
        logger.info("%s: %s", name, note)
    return mesh.annotated(notes=notes)


def repair_steps(notes: Iterable[str]) -> tuple[Step, ...]:
    """The steps behind the notes of a `Mesh` or `Signature`, in order, each once."""
    return tuple(dict.fromkeys(step for note in notes for start, step in _WORDS.items() if note.startswith(start)))


def _mended(vertices: Floats, faces: Integers, name: str, cavities: bool, denoise: bool) -> Mesh:
    notes: list[str] = []
    given = vertices, faces
    hidden = partial(without_hidden, cavities=cavities)
    for step in (None, welded, tidied, with_small_holes_filled, hidden):
        if step is not None and len(faces):
            vertices, faces = step(vertices, faces, notes)
        if body := _body(vertices, faces, notes, name, cavities, denoise):
            return body
    # Of a heap of parts these may make no body: then what they did is given up.
    for attempt, surface, done in ((without_walls, (vertices, faces), list(notes)), (united, given, [])):
        if len(surface[1]) and (body := _body(*attempt(*surface, done), done, name, cavities, denoise)):
            return body
    body = watertight(_smoothed(vertices, faces, notes, denoise), faces, name=name)
    return body.annotated(notes=tuple(notes))


def _body(vertices: Floats, faces: Integers, notes: list[str], name: str, cavities: bool, denoise: bool) -> Mesh | None:
    """The body that these are, smoothed if it is noisy; None if they are none."""
    try:
        mesh = Mesh(vertices, faces, name=name, notes=tuple(notes), cavities=cavities)
    except MeshError:
        return None
    smooth = _smoothed(mesh.vertices, mesh.faces, notes, denoise)
    return mesh if smooth is mesh.vertices else replace(mesh, vertices=smooth, notes=tuple(notes))


def _remade(vertices: Floats, faces: Integers, name: str, cavities: bool, denoise: bool) -> Mesh:
    """The surface as it is, welded or smoothed, if it bounds one body then; otherwise what a grid makes of it.

    A grid would join what lies side by side nearer than a cell, as the coils of a spring do.
    """
    notes: list[str] = []
    neat = vertices, faces
    for step in (None, welded):
        if step is not None:
            neat = step(vertices, faces, notes)
        if (body := _body(*neat, notes, name, cavities, denoise)) and not crosses_itself(body.vertices, body.faces):
            return body
        notes = []
    smooth = _smoothed(*neat, notes, denoise)
    body = watertight(smooth, neat[1], name=name) if notes else watertight(vertices, faces, name=name)
    return body.annotated(notes=tuple(notes))


def _smoothed(vertices: Floats, faces: Integers, notes: list[str], denoise: bool) -> Floats:
    if not denoise or not len(faces) or not is_noisy(vertices, faces):
        return vertices
    notes.append("smoothed: the surface was rough with noise")
    return denoised(vertices, faces)
