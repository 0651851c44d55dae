"""Disturbances of meshes: noise, resampling, holes, lost limbs, scale and motion.

Each function returns a new, checked `Mesh` whose notes state the change.
"""

from dataclasses import replace

import numpy as np
from scipy.sparse.csgraph import dijkstra
from scipy.spatial.transform import Rotation

from igps._arrays import Floats, Integers
from igps.descriptors.literature.geodesics import edge_graph
from igps.mesh.errors import MeshError
from igps.mesh.mesh import Mesh
from igps.mesh.simplification import simplify
from igps.mesh.surface import components, face_areas, vertex_normals


def noise(mesh: Mesh, amplitude: float = 0.005, seed: int = 0) -> Mesh:
    """Move each vertex along its normal by a normally distributed length.

    Args:
        mesh: the body.
        amplitude: standard deviation of that length over the diagonal of the bounding box.
        seed: seed of the lengths.

    Raises:
        ValueError: `amplitude` is not positive.
    """
    if not amplitude > 0:
        raise ValueError(f"amplitude: expected a positive share of the diagonal, got {amplitude}.")
    generator = np.random.default_rng(seed)
    lengths = generator.normal(0, amplitude * mesh.diagonal, len(mesh.vertices))
    steps = lengths[:, None] * vertex_normals(mesh.vertices, mesh.faces)
    note = f"every vertex moved along its normal, standard deviation {amplitude:g} of the bounding box diagonal"
    return _changed(mesh, mesh.vertices + steps, mesh.faces, note)


def simplified(mesh: Mesh, share: float) -> Mesh:
    """Simplify a mesh to a share of its vertices, see `simplify`.

    Raises:
        MeshError: the share cannot be reached.
    """
    _check_share(share)
    n_vertices = round(share * len(mesh.vertices))
    return simplify(mesh, max(n_vertices, 4))


def remesh(mesh: Mesh) -> Mesh:
    """Replace the triangles by as many others, of more even size.

    Each triangle is cut into four at the midpoints of its sides. Then the shortest edges are collapsed to their
    midpoints, one by one, until the number of faces is the old one. Finally, vertices are projected to the nearest
    points of the old surface. No step changes the topology.

    Raises:
        MeshError: the old number of faces cannot be reached.
    """
    import igl

    n_faces = len(mesh.faces)
    old_vertices = np.asfortranarray(mesh.vertices)
    old_faces = np.asfortranarray(mesh.faces)
    vertices, faces = igl.upsample(old_vertices, np.asfortranarray(old_faces, dtype=np.int32))
    vertices = np.asfortranarray(vertices)
    faces = np.asfortranarray(faces, dtype=np.int32)
    vertices, faces, *_ = igl.decimate(vertices, faces, n_faces)
    if len(faces) > n_faces:
        raise MeshError(
            f"{mesh.name}: could not be remeshed with {n_faces} faces without a change of topology "
            f"(got {len(faces)})."
        )
    vertices = np.asfortranarray(vertices)
    _, _, vertices = igl.point_mesh_squared_distance(vertices, old_vertices, old_faces)
    note = "remeshed: every face cut into four, then the shortest edges collapsed"
    return _changed(mesh, vertices, faces, note)


def hole(mesh: Mesh, share: float = 0.01, seed: int = 0) -> Mesh:
    """Remove a patch from the surface: the faces geodesically nearest to a random face.

    Args:
        mesh: the body.
        share: largest share of the area; halved until the patch does not cut the surface in two.
        seed: seed of the random face.

    Returns:
        An open mesh.

    Raises:
        ValueError: `share` is out of range.
    """
    _check_share(share)
    areas = face_areas(mesh.vertices, mesh.faces)
    area = areas.sum()
    middle = np.random.default_rng(seed).choice(len(areas), p=areas / area)
    from_corners = dijkstra(edge_graph(mesh), indices=mesh.faces[middle])
    at_vertices = from_corners.mean(axis=0)
    away = at_vertices[mesh.faces].mean(axis=1)
    order = np.argsort(away, kind="stable")
    is_within = np.cumsum(areas[order]) <= share * area
    n_removed = max(int(is_within.sum()), 1)
    while True:
        kept = np.delete(mesh.faces, order[:n_removed], axis=0)
        used, faces = np.unique(kept, return_inverse=True)
        faces = faces.reshape(-1, 3)
        n_pieces = components(faces, len(used))[0]
        if n_removed == 1 or n_pieces == 1:
            break
        n_removed //= 2
    lost = 1 - face_areas(mesh.vertices, kept).sum() / area
    note = f"a hole of {n_removed} faces, {lost:.2%} of the area"
    return replace(
        mesh,
        vertices=mesh.vertices[used],
        faces=faces,
        allow_open=True,
        notes=(*mesh.notes, note),
    )


