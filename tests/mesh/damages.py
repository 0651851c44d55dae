"""Damages of surfaces by scanners, modelling programs and converters.

Disturbances turn a valid `Mesh` into another. Damages yield raw triangles that are not valid, to test the reading and
mending of files. `DAMAGES` lists them with their usual strength.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.random import default_rng
from scipy import sparse
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from igps.mesh.errors import MeshError
from igps.mesh.mesh import Mesh
from igps.mesh.surface import area_vectors, compact, diagonal, face_areas, undirected_edges, unit
from igps.signature.voxels import interior_samples
from training import disturbances

Floats = np.ndarray
Integers = np.ndarray
Surface = tuple[np.ndarray, np.ndarray]

# Shares of the area that is missing, of faces that are turned, and of faces that are doubled; relative to the diagonal,
# the overlap of halves and the standard deviation of noise
_MISSING = 0.02
_TURNED = 1 / 3
_DOUBLED = 0.01
_OVERLAP = 0.02
_NOISE = 0.002
_N_PATCHES, _N_FINS = 3, 30


@dataclass(frozen=True)
class Damage:
    """A damage of a surface."""

    description: str  # kind and strength of the damage
    apply: Callable[[Mesh, int], Surface]  # damages a mesh, given a seed


def holes(mesh, seed=0):
    """Remove a share of the area, in round patches of equal size around random places."""
    return _with_holes(mesh.vertices, mesh.faces, default_rng(seed))


def soup(mesh, seed=0):
    """Give each triangle separate corners, in single precision and in random order, as in an STL file."""
    return _as_soup(mesh.vertices, mesh.faces, default_rng(seed))


def turned(mesh, seed=0):
    """Turn a random share of the faces inside out."""
    return mesh.vertices.copy(), _with_turned(mesh.faces, default_rng(seed))


def fins(mesh, seed=0):
    """Add triangles that stand on edges, as high as a hundredth of the diagonal, and double a share of the faces."""
    return _with_fins(mesh.vertices, mesh.faces, default_rng(seed))


def parts(mesh, seed=0):
    """Add a floating ball inside, where the body is thickest, with half the radius that fits, and a speck outside.

    The speck is a ball with a thousandth of the area, at 0.6 diagonals from the centre of the bounding box.
    """
    return _with_parts(mesh.vertices, mesh.faces, default_rng(seed), mesh)


def halves(mesh, seed=0):
    """Cut the body across its longest extent into two closed, overlapping halves; the seed is not used.

    Raises:
        MeshError: manifold3d does not accept the mesh.
    """
    import manifold3d

    centre = mesh.vertices.mean(axis=0)
    points = mesh.vertices - centre
    axis = np.linalg.eigh(points.T @ points)[1][:, -1]
    body = manifold3d.Manifold(
        manifold3d.Mesh64(
            np.ascontiguousarray(points),
            mesh.faces.astype(np.uint64),
        )
    )
    if body.status() != manifold3d.Error.NoError:
        raise MeshError(
            f"{mesh.name}: manifold3d does not accept the surface ({body.status()}), so it was not cut."
        )
    reach = _OVERLAP / 2 * diagonal(mesh.vertices)
    pieces = [body.trim_by_plane(sign * axis, -reach).to_mesh64() for sign in (1, -1)]
    vertices = [np.asarray(piece.vert_properties)[:, :3] + centre for piece in pieces]
    faces = [np.asarray(piece.tri_verts, dtype=np.int64) for piece in pieces]
    return np.vstack(vertices), np.vstack([faces[0], faces[1] + len(vertices[0])])


def noise(mesh, seed=0):
    """Move each vertex along its normal by a random length."""
    noisy = disturbances.noise(mesh, _NOISE, seed)
    return noisy.vertices.copy(), noisy.faces.copy()


def everything(mesh, seed=0):
    """Apply all of the above; a MeshError if manifold3d does not accept the mesh."""
    generator = default_rng(seed)
    vertices, faces = halves(disturbances.noise(mesh, _NOISE, seed))
    vertices, faces = _with_holes(vertices, faces, generator)
    vertices, faces = _with_fins(vertices, faces, generator)
    vertices, faces = _with_parts(vertices, faces, generator, mesh)
    return _as_soup(vertices, _with_turned(faces, generator), generator)


DAMAGES = {
    "holes": Damage("2 % of the surface missing, in three patches", holes),
    "soup": Damage(
        "every triangle with its own corners, in single precision, in random order", soup
    ),
    "turned": Damage("a third of the faces inside out", turned),
    "fins": Damage("30 triangles that stand on edges, and 1 % of the faces twice", fins),
    "parts": Damage("a ball that floats inside, and a speck outside", parts),
    "halves": Damage(
        "two closed halves that overlap by 2 % of the diagonal, by manifold3d", halves
    ),
    "noise": Damage(
        "vertices moved along their normals, standard deviation 0.2 % of the diagonal", noise
    ),
    "everything": Damage("all of these at once", everything),
}
"""The damages by name."""


def _with_holes(vertices, faces, generator):
    area = face_areas(vertices, faces)
    per_patch = _MISSING / _N_PATCHES * area.sum()
    pairs, _ = undirected_edges(faces)
    length = np.linalg.norm(
        vertices[pairs[:, 0]] - vertices[pairs[:, 1]],
        axis=1,
    )
    graph = sparse.csr_array(
        (np.maximum(length, 1e-300), tuple(pairs.T.astype(np.int32))), shape=(len(vertices),) * 2
    )
    is_kept = np.ones(len(faces), dtype=bool)
    for _ in range(_N_PATCHES):
        middle = generator.choice(
            len(area),
            p=area * is_kept / (area * is_kept).sum(),
        )
        away = (
            dijkstra(graph, directed=False, indices=faces[middle]).mean(axis=0)[faces].mean(axis=1)
        )
        order = np.argsort(
            np.where(is_kept, away, np.inf),
            kind="stable",
        )
        is_kept[order[: max(int((np.cumsum(area[order]) <= per_patch).sum()), 1)]] = False
    return compact(vertices, faces[is_kept])


def _as_soup(vertices, faces, generator):
    corners = vertices[generator.permutation(faces)].astype(np.float32).astype(np.float64)
    return corners.reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)


def _with_turned(faces, generator):
    faces = faces.copy()
    chosen = generator.permutation(len(faces))[: round(_TURNED * len(faces))]
    faces[chosen] = faces[chosen, ::-1]
    return faces


def _with_fins(vertices, faces, generator):
    face = generator.integers(len(faces), size=_N_FINS)
    corner = generator.integers(3, size=_N_FINS)
    a = faces[face, corner]
    b = faces[face, (corner + 1) % 3]
    normals = unit(area_vectors(vertices, faces)[face])
    tips = (vertices[a] + vertices[b]) / 2 + 0.01 * diagonal(vertices) * normals
    stands = np.stack(
        [a, b, len(vertices) + np.arange(_N_FINS)],
        axis=1,
    )
    twice = faces[generator.permutation(len(faces))[: max(round(_DOUBLED * len(faces)), 1)]]
    return np.vstack([vertices, tips]), np.vstack([faces, stands, twice])


def _with_parts(vertices, faces, generator, mesh):
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=2)
    ball = np.asarray(sphere.vertices)
    triangles = np.asarray(sphere.faces, dtype=np.int64)
    centre, radius = _deepest_ball(mesh)
    direction = generator.standard_normal(3)
    low = mesh.vertices.min(axis=0)
    high = mesh.vertices.max(axis=0)
    place = (low + high) / 2 + 0.6 * diagonal(mesh.vertices) * direction / np.linalg.norm(direction)
    speck = np.sqrt(1e-3 * mesh.area / (4 * np.pi))
    n = len(vertices)
    return (
        np.vstack(
            [
                vertices,
                centre + radius * ball,
                place + speck * ball,
            ]
        ),
        np.vstack(
            [
                faces,
                n + triangles,
                n + len(ball) + triangles,
            ]
        ),
    )


def _deepest_ball(mesh):
    """Return the interior sample farthest from vertices and face centres, and half that distance."""
    points = interior_samples(mesh, min_samples=1)
    surface = np.vstack(
        [
            mesh.vertices,
            mesh.vertices[mesh.faces].mean(axis=1),
        ]
    )
    away, _ = cKDTree(surface).query(points)
    deepest = int(np.argmax(away))
    return points[deepest], float(away[deepest]) / 2
