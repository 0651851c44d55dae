"""Unite overlapping parts into one surface: their exact outer shape, which a grid would only approximate."""

import numpy as np

from igps._arrays import Booleans, Floats, Integers, Surface
from igps._text import counted
from igps.mesh._tidying import SPECK, fill_small_holes, orient, tidy, weld
from igps.mesh.errors import MeshError
from igps.mesh.mesh import Mesh
from igps.mesh.surface import (
    area_vectors,
    compact,
    diagonal,
    face_areas,
    face_parts,
    face_patches,
    unit,
)

_MIN_OPEN = 0.03  # a point of a surface is visible if this share of the directions on one of its sides is free
_N_DIRECTIONS = 100
_SAMPLES_PER_PATCH = 30
_COINCIDENT = 1e-6  # surfaces nearer than this coincide, in units of the bounding box's diagonal
# Surfaces of more patches or parts are left to the grid, which is faster there.
_MAX_PATCHES = 200
_MAX_PARTS = 200


def drop_inner_walls(vertices: Floats, faces: Integers, notes: list[str]) -> Surface:
    """Drop walls inside the body and sheets that lie on another one, if more than two faces meet in their edges.

    They come from overlapping parts with common vertices, and from bodies that were cut and put together again. A patch
    (see `face_patches`) is dropped only if two others meet wherever it ends, so that no hole opens, and if others cover
    its visible points. The least visible patches are dropped first; among equals, the smallest.
    """
    patch, ends_at_others = face_patches(faces, len(vertices))
    if not 1 < len(ends_at_others) <= _MAX_PATCHES:
        return vertices, faces
    points = np.ascontiguousarray((vertices - vertices.mean(axis=0)) / diagonal(vertices))
    samples = _sample_patches(points, faces, patch)
    n_dropped = 0
    while (dropped := _superfluous_patch(points, faces, patch, ends_at_others, *samples)) >= 0:
        is_kept = (patch >= 0) & (patch != dropped)
        patch = np.full(len(faces), -1)
        patch[is_kept], ends_at_others = face_patches(faces[is_kept], len(points))
        n_dropped += 1
    if not n_dropped:
        return vertices, faces
    notes.append(f"dropped {counted(n_dropped, 'wall')} inside")
    vertices, faces = compact(vertices, faces[patch >= 0])
    return vertices, orient(faces, notes)


def _superfluous_patch(
    points: Floats,
    faces: Integers,
    patch: Integers,
    ends_at_others: Booleans,
    samples: Floats,
    face_of_sample: Integers,
    is_visible: Booleans,
) -> int:
    """Return the next patch to drop, or -1; dropped faces have the patch -1."""
    import igl

    patch_of_sample = patch[face_of_sample]
    is_left = patch >= 0
    size = np.bincount(patch[is_left], face_areas(points, faces[is_left]))
    in_patch = patch_of_sample >= 0
    patches = patch_of_sample[in_patch]
    n_samples = np.bincount(patches, minlength=len(size))
    n_visible = np.bincount(patches, is_visible[in_patch], len(size))
    visible_share = n_visible / np.maximum(n_samples, 1)
    for k in np.lexsort((size, visible_share)).tolist():
        if not ends_at_others[k]:
            continue
        visible = np.ascontiguousarray(samples[(patch_of_sample == k) & is_visible])
        if not len(visible):
            return k
        others = faces[is_left & (patch != k)]
        squared, _, _ = igl.point_mesh_squared_distance(visible, points, others)
        if np.max(squared) <= _COINCIDENT**2:
            return k
    return -1


def _sample_patches(
    points: Floats, faces: Integers, patch: Integers
) -> tuple[Floats, Integers, Booleans]:
    """Sample each patch uniformly by area, reproducibly: points (S, 3), their faces (S,), and which are visible."""
    import igl

    areas = face_areas(points, faces)
    generator = np.random.default_rng(0)
    chosen = []
    for k in range(int(patch.max()) + 1):
        members = np.nonzero((patch == k) & (areas > 0))[0]
        if len(members):
            shares = areas[members] / areas[members].sum()
            chosen.append(generator.choice(members, _SAMPLES_PER_PATCH, p=shares))
    face = np.concatenate(chosen)
    weights = generator.dirichlet(np.ones(3), len(face))
    samples = np.einsum("sc,scx->sx", weights, points[faces[face]])
    normals = unit(area_vectors(points, faces[face]))

    def hidden_share(directions: Floats) -> Floats:
        directions = np.ascontiguousarray(directions)
        share = igl.ambient_occlusion(points, faces, samples, directions, _N_DIRECTIONS)
        return np.asarray(share).ravel()

    hidden = np.minimum(hidden_share(normals), hidden_share(-normals))
    return samples, face, 1 - hidden > _MIN_OPEN


def unite_parts(vertices: Floats, faces: Integers, notes: list[str]) -> Surface:
    """Return the outer surface of overlapping closed parts, by manifold3d.

    Each part is first tidied on its own and oriented outward. The surface is returned unchanged, without a note, if a
    part is not closed, if the parts do not form one piece, or if there are too many parts or only one.
    """
    import manifold3d

    part, areas = face_parts(vertices, faces)
    large = np.nonzero(areas >= SPECK * areas.sum())[0]
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
        surface = manifold3d.Mesh64(body.vertices.copy(), body.faces.astype(np.uint64))
        solid = manifold3d.Manifold(surface)
        if solid.status() != manifold3d.Error.NoError:
            return vertices, faces
        solids.append(solid)
    union = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add)
    if union.status() != manifold3d.Error.NoError or len(union.decompose()) != 1:
        return vertices, faces
    mesh = union.to_mesh64()
    notes.append(f"united {len(solids)} closed parts that overlap")
    united = np.asarray(mesh.vert_properties)[:, :3].copy()
    return united, np.asarray(mesh.tri_verts, dtype=np.int64)
