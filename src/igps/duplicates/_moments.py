"""A lower bound of the distance of two surfaces in any alignment, from moments of the enclosed volumes.

If a surface moves outwards by u, a moment of its body changes by the mean of h · u to first order, where h is a known
function on the surface. So a difference δ of moments requires a root mean square of u of at least √(δᵀ G⁻¹ δ), where G
is the mean of h hᵀ (Cauchy and Schwarz). Moments of a mesh are exact, so copies differ only by what triangles cut off.
"""

import numpy as np
import torch
from torch import Tensor

from igps._arrays import Floats, Integers, Surface
from igps.duplicates._alignment import MAX_LOG_SCALE
from igps.mesh.surface import area_vectors, directed_edges, dots, face_areas, lengths

# Quadrature with six nodes, exact for polynomials of degree four on a triangle (Dunavant 1985)
_INNER = 0.445948490915965
_OUTER = 0.091576213509771
# Barycentric
_NODES = np.concatenate([np.full((3, 3), x) + np.eye(3) * (1 - 3 * x) for x in (_INNER, _OUTER)])
_WEIGHTS = np.repeat([0.223381589678011, 0.109951743655322], 3)
# Over first-order terms: a move of √area / 100 where the radius of curvature is √area / 3
_SECOND_ORDER = 0.03


def moments(vertices: Floats, faces: Integers, max_move: float) -> Floats:
    """Return six moments of a body, in units of √area, and the map from their differences to a distance: (7, 6).

    The first row has the logarithms of the volume V, of the second central moments along the principal axes, and of
    ∫ |x|⁴ dV, which all grow with scale or thickness, and |∫ x |x|² dV| / ((∫ |x|² dV)^(3/2) / √V). The other rows are
    the map. It holds for moves up to `max_move`, and ignores a scaling by up to a tenth. If the moments are not those
    of a solid, the map and thus the bound are zero. Holes of an open surface are closed by cones over its centroid.
    """
    vertices, faces = _closed(vertices, faces)
    vectors = area_vectors(vertices, faces)
    x = np.einsum("qk,fkd->fqd", _NODES, vertices[faces])
    # Flux of x through each node's part of the surface. The flux of x f gives ∫ f dV by the divergence theorem.
    flux = np.einsum("fqd,fd,q->fq", x, vectors, _WEIGHTS)
    volume = flux.sum() / 3
    centroid = np.einsum("fq,fqd->d", flux, x) / 4 / volume
    x = (x - centroid).reshape(-1, 3)
    flux = np.einsum("fqd,fd,q->fq", x.reshape(-1, 6, 3), vectors, _WEIGHTS).ravel()
    second = np.einsum("p,pi,pj->ij", flux, x, x) / 5
    along, axes = np.linalg.eigh(second)
    square = dots(x, x)
    total = along.sum()
    third = (flux * square) @ x / 6
    fourth = flux @ square**2 / 7
    even = np.array([volume, *along, fourth])
    if not even.min() > 0:
        return np.zeros((7, 6))
    # The functions h of the moments; the centroid moves with the surface, too
    h_fourth = square**2 - 4 * x @ third / volume
    h_even = np.column_stack([np.ones(len(x)), (x @ axes) ** 2, h_fourth]) / even
    h_third = x * square[:, None] - x @ (total * np.eye(3) + 2 * second) / volume
    length = max(float(np.linalg.norm(third)), 1e-9)
    scale = volume**0.5 / total**1.5
    h_scale = h_even[:, 0] / 2 - 1.5 * square / total
    h_length = scale * (h_third @ third / length + length * h_scale)
    h = np.column_stack([h_even, h_length])
    weights = np.outer(lengths(vectors), _WEIGHTS).ravel()
    gram = (weights[:, None] * h).T @ h
    gram[np.diag_indices(6)] *= 1 + _SECOND_ORDER**2
    scaling = np.array([3, 5, 5, 5, 7, 0]) * MAX_LOG_SCALE / max_move
    root = np.linalg.cholesky(gram + np.outer(scaling, scaling))
    of_body = np.array([*np.log(even), scale * length])
    return np.vstack([of_body, np.linalg.inv(root)])


def _closed(vertices: Floats, faces: Integers) -> Surface:
    """Close the holes of an open surface by cones over its centroid."""
    start, end = directed_edges(faces)
    n = len(vertices)
    is_open = ~np.isin(start * n + end, end * n + start)
    if not is_open.any():
        return vertices, faces
    areas = face_areas(vertices, faces)
    centroid = np.average(vertices[faces].mean(axis=1), axis=0, weights=areas)
    tips = np.full(is_open.sum(), n)
    cones = np.column_stack([end[is_open], start[is_open], tips])
    return np.vstack([vertices, centroid]), np.vstack([faces, cones])


def distance_bounds(one: Tensor, other: Tensor) -> Tensor:
    """Return lower bounds (M, N) of the distances of surfaces, over √area, from `moments` (M, 7, 6) and (N, 7, 6)."""

    def bounds(own: Tensor, others: Tensor) -> Tensor:
        """Return the bounds by the maps of the first bodies."""
        own_moments = own[:, 0]
        other_moments = others[:, 0]
        squares = torch.zeros(len(own), len(others), dtype=own.dtype)
        for row in own[:, 1:].unbind(dim=1):
            moved = (row * own_moments).sum(1, keepdim=True)
            squares += (row @ other_moments.T - moved).square()
        return squares.sqrt()

    # The derivative of |∫ x |x|² dV| depends on the direction of the vector, which is uncertain for a short one
    return torch.minimum(bounds(one, other), bounds(other, one).T)
