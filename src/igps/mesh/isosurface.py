"""Extract the closed zero level set of a function on a grid by marching cubes, and simplify it."""

import numpy as np

from igps._arrays import Floats, Integers, Singles, Surface
from igps.mesh._collapse_loops import collapse_edges
from igps.mesh._level_set import MIN_ABS_VALUE, fill_bubbles
from igps.mesh.errors import MeshError
from igps.mesh.surface import (
    directed_edges,
    face_areas,
    signed_volume,
    vertex_normals,
)


def level_surface(field: Singles, name: str) -> Surface:
    """Return the closed surface on which the field is zero; where it would touch itself, the field is filled."""
    from skimage.measure import marching_cubes

    for _ in range(20):
        if not (field.min() < 0 < field.max()):
            raise MeshError(
                f"{name}: no grid point lies inside the body, which is too thin. Give it some thickness."
            )
        vertices, faces, _, _ = marching_cubes(field, 0.0, allow_degenerate=True)
        faces = faces.astype(np.int64)
        bad_edges = _non_manifold_edges(faces, len(vertices))
        if not len(bad_edges):
            return vertices.astype(np.float64), faces
        # Fill the four or eight grid points around each vertex at which the surface meets itself.
        for vertex in np.unique(bad_edges):
            low = np.maximum(np.floor(vertices[vertex]).astype(int), 1)
            high = np.ceil(vertices[vertex]).astype(int) + 1
            end = np.minimum(high, np.array(field.shape) - 1)
            box = tuple(map(slice, low, end))
            field[box] = np.minimum(field[box], -MIN_ABS_VALUE)
        field = fill_bubbles(field)
    raise MeshError(
        f"{name}: no closed surface could be extracted from the grid. Raise the resolution."
    )


def simplify_surface(vertices: Floats, faces: Integers, max_vertices: int) -> Surface:
    """Simplify a closed surface to about `max_vertices` vertices of the same volume and topology."""
    if len(vertices) <= max_vertices:
        return vertices, faces
    points, triangles = collapse_edges(vertices, faces, max_vertices)
    return restore_volume(points, triangles, signed_volume(vertices, faces)), triangles


def restore_volume(vertices: Floats, faces: Integers, volume: float) -> Floats:
    """Return the vertices (V, 3) moved along their normals by one common distance, so that they enclose `volume`."""
    max_step = 0.25  # bounds the sum of all steps
    for _ in range(3):
        step = (volume - signed_volume(vertices, faces)) / face_areas(vertices, faces).sum()
        step = float(np.clip(step, -max_step, max_step))
        vertices = vertices + step * vertex_normals(vertices, faces)
        max_step -= abs(step)
    return vertices


def _non_manifold_edges(faces: Integers, n_vertices: int) -> Integers:
    """Return the edges (E, 2) that are not traversed exactly once in each direction."""
    start, end = directed_edges(faces)
    forward = np.sort(start * n_vertices + end)
    backward = np.sort(end * n_vertices + start)
    are_distinct = (forward[1:] > forward[:-1]).all()
    if are_distinct and np.array_equal(forward, backward):
        return np.zeros((0, 2), dtype=np.int64)
    forward, n_forward = np.unique(forward, return_counts=True)
    keys = np.concatenate([forward[n_forward > 1], np.setxor1d(forward, backward)])
    return np.stack([keys // n_vertices, keys % n_vertices], axis=1)
