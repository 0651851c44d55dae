"""Compiled simplification of closed surfaces by collapses of edges (Garland and Heckbert 1997)."""

import heapq
import math
from typing import NamedTuple

import numpy as np

from igps._arrays import Booleans, Floats, Integers, Surface
from igps._compiled import ALLOCATES, compiled
from igps.mesh.surface import area_vectors, lengths, longest_side

# Weight of the squared length of an edge in its cost. Without it, flat places get long thin triangles.
_LENGTH_WEIGHT = 1e-2
# Weight of the distance from the middle of the edge, which decides where planes do not
_MIDDLE_WEIGHT = 1e-3
_MIN_COSINE = 0.2  # between the normals of a triangle before and after a collapse


class _Rings(NamedTuple):
    """The triangles around each vertex. Corner 3 f + k is that of triangle f at its side k.

    Args:
        vertex: (3 F,) of each corner.
        first, last: (V,) the first and the last corner at each vertex, -1 if there is none.
        following: (3 F,) the next corner at the same vertex, -1 after the last.
        is_gone: (F,) triangles that were removed; their corners may still be listed.
    """

    vertex: Integers
    first: Integers
    last: Integers
    following: Integers
    is_gone: Booleans


def collapse_edges(vertices: Floats, faces: Integers, n_vertices: int) -> Surface:
    """Collapse the edges of a closed surface, cheapest first, until about `n_vertices` vertices are left.

    It is scaled to unit size meanwhile, because quadrics are sums of squares.
    """
    centre = vertices.mean(axis=0)
    scale = longest_side(vertices)
    points = (vertices - centre) / scale
    rings = _rings(faces, len(points))
    version = np.zeros(len(points), np.int64)
    collapse(points, rings, _quadrics(points, faces), version, n_vertices)
    is_left = version >= 0
    number = np.cumsum(is_left) - 1
    triangles = rings.vertex.reshape(-1, 3)[~rings.is_gone]
    return points[is_left] * scale + centre, number[triangles]


def _rings(faces: Integers, n_vertices: int) -> _Rings:
    """List the corners at each vertex."""
    vertex = faces.astype(np.int64).ravel()
    first = np.full(n_vertices, -1)
    last = np.full(n_vertices, -1)
    following = np.full(len(vertex), -1)
    order = np.argsort(vertex, kind="stable")
    here = order[:-1]
    there = order[1:]
    is_same = vertex[here] == vertex[there]
    following[here[is_same]] = there[is_same]
    # Of several corners at a vertex, the one that is written last remains.
    corners = np.arange(len(vertex))
    last[vertex] = corners
    first[vertex[::-1]] = corners[::-1]
    return _Rings(vertex, first, last, following, np.zeros(len(faces), dtype=bool))


def _quadrics(points: Floats, faces: Integers) -> Floats:
    """Return sums over the triangles around each vertex: area times nn' (6), nd (3) and dd, for the plane nx = d."""
    normals = 2 * area_vectors(points, faces)
    areas = lengths(normals)
    has_area = areas > 0
    faces = faces[has_area]
    areas = areas[has_area]
    normals = normals[has_area] / areas[:, None]
    x, y, z = normals.T
    d = (normals * points[faces[:, 0]]).sum(axis=1)
    squares = [x * x, x * y, x * z, y * y, y * z, z * z, x * d, y * d, z * d, d * d]
    columns = []
    for square in squares:
        at_corners = np.repeat(areas * square, 3)
        columns.append(np.bincount(faces.ravel(), at_corners, len(points)))
    return np.column_stack(columns)


@compiled(**ALLOCATES)
def collapse(
    points: Floats, rings: _Rings, quadrics: Floats, version: Integers, n_vertices: int
) -> None:
    """Collapse edges until about `n_vertices` vertices are left; all arrays are overwritten.

    The version (V,) of a vertex, at first 0, grows with each change of it, and is -1 once it is gone. The cost of a
    collapse is the sum of squared distances of the new vertex from the planes of the triangles that it replaces,
    weighted by their areas. Collapses that change the topology or turn a triangle over are left out.
    """
    mark = np.zeros(len(points), np.int64)
    at_a = np.empty(len(rings.is_gone), np.int64)
    at_b = np.empty(len(rings.is_gone), np.int64)
    place = np.empty(3)
    queue = [(0.0, 0, 0, 0, 0) for _ in range(0)]
    for corner in range(len(rings.vertex)):
        a = rings.vertex[corner]
        b = rings.vertex[_next(corner)]
        if a < b:
            cost = _best_place(quadrics[a], quadrics[b], points[a], points[b], place)
            queue.append((cost, a, b, 0, 0))
    heapq.heapify(queue)
    surplus = len(points) - n_vertices
    while surplus > 0 and len(queue) > 0:
        _, a, b, version_a, version_b = heapq.heappop(queue)
        if version[a] != version_a or version[b] != version_b:
            continue
        n_a = _list_corners(rings, a, at_a)
        n_b = _list_corners(rings, b, at_b)
        # Each vertex keeps three triangles at least; the last of a ball are a tetrahedron
        if n_a + n_b < 7 or _n_common(rings, at_a[:n_a], at_b[:n_b], mark) != 2:
            continue
        _best_place(quadrics[a], quadrics[b], points[a], points[b], place)
        if _turns(rings, points, at_a[:n_a], b, place):
            continue
        if _turns(rings, points, at_b[:n_b], a, place):
            continue
        _merge(rings, a, b, at_b[:n_b])
        points[a] = place
        quadrics[a] += quadrics[b]
        version[a] += 1
        version[b] = -1
        surplus -= 1
        for corner in at_a[: _list_corners(rings, a, at_a)]:
            b = rings.vertex[_next(corner)]
            cost = _best_place(quadrics[a], quadrics[b], points[a], points[b], place)
            heapq.heappush(queue, (cost, a, b, version[a], version[b]))


