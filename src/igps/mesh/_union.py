"""One surface of parts that overlap: the outer shape, exactly, where a grid would only come near it."""

import numpy as np

from igps._arrays import Booleans, Floats, Integers, Surface
from igps.mesh._tidying import SPECK, oriented, tidied, welded, with_small_holes_filled
from igps.mesh.mesh import Mesh, MeshError
from igps.mesh.surface import area_vectors, compact, diagonal, face_areas, face_parts, face_patches, unit

# A place sees the outside if so many of the directions on one of its sides meet nothing.
_OPEN = 0.03
_DIRECTIONS, _PLACES_PER_PATCH = 100, 30
# Surfaces that are so near to each other, in units of the bounding box's diagonal, are one.
_COINCIDENT = 1e-6
# Surfaces of more patches or parts are heaps of triangles, for which a grid is the quicker way.
_MOST_PATCHES, _MOST_PARTS = 200, 200


def without_walls(vertices: Floats, faces: Integers, notes: list[str]) -> Surface:
    """Without the walls inside the body, and the sheets that lie on another, where more than two faces meet in an edge.

    Parts that overlap and share vertices leave them, as does a body that was cut and put together again. A patch (see
    `face_patches`) goes only if that opens no hole, because two others meet wherever it ends, and if the others cover
    what of it sees the outside. What sees the least goes first, then the smallest.
    """
    patch, ends_at_others = face_patches(faces, len(vertices))
    if not 1 < len(ends_at_others) <= _MOST_PATCHES:
        return vertices, faces
    points = np.ascontiguousarray((vertices - vertices.mean(axis=0)) / diagonal(vertices))
    seen = _places(points, faces, patch)
    n_dropped = 0
    while (number := _superfluous(points, faces, patch, ends_at_others, *seen)) >= 0:
        kept = (patch >= 0) & (patch != number)
        patch = np.full(len(faces), -1)
        patch[kept], ends_at_others = face_patches(faces[kept], len(points))
        n_dropped += 1
    if not n_dropped:
        return vertices, faces
    notes.append(f"dropped {n_dropped} walls inside")
    vertices, faces = compact(vertices, faces[patch >= 0])
    return vertices, oriented(faces, notes)


def _superfluous(
    points: Floats, faces: Integers, patch: Integers, ends_at_others: Booleans, places: Floats, at: Integers,
    sees: Booleans,
) -> int:  # fmt: skip
    """The patch that may go first, or −1; faces that are gone are of patch −1, and `places` lie on the faces `at`."""
    import igl

    of_patch, there = patch[at], patch >= 0
    size = np.bincount(patch[there], face_areas(points, faces[there]))
    n_places = np.maximum(np.bincount(of_patch[of_patch >= 0], minlength=len(size)), 1)
    seeing = np.bincount(of_patch[of_patch >= 0], sees[of_patch >= 0], len(size)) / n_places
    for number in np.lexsort((size, seeing)).tolist():
        if not ends_at_others[number]:
            continue
        shown = np.ascontiguousarray(places[(of_patch == number) & sees])
        rest = faces[there & (patch != number)]
        squared = igl.point_mesh_squared_distance(shown, points, rest)[0] if len(shown) else np.zeros(1)
        if np.max(squared) <= _COINCIDENT**2:
            return number
    return -1


def _places(points: Floats, faces: Integers, patch: Integers) -> tuple[Floats, Integers, Booleans]:
    """Places (S, 3) on each patch, evenly by area and always the same; their faces (S,); and which see outside."""
    import igl

    areas = face_areas(points, faces)
    generator = np.random.default_rng(0)
    chosen = []
    for number in range(int(patch.max()) + 1):
        members = np.nonzero((patch == number) & (areas > 0))[0]
        if len(members):
            chosen.append(generator.choice(members, _PLACES_PER_PATCH, p=areas[members] / areas[members].sum()))
    at = np.concatenate(chosen)
    places = np.einsum("sc,scx->sx", generator.dirichlet(np.ones(3), len(at)), points[faces[at]])
    normals = unit(area_vectors(points, faces[at]))
    occluded = [
        np.asarray(igl.ambient_occlusion(points, faces, places, np.ascontiguousarray(side), _DIRECTIONS)).ravel()
        for side in (normals, -normals)
    ]
    return places, at, 1 - np.minimum(*occluded) > _OPEN


def united(vertices: Floats, faces: Integers, notes: list[str]) -> Surface:
    """The outer surface of parts that are closed each by itself and overlap, by manifold3d.

    Each part is tidied on its own, and turned outward. The surface as it is, and no note, if a part is not closed, if
    they do not overlap or are too many or only one.
    """
    import manifold3d

    part, areas = face_parts(vertices, faces)
    speck = areas < SPECK * areas.sum()
    if not 1 < int((~speck).sum()) <= _MOST_PARTS:
        return vertices, faces
    solids = []
    for number in np.nonzero(~speck)[0]:
        points, triangles = compact(vertices, faces[part == number])
        for step in (welded, tidied, with_small_holes_filled):
            points, triangles = step(points, triangles, [])
        try:
            body = Mesh(points, triangles)
        except MeshError:
            return vertices, faces
        solid = manifold3d.Manifold(manifold3d.Mesh64(body.vertices.copy(), body.faces.astype(np.uint64)))
        if solid.status() != manifold3d.Error.NoError:
            return vertices, faces
        solids.append(solid)
    whole = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add)
    if whole.status() != manifold3d.Error.NoError or len(whole.decompose()) != 1:
        return vertices, faces
    mesh = whole.to_mesh64()
    notes.append(f"united {len(solids)} closed parts that overlap")
    return np.asarray(mesh.vert_properties)[:, :3].copy(), np.asarray(mesh.tri_verts, dtype=np.int64)
