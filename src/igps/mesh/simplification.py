"""Fewer triangles for the same body."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from igps.mesh.mesh import Mesh, MeshError
from igps.mesh.surface import longest_side


def simplify(mesh: Mesh, max_vertices: int) -> Mesh:
    """The mesh with at most `max_vertices` vertices, by quadric edge collapse (Garland and Heckbert 1997).

    A mesh that is small enough is returned as it is. No collapse changes the topology (libigl's `qslim` checks each),
    so that a closed manifold stays one; the result is checked again like any mesh. A MeshError where `max_vertices`
    cannot be reached, or the simplified surface is not a body any more.
    """
    if max_vertices < 4:
        raise ValueError(f"max_vertices: expected at least 4, got {max_vertices}.")
    surplus = len(mesh.vertices) - max_vertices
    if surplus <= 0:
        return mesh
    import igl

    # In unit scale, because quadrics are sums of squares. A collapse on a closed surface takes a vertex and two faces.
    centre, scale = mesh.vertices.mean(axis=0), longest_side(mesh.vertices)
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