@compiled()
def _next(corner: int) -> int:
    """Return the next corner of the same triangle."""
    return corner - 2 if corner % 3 == 2 else corner + 1


@compiled()
def _list_corners(rings: _Rings, vertex: int, listed: Integers) -> int:
    """Write the corners at a vertex and return their number; those that are gone are taken out of its list."""
    n = 0
    before = -1
    corner = rings.first[vertex]
    while corner >= 0:
        after = rings.following[corner]
        if not rings.is_gone[corner // 3]:
            listed[n] = before = corner
            n += 1
        elif before < 0:
            rings.first[vertex] = after
        else:
            rings.following[before] = after
        corner = after
    rings.last[vertex] = before
    return n


@compiled()
def _n_common(rings: _Rings, at_a: Integers, at_b: Integers, mark: Integers) -> int:
    """Return how many neighbours two vertices have in common, by their corners; `mark` is zero before and after."""
    n_common = 0
    for corner in at_a:
        mark[rings.vertex[_next(corner)]] = 1
    for corner in at_b:
        n_common += mark[rings.vertex[_next(corner)]]
    for corner in at_a:
        mark[rings.vertex[_next(corner)]] = 0
    return n_common


@compiled()
def _merge(rings: _Rings, a: int, b: int, at_b: Integers) -> None:
    """Give the corners of vertex b to vertex a, and remove the triangles that have both."""
    for corner in at_b:
        beside = _next(corner)
        if rings.vertex[beside] == a or rings.vertex[_next(beside)] == a:
            rings.is_gone[corner // 3] = True
        rings.vertex[corner] = a
    rings.following[rings.last[a]] = rings.first[b]
    rings.last[a] = rings.last[b]


@compiled()
def _best_place(qa: Floats, qb: Floats, a: Floats, b: Floats, place: Floats) -> float:
    """Write where the vertex lies best that replaces the edge from a to b, by their quadrics; return the cost."""
    xx = qa[0] + qb[0]
    xy = qa[1] + qb[1]
    xz = qa[2] + qb[2]
    yy = qa[3] + qb[3]
    yz = qa[4] + qb[4]
    zz = qa[5] + qb[5]
    x = qa[6] + qb[6]
    y = qa[7] + qb[7]
    z = qa[8] + qb[8]
    area = xx + yy + zz
    weight = _MIDDLE_WEIGHT * area + 1e-30
    # A system of three linear equations, by cofactors
    px = xx + weight
    py = yy + weight
    pz = zz + weight
    rx = x + weight * (a[0] + b[0]) / 2
    ry = y + weight * (a[1] + b[1]) / 2
    rz = z + weight * (a[2] + b[2]) / 2
    cx = py * pz - yz * yz
    cy = xz * yz - xy * pz
    cz = xy * yz - xz * py
    dx = xy * xz - px * yz
    inverse = 1 / (px * cx + xy * cy + xz * cz)
    u = (cx * rx + cy * ry + cz * rz) * inverse
    v = (cy * rx + (px * pz - xz * xz) * ry + dx * rz) * inverse
    w = (cz * rx + dx * ry + (px * py - xy * xy) * rz) * inverse
    place[0] = u
    place[1] = v
    place[2] = w
    squares = xx * u * u + yy * v * v + zz * w * w + 2 * (xy * u * v + xz * u * w + yz * v * w)
    heights = squares - 2 * (x * u + y * v + z * w) + qa[9] + qb[9]
    length = (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2
    return heights + _LENGTH_WEIGHT * area * length


@compiled()
def _turns(rings: _Rings, points: Floats, at_a: Integers, b: int, place: Floats) -> bool:
    """Return whether a triangle at the corners of a vertex, but not at b, turns over if the vertex moves to `place`."""
    for corner in at_a:
        a = rings.vertex[corner]
        d = rings.vertex[_next(corner)]
        e = rings.vertex[_next(_next(corner))]
        if d == b or e == b:
            continue
        ox, oy, oz = _normal(points[a], points[d], points[e])
        nx, ny, nz = _normal(place, points[d], points[e])
        along = ox * nx + oy * ny + oz * nz
        old = math.sqrt(ox * ox + oy * oy + oz * oz)
        new = math.sqrt(nx * nx + ny * ny + nz * nz)
        # A triangle that has no area cannot turn
        if old > 0 and along <= _MIN_COSINE * old * new:
            return True
    return False


@compiled()
def _normal(a: Floats, b: Floats, c: Floats) -> tuple[float, float, float]:
    """Return the normal of a triangle, of twice its area's length."""
    ux = b[0] - a[0]
    uy = b[1] - a[1]
    uz = b[2] - a[2]
    vx = c[0] - a[0]
    vy = c[1] - a[1]
    vz = c[2] - a[2]
    return uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
