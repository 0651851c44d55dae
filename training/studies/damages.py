"""What scanners, modelling programs and converters do to a surface: raw triangles that are no `Mesh` any more.

Unlike the disturbances, which lead from body to body, these are for what reads and mends files. `DAMAGES` lists them
with their usual strength.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from igps.mesh.mesh import Mesh, MeshError
from igps.mesh.surface import area_vectors, compact, diagonal, face_areas, undirected_edges, unit
from igps.signature.voxels import interior_samples
from training.studies import disturbances

Triangles = tuple[NDArray[np.float64], NDArray[np.int64]]
"""Vertices (V, 3) and faces (F, 3), unchecked."""


@dataclass(frozen=True)
class Damage:
    """Something that a surface may suffer.

    Args:
        description: what is done, and how much of it.
        apply: does it to a mesh, given a seed.
    """

    description: str
    apply: Callable[[Mesh, int], Triangles]


def holes(mesh: Mesh, seed: int = 0, share: float = 0.02, n_patches: int = 3) -> Triangles:
    """Without `share` of the area, in round patches about random places.

    Args:
        mesh: the body.
        seed: of the places.
        share: of the area.
        n_patches: into which the share is divided evenly.
    """
    return _with_holes(mesh.vertices, mesh.faces, np.random.default_rng(seed), share, n_patches)


def soup(mesh: Mesh, seed: int = 0) -> Triangles:
    """Every triangle with corners of its own, in single precision, in random order, as in an STL file."""
    return _as_soup(mesh.vertices, mesh.faces, np.random.default_rng(seed))


def turned(mesh: Mesh, seed: int = 0, share: float = 1 / 3) -> Triangles:
    """A random share of the faces inside out."""
    return mesh.vertices.copy(), _with_turned(mesh.faces, np.random.default_rng(seed), share)


def fins(mesh: Mesh, seed: int = 0, n_fins: int = 30, doubled: float = 0.01) -> Triangles:
    """Triangles that stand on edges of the surface, and a share of the faces twice.

    Args:
        mesh: the body.
        seed: of the places.
        n_fins: number of triangles; each reaches out by a hundredth of the diagonal.
        doubled: share of the faces that come a second time.
    """
    return _with_fins(mesh.vertices, mesh.faces, np.random.default_rng(seed), n_fins, doubled)


def parts(mesh: Mesh, seed: int = 0) -> Triangles:
    """With a ball that floats where the body is thickest, half as wide as fits, and a speck outside.

    The speck is a ball of a thousandth of the area, a tenth of the diagonal away from the bounding box.
    """
    inner = _deepest_ball(mesh)
    return _with_parts(mesh.vertices, mesh.faces, np.random.default_rng(seed), mesh, inner)


def halves(mesh: Mesh, seed: int = 0, overlap: float = 0.02) -> Triangles:
    """Two closed halves that overlap, cut across the longest extent of the body at its centre.

    Args:
        mesh: a closed body.
        seed: not used; the cut is always the same.
        overlap: over the diagonal of the bounding box.

    Raises:
        MeshError: manifold3d does not take the mesh.
    """
    import manifold3d

    centre = mesh.vertices.mean(axis=0)
    points = mesh.vertices - centre
    axis = np.linalg.eigh(points.T @ points)[1][:, -1]
    body = manifold3d.Manifold(manifold3d.Mesh64(np.ascontiguousarray(points), mesh.faces.astype(np.uint64)))
    if body.status() != manifold3d.Error.NoError:
        raise MeshError(f"{mesh.name}: manifold3d does not accept the surface ({body.status()}), so it was not cut.")
    reach = overlap / 2 * diagonal(mesh.vertices)
    pieces = [body.trim_by_plane(sign * axis, -reach).to_mesh64() for sign in (1, -1)]
    vertices = [np.asarray(piece.vert_properties)[:, :3] + centre for piece in pieces]
    faces = [np.asarray(piece.tri_verts, dtype=np.int64) for piece in pieces]
    return np.vstack(vertices), np.vstack([faces[0], faces[1] + len(vertices[0])])


def noise(mesh: Mesh, seed: int = 0, amplitude: float = 0.002) -> Triangles:
    """Every vertex moved along its normal by a random length, of standard deviation `amplitude` over the diagonal."""
    noisy = disturbances.noise(mesh, amplitude, seed)
    return noisy.vertices.copy(), noisy.faces.copy()


def everything(mesh: Mesh, seed: int = 0) -> Triangles:
    """All of the above at once, at their usual strengths.

    Raises:
        MeshError: manifold3d does not take the mesh.
    """
    generator = np.random.default_rng(seed)
    inner = _deepest_ball(mesh)
    noisy = disturbances.noise(mesh, 0.002, seed)
    vertices, faces = halves(noisy)
    vertices, faces = _with_holes(vertices, faces, generator, 0.02, 3)
    vertices, faces = _with_fins(vertices, faces, generator, 30, 0.01)
    vertices, faces = _with_parts(vertices, faces, generator, mesh, inner)
    return _as_soup(vertices, _with_turned(faces, generator, 1 / 3), generator)


DAMAGES: Mapping[str, Damage] = {
    "holes": Damage("2 % of the surface missing, in three patches", holes),
    "soup": Damage("every triangle with its own corners, in single precision, in random order", soup),
    "turned": Damage("a third of the faces inside out", turned),
    "fins": Damage("30 triangles that stand on edges, and 1 % of the faces twice", fins),
    "parts": Damage("a ball that floats inside, and a speck outside", parts),
    "halves": Damage("two closed halves that overlap by 2 % of the diagonal, by manifold3d", halves),
    "noise": Damage("vertices moved along their normals, standard deviation 0.2 % of the diagonal", noise),
    "everything": Damage("all of these at once", everything),
}
"""The damages by name."""


def _with_holes(
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
    generator: np.random.Generator,
    share: float,
    n_patches: int,
) -> Triangles:
    if not 0 < share < 1:
        raise ValueError(f"share: expected a number between 0 and 1, got {share}.")
    area = face_areas(vertices, faces)
    per_patch = share / n_patches * area.sum()
    pairs, _ = undirected_edges(faces, len(vertices))
    length = np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1)
    graph = sparse.csr_array((np.maximum(length, 1e-300), tuple(pairs.T.astype(np.int32))), shape=(len(vertices),) * 2)
    left = np.ones(len(faces), dtype=bool)
    for _ in range(n_patches):
        middle = generator.choice(len(area), p=area * left / (area * left).sum())
        away = dijkstra(graph, directed=False, indices=faces[middle]).mean(axis=0)[faces].mean(axis=1)
        order = np.argsort(np.where(left, away, np.inf), kind="stable")
        left[order[: max(int((np.cumsum(area[order]) <= per_patch).sum()), 1)]] = False
    return compact(vertices, faces[left])


def _as_soup(vertices: NDArray[np.float64], faces: NDArray[np.int64], generator: np.random.Generator) -> Triangles:
    corners = vertices[generator.permutation(faces)].astype(np.float32).astype(np.float64)
    return corners.reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)


def _with_turned(faces: NDArray[np.int64], generator: np.random.Generator, share: float) -> NDArray[np.int64]:
    faces = faces.copy()
    chosen = generator.permutation(len(faces))[: round(share * len(faces))]
    faces[chosen] = faces[chosen, ::-1]
    return faces


def _with_fins(
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
    generator: np.random.Generator,
    n_fins: int,
    doubled: float,
) -> Triangles:
    face = generator.integers(len(faces), size=n_fins)
    corner = generator.integers(3, size=n_fins)
    a, b = faces[face, corner], faces[face, (corner + 1) % 3]
    normals = unit(area_vectors(vertices, faces)[face])
    tips = (vertices[a] + vertices[b]) / 2 + 0.01 * diagonal(vertices) * normals
    stands = np.stack([a, b, len(vertices) + np.arange(n_fins)], axis=1)
    twice = faces[generator.permutation(len(faces))[: max(round(doubled * len(faces)), 1)]]
    return np.vstack([vertices, tips]), np.vstack([faces, stands, twice])


def _with_parts(
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
    generator: np.random.Generator,
    mesh: Mesh,
    inner: tuple[NDArray[np.float64], float],
) -> Triangles:
    ball, triangles = _ball()
    centre, radius = inner
    direction = generator.standard_normal(3)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    place = (low + high) / 2 + 0.6 * diagonal(mesh.vertices) * direction / np.linalg.norm(direction)
    speck = np.sqrt(1e-3 * mesh.area / (4 * np.pi))
    n = len(vertices)
    return (
        np.vstack([vertices, centre + radius * ball, place + speck * ball]),
        np.vstack([faces, n + triangles, n + len(ball) + triangles]),
    )


def _deepest_ball(mesh: Mesh) -> tuple[NDArray[np.float64], float]:
    """The interior sample farthest from the surface's vertices and middles of faces, and half that distance."""
    points = interior_samples(mesh, min_samples=1)
    surface = np.vstack([mesh.vertices, mesh.vertices[mesh.faces].mean(axis=1)])
    away, _ = cKDTree(surface).query(points)
    deepest = int(np.argmax(away))
    return points[deepest], float(away[deepest]) / 2


def _ball() -> Triangles:
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=2)
    return np.asarray(ball.vertices), np.asarray(ball.faces, dtype=np.int64)
