"""The triangles of a surface tidied up: welded, turned alike, without fins, specks and what is hidden inside."""

from __future__ import annotations

import numpy as np

from igps._arrays import Booleans, Floats, Integers, Surface
from igps.mesh.mesh import Mesh, MeshError
from igps.mesh.surface import compact, diagonal, face_areas, face_parts, signed_volume, undirected_edges
from igps.mesh.winding import winding_number

# Vertices closer than this share of the bounding box's diagonal are one.
_WELD = 1e-8
# Parts of less than this share of the area are specks, unless all of them together have ten times as much.
SPECK = 2e-3
# Fins may have this share of the area.
_FINS = 0.05


def welded(vertices: Floats, faces: Integers, notes: list[str]) -> Surface:
    """Coincident vertices made one, degenerate and doubled faces and unused vertices dropped, neighbours turned alike.

    Vertices and faces that stay keep their order. What was done is added to `notes`.
    """
    place = places(vertices)
    n_places = len(np.unique(place))
    if n_places < len(vertices):
        notes.append(f"welded {len(vertices) - n_places} coincident vertices")
        faces = place[faces]
    is_degenerate = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    if is_degenerate.any():
        notes.append(f"dropped {int(is_degenerate.sum())} degenerate faces")
        faces = faces[~is_degenerate]
    _, once = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    if len(once) < len(faces):
        notes.append(f"dropped {len(faces) - len(once)} duplicate faces")
        faces = faces[np.sort(once)]
    unused = n_places - len(np.unique(faces))
    if unused:
        notes.append(f"dropped {unused} unreferenced vertices")
    vertices, faces = compact(vertices, faces)
    return vertices, oriented(faces, notes)


def places(vertices: Floats) -> Integers:
    """(V,) of each vertex the first that is in the same place, on a lattice in units of the bounding box."""
    lattice = np.round((vertices - vertices.mean(axis=0)) / (_WELD * max(diagonal(vertices), np.finfo(float).tiny)))
    _, first, index = np.unique(lattice.astype(np.int64), axis=0, return_index=True, return_inverse=True)
    return np.asarray(first[index.ravel()])


def are_specks(areas: Floats) -> Booleans:
    """Which of the parts with these areas are specks; none if all specks together have much area."""
    specks = areas < SPECK * areas.sum()
    return specks & (areas[specks].sum() < 10 * SPECK * areas.sum())


def oriented(faces: Integers, notes: list[str]) -> Integers:
    """The faces turned so that neighbours agree, as far as the surface can be oriented; the smaller side is turned."""
    if not len(faces):
        return faces
    import igl

    agreeing, part = igl.bfs_orient(faces)
    turn = (agreeing != faces).any(axis=1)
    turn ^= (np.bincount(part, weights=turn) > np.bincount(part) / 2)[part]
    if turn.any():
        notes.append(f"turned {int(turn.sum())} faces to orient the surface")
        faces = np.where(turn[:, None], faces[:, ::-1], faces)
    return faces


def tidied(vertices: Floats, faces: Integers, notes: list[str]) -> Surface:
    """Without fins and specks, and turned alike once it is plain which faces are neighbours."""
    kept = _without_fins(vertices, faces)
    if len(kept) < len(faces):
        notes.append(f"dropped {len(faces) - len(kept)} faces of fins")
        faces = kept
    part, areas = face_parts(vertices, faces)
    specks = are_specks(areas)
    if specks.any():
        notes.append(f"dropped {int(specks.sum())} specks")
        faces = faces[~specks[part]]
    vertices, faces = compact(vertices, faces)
    return vertices, oriented(faces, notes)


def _without_fins(vertices: Floats, faces: Integers) -> Integers:
    """The faces but for those that hang on an edge of two others, peeled from their free edges; all, if they are many.

    A face with a second free edge that is left of a larger fin does no harm: it hangs on nothing crowded.
    """
    kept = faces
    while len(kept):
        _, edge_of_side = undirected_edges(kept, len(vertices))
        count = np.bincount(edge_of_side)[edge_of_side].reshape(-1, 3)
        fin = (count == 1).any(axis=1) & (count > 2).any(axis=1)
        if not fin.any():
            break
        kept = kept[~fin]
    left = face_areas(vertices, kept).sum()
    return kept if left >= (1 - _FINS) * face_areas(vertices, faces).sum() else faces


def without_hidden(vertices: Floats, faces: Integers, notes: list[str], *, cavities: bool = False) -> Surface:
    """Without the parts that lie inside the largest, if that is closed.

    With `cavities` those of them stay that are closed and lie in no other, turned so that they bound hollows.
    """
    part, areas = face_parts(vertices, faces)
    if len(areas) < 2:
        return vertices, faces
    largest = int(np.argmax(areas))
    try:
        body = Mesh(*compact(vertices, faces[part == largest]))
    except MeshError:
        return vertices, faces
    others = np.unique(faces[part != largest])
    within = np.zeros(len(vertices), dtype=bool)
    within[others] = winding_number(body.vertices, body.faces, vertices[others]) > 0.5
    hidden = np.bincount(part, weights=~within[faces].all(axis=1), minlength=len(areas)) == 0
    if not hidden.any():
        return vertices, faces
    if cavities:
        faces = faces.copy()
        kept: list[Mesh] = []
        for k in sorted(np.flatnonzero(hidden), key=lambda k: -areas[k]):
            own = part == k
            surface = compact(vertices, faces[own])
            try:
                cavity = Mesh(*surface)
            except MeshError:
                continue
            if any((winding_number(one.vertices, one.faces, cavity.vertices) > 0.5).any() for one in kept):
                continue
            kept.append(cavity)
            hidden[k] = False
            if signed_volume(*surface) > 0:
                notes.append("turned the surface of a cavity towards the inside")
                faces[own] = faces[own][:, ::-1]
    if hidden.any():
        notes.append(f"dropped {int(hidden.sum())} parts hidden inside")
    return compact(vertices, faces[~hidden[part]])
