"""The closed surface on which a function on a grid is zero: marching cubes, then fewer and better triangles."""

import numpy as np

from igps._arrays import Floats, Integers, Singles, Surface
from igps.mesh._level_set import LEAST, without_bubbles
from igps.mesh.mesh import MeshError
from igps.mesh.surface import directed_edges, face_areas, largest, longest_side, signed_volume, vertex_normals

# Least cosine between the normals of triangles in a flat place.
_FLAT = 0.95


def level_surface(field: Singles, name: str) -> Surface:
    """The closed surface on which the field is zero; grid points are filled where it would touch itself."""
    from skimage.measure import marching_cubes

    for _ in range(20):
        if not (field.min() < 0 < field.max()):
            thin = "no point of the grid lies in the body, which is too thin everywhere for its length"
            raise MeshError(f"{name}: {thin}. Give it some thickness.")
        vertices, faces, _, _ = marching_cubes(field, 0.0, allow_degenerate=True)
        faces = faces.astype(np.int64)
        bad = _bad_edges(faces, len(vertices))
        if not len(bad):
            return vertices.astype(np.float64), faces
        # The four or eight grid points around a place where the surface meets itself.
        for vertex in np.unique(bad):
            low, high = np.floor(vertices[vertex]).astype(int), np.ceil(vertices[vertex]).astype(int)
            box = tuple(slice(max(low[d], 1), min(high[d] + 1, field.shape[d] - 1)) for d in range(3))
            field[box] = np.minimum(field[box], -LEAST)
        field = without_bubbles(field)
    raise MeshError(f"{name}: no closed surface came of it. Raise the resolution.")


def simplified(vertices: Floats, faces: Integers, max_vertices: int) -> Surface:
    """With at most about so many vertices and the same volume, or as it is where that makes it no closed surface."""
    if len(vertices) <= max_vertices:
        return vertices, faces
    import igl

    scale = longest_side(vertices)
    points, triangles = vertices / scale, faces
    # The shortest edges first, which marching cubes leave in plenty and which need no quadrics: that is much faster.
    for collapse, n_vertices in ((igl.decimate, 3 * max_vertices), (igl.qslim, max_vertices)):
        target = len(triangles) - 2 * (len(points) - n_vertices)
        if len(points) > n_vertices:
            triangles = np.asfortranarray(triangles.astype(np.int32))
            points, triangles, *_ = collapse(np.asfortranarray(points), triangles, target)
    triangles = np.asarray(triangles, dtype=np.int64)
    if len(triangles) == 0 or len(_bad_edges(triangles, len(points))) or not np.isfinite(points).all():
        return vertices, faces
    points, triangles = largest(points * scale, triangles)
    triangles = _flipped(points, triangles)
    return with_volume(points, triangles, signed_volume(vertices, faces)), triangles


def with_volume(vertices: Floats, faces: Integers, volume: float) -> Floats:
    """The vertices moved along their normals, all by the same length, to give the volume that cut corners took."""
    left = 0.25
    for _ in range(3):
        step = (volume - signed_volume(vertices, faces)) / face_areas(vertices, faces).sum()
        step = float(np.clip(step, -left, left))
        vertices = vertices + step * vertex_normals(vertices, faces)
        left -= abs(step)
    return vertices


def _bad_edges(faces: Integers, n_vertices: int) -> Integers:
    """(E, 2) vertices of the edges that are not run through once in each direction."""
    start, end = directed_edges(faces)
    forward, backward = np.sort(start * n_vertices + end), np.sort(end * n_vertices + start)
    if (forward[1:] > forward[:-1]).all() and np.array_equal(forward, backward):
        return np.zeros((0, 2), dtype=np.int64)
    forward, n_forward = np.unique(forward, return_counts=True)
    bad = np.concatenate([forward[n_forward > 1], np.setxor1d(forward, backward)])
    return np.stack([bad // n_vertices, bad % n_vertices], axis=1)


def _flipped(vertices: Floats, faces: Integers) -> Integers:
    """The faces after edges were turned where the two angles that face them are more than 180° together.

    Quadrics leave long thin triangles in flat places; there these flips lead to a Delaunay triangulation, on which the
    cotangent weights are positive. Edges where the surface bends stay.
    """
    for _ in range(30):
        n = len(vertices)
        start, end = directed_edges(faces)
        opposite = np.roll(faces, 1, axis=1).ravel()
        forward = start * n + end
        order = np.argsort(forward)
        # Each edge once, as a side of one face and the other side of another.
        side = np.nonzero(start < end)[0]
        other = order[np.searchsorted(forward[order], end[side] * n + start[side])]
        a, b, c, d = start[side], end[side], opposite[side], opposite[other]
        pa, pb, pc, pd = vertices[a], vertices[b], vertices[c], vertices[d]
        gain = _angle(pc, pa, pb) + _angle(pd, pb, pa) - np.pi
        old = [np.cross(pb - pa, pc - pa), np.cross(pa - pb, pd - pb)]
        new = [np.cross(pd - pc, pb - pc), np.cross(pc - pd, pa - pd)]
        mean = old[0] + old[1]
        length = np.linalg.norm(mean, axis=1, keepdims=True)
        mean = mean / np.maximum(length, 1e-30)
        flat = np.ones(len(side), dtype=bool)
        for vectors in (*old, *new):
            size = np.linalg.norm(vectors, axis=1)
            # A triangle so thin that it has no direction may go either way.
            flat &= (np.einsum("ij,ij->i", vectors, mean) > _FLAT * size) | (size < 1e-3 * length[:, 0])
        exists = np.isin(np.minimum(c, d) * n + np.maximum(c, d), np.minimum(start, end) * n + np.maximum(start, end))
        wanted = np.nonzero((gain > 1e-3) & flat & ~exists & (c != d))[0]
        # Every face takes part in the best of its flips only, and no two flips make the same edge.
        one, two, gain = side[wanted] // 3, other[wanted] // 3, gain[wanted]
        best = np.full(len(faces), -np.inf)
        for of_face in (one, two):
            np.maximum.at(best, of_face, gain)
        chosen = np.nonzero((gain >= best[one]) & (gain >= best[two]))[0]
        corners = np.minimum(c, d)[wanted] * n + np.maximum(c, d)[wanted]
        chosen = chosen[np.unique(corners[chosen], return_index=True)[1]]
        taken, count = np.unique(np.concatenate([one[chosen], two[chosen]]), return_counts=True)
        crowded = taken[count > 1]
        chosen = chosen[~np.isin(one[chosen], crowded) & ~np.isin(two[chosen], crowded)]
        if not len(chosen):
            break
        a, b, c, d = (corner[wanted[chosen]] for corner in (a, b, c, d))
        faces = faces.copy()
        faces[one[chosen]], faces[two[chosen]] = np.stack([c, d, b], axis=1), np.stack([d, c, a], axis=1)
    return faces


def _angle(at: Floats, a: Floats, b: Floats) -> Floats:
    u, v = a - at, b - at
    return np.arctan2(np.linalg.norm(np.cross(u, v), axis=1), np.einsum("ij,ij->i", u, v))
