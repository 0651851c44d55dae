"""Extract the closed zero level set of a function on a grid by marching cubes, and simplify it."""

import numpy as np

from igps._arrays import Booleans, Floats, Integers, Singles, Surface
from igps.mesh._collapse_loops import collapse_edges
from igps.mesh._level_set import MIN_ABS_VALUE, fill_bubbles
from igps.mesh.errors import MeshError
from igps.mesh.surface import (
    directed_edges,
    dots,
    edge_keys,
    face_areas,
    lengths,
    signed_volume,
    vertex_normals,
)

# Of the normals of two triangles, before and after a flip of their edge, with the mean normal
_MIN_COSINE = 0.95
_MIN_GAIN = 1e-3  # radians that two opposite angles exceed 180° by, so that their edge is flipped
_MAX_FLIPS = 30  # rounds of flips


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
        _fill_around(field, vertices[np.unique(bad_edges)])
        field = fill_bubbles(field)
    raise MeshError(
        f"{name}: no closed surface could be extracted from the grid. Raise the resolution."
    )


def _fill_around(field: Singles, places: Singles) -> None:
    """Fill the four or eight grid points around each place (P, 3) at which the surface meets itself."""
    last = np.array(field.shape) - 1
    first_points = np.floor(places).astype(int)
    last_points = np.ceil(places).astype(int)
    lows = np.maximum(first_points, 1)
    highs = np.minimum(last_points + 1, last)
    for low, high in zip(lows, highs, strict=True):
        box = tuple(map(slice, low, high))
        field[box] = np.minimum(field[box], -MIN_ABS_VALUE)


def simplify_surface(vertices: Floats, faces: Integers, max_vertices: int) -> Surface:
    """Simplify a closed surface to about `max_vertices` vertices of the same volume and topology."""
    if len(vertices) <= max_vertices:
        return vertices, faces
    volume = signed_volume(vertices, faces)
    vertices, faces = collapse_edges(vertices, faces, max_vertices)
    faces = _flip_edges(vertices, faces)
    return restore_volume(vertices, faces, volume), faces


def restore_volume(vertices: Floats, faces: Integers, volume: float) -> Floats:
    """Return the vertices (V, 3) moved along their normals by one common distance, so that they enclose `volume`."""
    max_step = 0.25  # bounds the sum of all steps
    for _ in range(3):
        missing = volume - signed_volume(vertices, faces)
        step = missing / face_areas(vertices, faces).sum()
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
    distinct, count = np.unique(forward, return_counts=True)
    repeated = distinct[count > 1]
    one_way = np.setxor1d(forward, backward)
    keys = np.concatenate([repeated, one_way])
    return np.column_stack(np.divmod(keys, n_vertices))


def _flip_edges(vertices: Floats, faces: Integers) -> Integers:
    """Flip the edges in flat places whose two opposite angles add up to more than 180°.

    Quadrics leave long thin triangles in flat places. There the flips lead to a Delaunay triangulation, on which the
    cotangent weights are positive. Edges at which the surface bends are kept.
    """
    n_vertices = len(vertices)
    for _ in range(_MAX_FLIPS):
        left, right, corners = _quadrilaterals(faces, n_vertices)
        a, b, c, d = vertices[corners]
        angles = _angle(c, a, b) + _angle(d, b, a)
        gain = angles - np.pi
        flips = np.flatnonzero(gain > _MIN_GAIN)
        _, _, start, end = corners[:, flips]
        can_flip = _are_flat(*vertices[corners[:, flips]])
        can_flip &= start != end
        can_flip &= ~_are_edges(start, end, faces, n_vertices)
        flips = flips[can_flip]
        new_edges = edge_keys(start, end, n_vertices)[can_flip]
        chosen = _independent(left[flips], right[flips], gain[flips], new_edges)
        flips = flips[chosen]
        if not len(flips):
            break
        a, b, c, d = corners[:, flips]
        faces = faces.copy()
        faces[left[flips]] = np.column_stack([c, d, b])
        faces[right[flips]] = np.column_stack([d, c, a])
    return faces


def _quadrilaterals(faces: Integers, n_vertices: int) -> tuple[Integers, Integers, Integers]:
    """Return the two faces at each edge, and four vertices (4, E).

    These are the ends a and b of the edge, the third corner c of the one face, and the third corner d of the other.
    """
    start, end = directed_edges(faces)
    opposite = np.roll(faces, 1, axis=1).ravel()
    forward = start * n_vertices + end
    backward = end * n_vertices + start
    side = np.flatnonzero(start < end)
    order = np.argsort(forward)
    rank = np.searchsorted(forward[order], backward[side])
    other = order[rank]
    corners = np.stack([start[side], end[side], opposite[side], opposite[other]])
    return side // 3, other // 3, corners


def _are_flat(a: Floats, b: Floats, c: Floats, d: Floats) -> Booleans:
    """Return where the triangles abc and bad, and those after a flip, have nearly the same normal."""
    abc = np.cross(b - a, c - a)
    bad = np.cross(a - b, d - b)
    cdb = np.cross(d - c, b - c)
    dca = np.cross(c - d, a - d)
    total = abc + bad
    length = lengths(total)
    mean = total / np.maximum(length, 1e-30)[:, None]
    is_flat = np.ones(len(a), dtype=bool)
    for normal in (abc, bad, cdb, dca):
        size = lengths(normal)
        is_parallel = dots(normal, mean) > _MIN_COSINE * size
        # The normal of a triangle without area does not matter.
        has_no_area = size < 1e-3 * length
        is_flat &= is_parallel | has_no_area
    return is_flat


def _are_edges(a: Integers, b: Integers, faces: Integers, n_vertices: int) -> Booleans:
    """Return which pairs of vertices are edges of the surface."""
    pairs = edge_keys(a, b, n_vertices)
    edges = edge_keys(*directed_edges(faces), n_vertices)
    return np.isin(pairs, edges)


def _independent(left: Integers, right: Integers, gain: Floats, new_edges: Integers) -> Integers:
    """Choose flips: each face takes part only in its best one, and no two create the same edge."""
    pairs = np.column_stack([left, right])
    n_faces = pairs.max(initial=-1) + 1
    best = np.full(n_faces, -np.inf)
    np.maximum.at(best, left, gain)
    np.maximum.at(best, right, gain)
    is_best = (gain >= best[left]) & (gain >= best[right])
    chosen = np.flatnonzero(is_best)
    _, first = np.unique(new_edges[chosen], return_index=True)
    chosen = chosen[first]
    pairs = pairs[chosen]
    n_flips = np.bincount(pairs.ravel(), minlength=n_faces)
    is_alone = (n_flips[pairs] == 1).all(axis=1)
    return chosen[is_alone]


def _angle(apex: Floats, a: Floats, b: Floats) -> Floats:
    u = a - apex
    v = b - apex
    sine = lengths(np.cross(u, v))
    cosine = dots(u, v)
    return np.arctan2(sine, cosine)
