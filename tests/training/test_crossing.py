"""Crossings of a surface with itself, against every pair of triangles tried one by one."""

import itertools

import numpy as np
import pytest
from training.shapes.crossing import crossing_faces


def passes(p, q, triangle):
    """Whether a segment passes through a triangle: the common point, from three equations."""
    a, b, c = triangle
    matrix = np.column_stack([b - a, c - a, p - q])
    if abs(np.linalg.det(matrix)) < 1e-14:
        return False
    u, v, t = np.linalg.solve(matrix, p - a)
    return bool(u > 0 and v > 0 and u + v < 1 and 0 < t < 1)


def tried_one_by_one(vertices, faces):
    found = set()
    for i, j in itertools.combinations(range(len(faces)), 2):
        if set(faces[i]) & set(faces[j]):
            continue
        a = vertices[faces[i]]
        b = vertices[faces[j]]
        for k in range(3):
            following = (k + 1) % 3
            if passes(a[k], a[following], b) or passes(b[k], b[following], a):
                found.add((i, j))
    return found


@pytest.mark.parametrize("seed", range(2))
def test_all_crossings_are_found(seed):
    g = np.random.default_rng(seed)
    vertices = g.normal(size=(90, 3))
    # Long and short triangles, some with common vertices.
    faces = np.array([g.choice(90, 3, replace=False) for _ in range(60)])
    vertices[:40] *= 0.3
    found = {(int(min(pair)), int(max(pair))) for pair in crossing_faces(vertices, faces)}
    assert found == tried_one_by_one(vertices, faces)
    assert found