def clip(mesh: Mesh, share: float = 0.1) -> Mesh:
    """Cut off the end that is farthest from the centroid, and close the cut with a flat cap.

    The plane is perpendicular to the direction from the centroid of the surface to the vertex farthest from it. If
    several pieces remain, the one of the largest volume is kept. Manifold3d makes the cut and the cap.

    Args:
        mesh: a closed body.
        share: share of the extent of the body in that direction.

    Raises:
        ValueError: `share` is out of range.
        MeshError: manifold3d does not accept the mesh, or nothing remains.
    """
    _check_share(share)
    import manifold3d

    areas = face_areas(mesh.vertices, mesh.faces)
    middles = mesh.vertices[mesh.faces].mean(axis=1)
    centre = np.average(middles, axis=0, weights=areas)
    points = mesh.vertices - centre
    distance = np.linalg.norm(points, axis=1)
    direction = points[np.argmax(distance)] / distance.max()
    along = points @ direction
    cut = along.max() - share * np.ptp(along)
    surface = manifold3d.Mesh64(np.ascontiguousarray(points), mesh.faces.astype(np.uint64))
    body = manifold3d.Manifold(surface)
    if body.status() != manifold3d.Error.NoError:
        raise MeshError(
            f"{mesh.name}: manifold3d does not accept the surface ({body.status()}), so it was not cut."
        )
    pieces = body.trim_by_plane(-direction, -float(cut)).decompose()
    if not pieces:
        raise MeshError(f"{mesh.name}: nothing remains when the farthest {share:.0%} are cut off.")
    piece = max(pieces, key=lambda x: x.volume()).to_mesh64()
    faces = np.asarray(piece.tri_verts, dtype=np.int64)
    vertices = np.asarray(piece.vert_properties)[:, :3] + centre
    result = _changed(mesh, vertices, faces, "clipped")
    lost = 1 - result.volume / mesh.volume
    note = f"the farthest {share:.0%} of its extent cut off and capped, {lost:.2%} of the volume"
    return replace(result, notes=(*mesh.notes, note))


def scale(mesh: Mesh, factor: float) -> Mesh:
    """Multiply all lengths by a positive factor."""
    if not 0 < factor < np.inf:
        raise ValueError(f"factor: expected a positive number, got {factor}.")
    return _changed(mesh, mesh.vertices * factor, mesh.faces, f"scaled by {factor:g}")


def move(mesh: Mesh, seed: int = 0) -> Mesh:
    """Rotate the mesh around its centre by a uniformly random rotation, and move it by twice its diagonal.

    Rotations are uniform: normalised quaternions of normal random numbers (Shoemake 1992).
    """
    generator = np.random.default_rng(seed)
    rotation = Rotation.from_quat(generator.standard_normal(4))
    direction = generator.standard_normal(3)
    offset = 2 * mesh.diagonal * direction / np.linalg.norm(direction)
    centre = mesh.vertices.mean(axis=0)
    turned = rotation.apply(mesh.vertices - centre)
    moved = turned + centre + offset
    return _changed(mesh, moved, mesh.faces, "turned and moved")


def _check_share(share: float) -> None:
    if not 0 < share < 1:
        raise ValueError(f"share: expected a number between 0 and 1, got {share}.")


def _changed(mesh: Mesh, vertices: Floats, faces: Integers, note: str) -> Mesh:
    return replace(mesh, vertices=vertices, faces=faces, notes=(*mesh.notes, note))
