"""Closed surfaces made one by threads so thin that hardly any area is added."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from igps._arrays import Floats, Integers, Surface
from igps.mesh.surface import face_areas, stacked

# A thread takes no more of a triangle than this share of its sides.
_MOST = 0.5


def joined_by_threads(parts: Sequence[Surface], share: float) -> Surface:
    """The parts, closed and outward and none within another, as one closed surface; nearest ones are joined.

    A thread is a tube of triangular section between two triangles, the largest at the nearest vertices; together they
    may add this share of the whole area.
    """
    starts = np.cumsum([0, *(len(points) for points, _ in parts)])
    vertices, faces = stacked(parts)
    links = [(starts[i] + a, starts[j] + b) for i, j, a, b in _nearest([points for points, _ in parts])]
    length = sum(float(np.linalg.norm(vertices[a] - vertices[b])) for a, b in links)
    girth = share * float(face_areas(vertices, faces).sum()) / max(length, 1e-300)
    for a, b in links:
        vertices, faces = _with_thread(vertices, faces, int(a), int(b), girth)
    return vertices, faces


def _nearest(parts: Sequence[Floats]) -> list[tuple[int, int, int, int]]:
    """Two parts and a vertex of each, for every link of the shortest tree that joins them all."""
    trees, links = [cKDTree(points) for points in parts], []
    best = dict.fromkeys(range(1, len(parts)), (np.inf, 0, 0, 0))
    new = 0
    while best:
        for j in best:
            away, at = trees[new].query(parts[j])
            if away.min() < best[j][0]:
                best[j] = (float(away.min()), new, int(at[away.argmin()]), int(away.argmin()))
        new = min(best, key=lambda j: best[j][0])
        _, old, a, b = best.pop(new)
        links.append((old, new, a, b))
    return links


def _with_thread(vertices: Floats, faces: Integers, a: int, b: int, girth: float) -> Surface:
    """With a tube of this girth between the largest triangles at two vertices."""
    areas = face_areas(vertices, faces)
    ends = [int(at[areas[at].argmax()]) for at in (np.flatnonzero((faces == v).any(axis=1)) for v in (a, b))]
    rims, new = [], []
    for number, face in enumerate(ends):
        corners = vertices[faces[face]]
        centre, around = corners.mean(axis=0), np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).sum()
        vertices = np.concatenate([vertices, centre + min(girth / around, _MOST) * (corners - centre)])
        rims.append(len(vertices) - 3 + np.arange(3))
        for i, k in ((0, 1), (1, 2), (2, 0)):
            c, d, e, f = faces[face][i], faces[face][k], rims[number][k], rims[number][i]
            new += [(c, d, e), (c, e, f)]
    # The rims run in opposite directions, as they face each other.
    turned = [np.roll(rims[1][::-1], k) for k in range(3)]
    other = min(turned, key=lambda rim: float(np.linalg.norm(vertices[rims[0]] - vertices[rim], axis=1).sum()))
    for i, k in ((0, 1), (1, 2), (2, 0)):
        new += [(rims[0][i], rims[0][k], other[k]), (rims[0][i], other[k], other[i])]
    return vertices, np.concatenate([np.delete(faces, ends, axis=0), np.array(new, dtype=np.int64)])
