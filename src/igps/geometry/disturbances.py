"""What may happen to a mesh on its way to a descriptor: noise, resampling, welds, holes, lost limbs, scale and motion.

Each function returns a new, checked `Mesh` and says in its notes what was done. `DISTURBANCES` lists those that
descriptors are tried against, with the strength that is usual here.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from igps.geometry.coordinates import winding_number
from igps.geometry.mesh import Mesh, MeshError, area_vectors, simplify

TUBE_FACES = 6
"""Faces of the tube of a weld, the last ones of the welded mesh."""

# Widths of a gap that a weld may bridge, as shares of the bounding box's diagonal, the narrowest first.
_GAPS = (1 / 64, 1 / 32, 1 / 16)
# Places are far apart along the surface from this share of the diagonal on.
_FAR = 1 / 4
# Least cosine between the normal of a vertex and the direction to the vertex that it faces.
_FACING = 0.5
_N_LANDMARKS = 32


@dataclass(frozen=True)
class Disturbance:
    """A change of the mesh that should change a description little.

    Args:
        description: what is done, and how much of it.
        apply: does it.
    """

    description: str
    apply: Callable[[Mesh], Mesh]


def noise(mesh: Mesh, amplitude: float = 0.005, seed: int = 0) -> Mesh:
    """Move every vertex along its normal by a normal random length.

    Args:
        mesh: the body.
        amplitude: standard deviation of that length over the diagonal of the bounding box.
        seed: of the lengths.

    Raises:
        ValueError: `amplitude` is not positive.
    """
    if not amplitude > 0:
        raise ValueError(f"amplitude: expected a positive share of the diagonal, got {amplitude}.")
    lengths = np.random.default_rng(seed).normal(0, amplitude * _diagonal(mesh), len(mesh.vertices))
    note = f"every vertex moved along its normal, standard deviation {amplitude:g} of the bounding box diagonal"
    return _changed(mesh, mesh.vertices + lengths[:, None] * vertex_normals(mesh), mesh.faces, note)


def simplified(mesh: Mesh, share: float) -> Mesh:
    """`simplify` to a share of the vertices.

    Raises:
        ImportError: libigl is not installed.
        MeshError: the share cannot be reached.
    """
    _check_share(share)
    return simplify(mesh, max(round(share * len(mesh.vertices)), 4))


def remesh(mesh: Mesh) -> Mesh:
    """The surface with other triangles, as many as before and of more even size.

    Every triangle is cut into four at the middles of its sides; then the shortest edge is replaced by its middle until
    the number of faces is the old one; then the vertices are put back onto the old surface, each to the nearest point.
    No step changes the topology.

    Raises:
        ImportError: libigl is not installed.
        MeshError: the old number of faces is out of reach.
    """
    try:
        import igl
    except ImportError as error:
        raise ImportError('remesh needs libigl: pip install "interior-gps[igl]".') from error
    vertices, faces = igl.upsample(np.asfortranarray(mesh.vertices), np.asfortranarray(mesh.faces.astype(np.int32)))
    vertices, faces, *_ = igl.decimate(
        np.asfortranarray(vertices), np.asfortranarray(faces.astype(np.int32)), len(mesh.faces)
    )
    if len(faces) > len(mesh.faces):
        raise MeshError(
            f"{mesh.name}: could not be remeshed with {len(mesh.faces)} faces without changing its topology "
            f"({len(faces)} were reached)."
        )
    _, _, vertices = igl.point_mesh_squared_distance(
        np.asfortranarray(vertices), np.asfortranarray(mesh.vertices), np.asfortranarray(mesh.faces)
    )
    return _changed(mesh, vertices, faces, "remeshed: every face cut into four, then the shortest edges collapsed")


def weld(mesh: Mesh, a: int, b: int) -> Mesh:
    """Join two places of a surface by a triangular tube, which adds one to its genus.

    One triangle at each of the two vertices is taken out, and the sides of a prism, six triangles, join the two rims.
    Of the triangles there, and the ways to turn the prism, those are taken that make the edges of the tube shortest.

    Args:
        mesh: the body.
        a, b: vertex indices.

    Returns:
        The mesh with the tube as its last `TUBE_FACES` faces; the vertices are the same.

    Raises:
        ValueError: no such vertices, or none of their triangles are apart by two edges.
    """
    for name, vertex in (("a", a), ("b", b)):
        if not 0 <= vertex < len(mesh.vertices):
            raise ValueError(f"{name}: expected a vertex index from 0 to {len(mesh.vertices) - 1}, got {vertex}.")
    neighbours = _edge_graph(mesh)
    best: tuple[float, int, int, NDArray[np.int64]] | None = None
    faces_b = np.nonzero((mesh.faces == b).any(axis=1))[0]
    for i in np.nonzero((mesh.faces == a).any(axis=1))[0]:
        rim = mesh.faces[i]
        beside = np.union1d(rim, neighbours[rim].indices)
        for j in faces_b:
            if np.isin(mesh.faces[j], beside).any():
                continue  # the tube would meet an edge that two faces share already
            for turn in range(3):
                other = mesh.faces[j][[turn, turn - 1, turn - 2]]  # backwards: the two rims face each other
                length = float(np.linalg.norm(mesh.vertices[rim] - mesh.vertices[other], axis=1).sum())
                if best is None or length < best[0]:
                    best = length, int(i), int(j), other
    if best is None:
        raise ValueError(
            f"a, b: expected vertices of {mesh.name} that are more than three edges apart, got {a} and {b}. "
            "Take others, or subdivide the mesh."
        )
    length, first, second, q = best
    p = mesh.faces[first]
    tube = [[p[0], p[1], q[1]], [p[0], q[1], q[0]], [p[1], p[2], q[2]], [p[1], q[2], q[1]]]
    tube += [[p[2], p[0], q[0]], [p[2], q[0], q[2]]]
    gap = float(np.linalg.norm(mesh.vertices[a] - mesh.vertices[b]))
    note = (
        f"welded at vertices {a} and {b}, {gap:.3g} apart: triangles {first} and {second} replaced by the {TUBE_FACES} "
        f"faces of a triangular tube, mean length {length / 3:.3g}"
    )
    return _changed(mesh, mesh.vertices, np.vstack([np.delete(mesh.faces, [first, second], axis=0), tube]), note)


def facing_vertices(mesh: Mesh) -> tuple[int, int]:
    """Two vertices that face each other across a narrow gap outside the body, but are far apart along its surface.

    Of the pairs at most 1/64 of the bounding box's diagonal apart, the one with the largest ratio of the shortest path
    along the edges to the gap, if that path is at least a quarter of the diagonal; otherwise the same with 1/32 and
    1/16; otherwise, of the pairs at most 1/16 apart, the one with the longest path.

    Raises:
        MeshError: nothing faces anything across a gap, as on every convex body.
    """
    search = _GapSearch(mesh)
    for gap in _GAPS:
        for a, b in search.pairs(gap * _diagonal(mesh), least_path=_FAR * _diagonal(mesh)):
            if search.is_clear(a, b):
                return a, b
    for a, b in search.pairs(_GAPS[-1] * _diagonal(mesh)):
        if search.is_clear(a, b):
            return a, b
    raise MeshError(
        f"{mesh.name}: no two places face each other across a gap of at most {_GAPS[-1]:.2g} of the diagonal. "
        "Name the two vertices to be welded."
    )


def weld_gap(mesh: Mesh) -> Mesh:
    """`weld` at the `facing_vertices`."""
    return weld(mesh, *facing_vertices(mesh))


def hole(mesh: Mesh, share: float = 0.01, seed: int = 0) -> Mesh:
    """Take a patch out of the surface: the faces nearest along the surface to a random one.

    Args:
        mesh: the body.
        share: of the area, at most; halved until the patch does not cut the surface in two.
        seed: of the middle of the patch.

    Returns:
        An open mesh.

    Raises:
        ValueError: `share` out of range.
    """
    _check_share(share)
    area = np.linalg.norm(area_vectors(mesh.vertices, mesh.faces), axis=1)
    middle = np.random.default_rng(seed).choice(len(area), p=area / area.sum())
    from_corners = dijkstra(_edge_graph(mesh), indices=mesh.faces[middle])
    order = np.argsort(from_corners.mean(axis=0)[mesh.faces].mean(axis=1), kind="stable")
    n_removed = max(int((np.cumsum(area[order]) <= share * area.sum()).sum()), 1)
    while n_removed > 1 and not _in_one_piece(order[n_removed:], mesh.faces):
        n_removed //= 2
    kept = np.delete(mesh.faces, order[:n_removed], axis=0)
    used, faces = np.unique(kept, return_inverse=True)
    faces = faces.reshape(-1, 3)
    lost = 1 - np.linalg.norm(area_vectors(mesh.vertices, kept), axis=1).sum() / area.sum()
    note = f"a hole of {len(mesh.faces) - len(kept)} faces, {lost:.2%} of the area"
    return replace(mesh, vertices=mesh.vertices[used], faces=faces, allow_open=True, notes=(*mesh.notes, note))


def clip(mesh: Mesh, share: float = 0.1) -> Mesh:
    """Cut off the end that is farthest from the middle, and close the cut with a flat cap.

    The plane is perpendicular to the direction from the centroid of the surface to the vertex farthest from it. Of
    several pieces that remain, the one of the largest volume is kept. Cut and cap by manifold3d.

    Args:
        mesh: a closed body.
        share: of the body's extent in that direction.

    Raises:
        ValueError: `share` out of range.
        ImportError: manifold3d is not installed.
        MeshError: manifold3d does not take the mesh, or leaves nothing.
    """
    _check_share(share)
    try:
        import manifold3d
    except ImportError as error:
        raise ImportError('clip needs manifold3d: pip install "interior-gps[manifold]".') from error
    area = np.linalg.norm(area_vectors(mesh.vertices, mesh.faces), axis=1)
    centre = np.average(mesh.vertices[mesh.faces].mean(axis=1), axis=0, weights=area)
    points = mesh.vertices - centre
    distance = np.linalg.norm(points, axis=1)
    direction = points[np.argmax(distance)] / distance.max()
    along = points @ direction
    cut = along.max() - share * np.ptp(along)
    body = manifold3d.Manifold(manifold3d.Mesh64(np.ascontiguousarray(points), mesh.faces.astype(np.uint64)))
    if body.status() != manifold3d.Error.NoError:
        raise MeshError(f"{mesh.name}: manifold3d does not accept the surface ({body.status()}), so it was not cut.")
    pieces = body.trim_by_plane(-direction, -float(cut)).decompose()
    if not pieces:
        raise MeshError(f"{mesh.name}: nothing remains when the farthest {share:.0%} are cut off.")
    piece = max(pieces, key=lambda one: one.volume()).to_mesh64()
    faces = np.asarray(piece.tri_verts, dtype=np.int64)
    result = _changed(mesh, np.asarray(piece.vert_properties)[:, :3] + centre, faces, "clipped")
    lost = 1 - result.volume / mesh.volume
    note = f"the farthest {share:.0%} of its extent cut off and capped, {lost:.2%} of the volume"
    return replace(result, notes=(*mesh.notes, note))


def scale(mesh: Mesh, factor: float) -> Mesh:
    """All lengths times a positive factor."""
    if not 0 < factor < np.inf:
        raise ValueError(f"factor: expected a positive number, got {factor}.")
    return _changed(mesh, mesh.vertices * factor, mesh.faces, f"scaled by {factor:g}")


def move(mesh: Mesh, seed: int = 0) -> Mesh:
    """Turn the mesh about its centre by a uniformly random rotation, and move it by twice its diagonal.

    Rotations are uniform by normalised normal quaternions (Shoemake 1992).
    """
    generator = np.random.default_rng(seed)
    rotation = Rotation.from_quat(generator.standard_normal(4))
    way = generator.standard_normal(3)
    centre = mesh.vertices.mean(axis=0)
    offset = 2 * _diagonal(mesh) * way / np.linalg.norm(way)
    return _changed(mesh, rotation.apply(mesh.vertices - centre) + centre + offset, mesh.faces, "turned and moved")


def vertex_normals(mesh: Mesh) -> NDArray[np.float64]:
    """(V, 3) outward unit normals of the vertices, means of those of their faces weighted by area."""
    normals = np.zeros_like(mesh.vertices)
    vectors = area_vectors(mesh.vertices, mesh.faces)
    for i in range(3):
        np.add.at(normals, mesh.faces[:, i], vectors)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)


DISTURBANCES: Mapping[str, Disturbance] = {
    "noise": Disturbance("vertices moved along their normals, standard deviation 0.5 % of the diagonal", noise),
    "half": Disturbance("simplified to 50 % of the vertices", partial(simplified, share=0.5)),
    "tenth": Disturbance("simplified to 10 % of the vertices", partial(simplified, share=0.1)),
    "remesh": Disturbance("each face cut into four, then the shortest edges collapsed to the old number", remesh),
    "weld": Disturbance("two places that face each other joined by a triangular tube", weld_gap),
    "hole": Disturbance("a patch of 1 % of the area removed", hole),
    "limb": Disturbance("the farthest 10 % of the extent cut off and capped, by manifold3d", clip),
    "scale": Disturbance("scaled by 7", partial(scale, factor=7.0)),
    "motion": Disturbance("a random rotation, and a move by twice the diagonal", move),
}
"""The disturbances by name."""


class _GapSearch:
    """Pairs of vertices that face each other, best first."""

    def __init__(self, mesh: Mesh) -> None:
        self._mesh = mesh
        self._graph = _edge_graph(mesh)
        self._tree = cKDTree(mesh.vertices)
        self._normals = vertex_normals(mesh)
        self._landmarks = self._spread(_N_LANDMARKS)

    def pairs(self, largest_gap: float, least_path: float | None = None) -> Iterator[tuple[int, int]]:
        """The pairs at most `largest_gap` apart, in descending order of the shortest path along edges between them.

        With `least_path` only those whose path is at least so long, in descending order of path over gap.
        """
        pair, gap = self._facing(largest_gap)
        # A path over a landmark bounds the shortest one from above, so that few have to be searched for.
        upper = (self._landmarks[:, pair[:, 0]] + self._landmarks[:, pair[:, 1]]).min(axis=0)
        far = upper >= (least_path or 0)
        pair, gap, upper = pair[far], gap[far], upper[far]
        unit = np.ones(len(pair)) if least_path is None else gap
        queue = [(-bound, i, False) for i, bound in enumerate((upper / unit).tolist())]
        heapq.heapify(queue)
        of_source: dict[int, list[int]] = {}
        for i, a in enumerate(pair[:, 0].tolist()):
            of_source.setdefault(a, []).append(i)
        while queue:
            _, i, exact = heapq.heappop(queue)
            a, b = pair[i].tolist()
            if exact:
                yield a, b
            elif a in of_source:  # otherwise the pairs of this vertex are in the queue with their exact paths
                path = dijkstra(self._graph, indices=a)
                for k in of_source.pop(a):
                    length = float(path[pair[k, 1]])
                    if length >= (least_path or 0):
                        heapq.heappush(queue, (-length / float(unit[k]), k, True))

    def is_clear(self, a: int, b: int) -> bool:
        """Whether the straight line between two vertices runs outside the body."""
        along = np.array([[0.25], [0.5], [0.75]])
        points = (1 - along) * self._mesh.vertices[a] + along * self._mesh.vertices[b]
        return bool((winding_number(self._mesh.vertices, self._mesh.faces, points) < 0.5).all())

    def _facing(self, largest_gap: float) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        pair = self._tree.query_pairs(largest_gap, output_type="ndarray").astype(np.int64).reshape(-1, 2)
        way = self._mesh.vertices[pair[:, 1]] - self._mesh.vertices[pair[:, 0]]
        gap = np.linalg.norm(way, axis=1)
        cosines = [np.einsum("ij,ij->i", sign * self._normals[pair[:, k]], way) for k, sign in ((0, 1), (1, -1))]
        # A gap of no width is a flaw of the mesh, which no tube can bridge.
        kept = (np.minimum(*cosines) > _FACING * gap) & (gap > 1e-6 * largest_gap)
        return pair[kept], gap[kept]

    def _spread(self, n_landmarks: int) -> NDArray[np.float64]:
        distances = [dijkstra(self._graph, indices=0)]
        nearest = distances[0]
        for _ in range(min(n_landmarks, len(nearest)) - 1):
            distances.append(dijkstra(self._graph, indices=int(np.argmax(nearest))))
            nearest = np.minimum(nearest, distances[-1])
        return np.stack(distances)


def _check_share(share: float) -> None:
    if not 0 < share < 1:
        raise ValueError(f"share: expected a number between 0 and 1, got {share}.")


def _changed(mesh: Mesh, vertices: NDArray[np.float64], faces: NDArray[np.int64], note: str) -> Mesh:
    return replace(mesh, vertices=vertices, faces=faces, notes=(*mesh.notes, note))


def _diagonal(mesh: Mesh) -> float:
    return float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))


def _edge_graph(mesh: Mesh) -> sparse.csr_array:
    """(V, V) symmetric, the lengths of the edges."""
    start, end = mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()
    pairs = np.unique(np.sort(np.stack([start, end], axis=1), axis=1), axis=0)
    length = np.linalg.norm(mesh.vertices[pairs[:, 0]] - mesh.vertices[pairs[:, 1]], axis=1)
    both = (np.tile(length, 2), (pairs.T.ravel(), pairs[:, ::-1].T.ravel()))
    return sparse.csr_array(both, shape=(len(mesh.vertices),) * 2)


def _in_one_piece(kept: NDArray[np.int64], faces: NDArray[np.int64]) -> bool:
    """Whether the faces of these numbers are connected by their vertices."""
    used, corners = np.unique(faces[kept], return_inverse=True)
    corners = corners.reshape(-1, 3)
    start, end = corners.ravel(), np.roll(corners, -1, axis=1).ravel()
    graph = sparse.coo_array((np.ones(len(start), dtype=np.int8), (start, end)), shape=(len(used),) * 2)
    return bool(connected_components(graph, directed=False)[0] == 1)
