"""Unite overlapping parts into one surface: their exact outer shape, which a grid would only approximate."""

import numpy as np

from igps._arrays import Floats, Integers, Surface
from igps.mesh._tidying import SPECK, fill_small_holes, tidy, weld
from igps.mesh.errors import MeshError
from igps.mesh.mesh import Mesh
from igps.mesh.surface import compact, face_parts

_MAX_PARTS = 200  # more are left to the grid, which is faster there


def unite_parts(vertices: Floats, faces: Integers, notes: list[str]) -> Surface:
    """Return the outer surface of overlapping closed parts, by manifold3d.

    Each part is first tidied on its own and oriented outward. The surface is returned unchanged, without a note, if a
    part is not closed, if the parts do not form one piece, or if there are too many parts or only one.
    """
    import manifold3d

    part, areas = face_parts(vertices, faces)
    large = np.flatnonzero(areas >= SPECK * areas.sum())
    if not 1 < len(large) <= _MAX_PARTS:
        return vertices, faces
    solids = []
    for k in large:
        points, triangles = compact(vertices, faces[part == k])
        for step in (weld, tidy, fill_small_holes):
            points, triangles = step(points, triangles, [])
        try:
            body = Mesh(points, triangles)
        except MeshError:
            return vertices, faces
        corners = body.faces.astype(np.uint64)
        surface = manifold3d.Mesh64(body.vertices.copy(), corners)
        solid = manifold3d.Manifold(surface)
        if solid.status() != manifold3d.Error.NoError:
            return vertices, faces
        solids.append(solid)
    union = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add)
    if union.status() != manifold3d.Error.NoError or len(union.decompose()) != 1:
        return vertices, faces
    notes.append(f"united {len(solids)} closed parts that overlap")
    mesh = union.to_mesh64()
    vertices = np.asarray(mesh.vert_properties)[:, :3].copy()
    faces = np.asarray(mesh.tri_verts, dtype=np.int64)
    return vertices, faces
