"""How far apart two surfaces are at least, as moments of the volumes inside them tell, however one is laid.

Where a surface moves outwards by u, a moment of its body changes by the mean of h · u, to first order, where h is known
on the surface. So moments that differ by δ take a root mean square of u of at least √(δᵀ G⁻¹ δ), G the mean of h hᵀ
(Cauchy and Schwarz). Triangles give moments exactly, so that copies differ only by what triangles cut off.
"""

import numpy as np
import torch
from torch import Tensor

from igps._arrays import Floats, Integers
from igps.gallery._alignment import MOST_SCALED
from igps.mesh.surface import area_vectors, directed_edges, face_areas

# A rule of six points that integrates polynomials of fourth degree over a triangle (Dunavant 1985)
_INNER, _OUTER = 0.445948490915965, 0.091576213509771
_CORNERS = np.concatenate([np.full((3, 3), one) + np.eye(3) * (1 - 3 * one) for one in (_INNER, _OUTER)])
_SHARES = np.repeat([0.223381589678011, 0.109951743655322], 3)
# What the first order leaves out, as a part of it: a move of a hundredth of √area on what is curved by a third
_SECOND_ORDER = 0.03


def moments(vertices: Floats, faces: Integers, most: float) -> Floats:
    """(7, 6) six numbers of a body in units of √area, and a map of their differences to how far it moved at least.

    They are the logarithms of the volume V, of the second moments along principal axes and of ∫ |x|⁴ dV, about the
    middle, which grow evenly with a scale or a thickness, and the length of ∫ x |x|² dV as a part of
    (∫ |x|² dV)^(3/2) / √V. Holes of an open surface are closed by cones over the middle of it. Moves are up to `most`;
    beside them, scaling by a tenth counts as much as such a move. The map is zero where the moments are none of a body.
    """
    start, end = directed_edges(faces)
    is_free = ~np.isin(start * len(vertices) + end, end * len(vertices) + start)
    if is_free.any():
        middle = np.average(vertices[faces].mean(axis=1), axis=0, weights=face_areas(vertices, faces))
        cones = np.column_stack([end[is_free], start[is_free], np.full(is_free.sum(), len(vertices))])
        vertices, faces = np.vstack([vertices, middle]), np.vstack([faces, cones])
    vectors = area_vectors(vertices, faces)
    x = np.einsum("qk,fkd->fqd", _CORNERS, vertices[faces])
    flux = np.einsum("fqd,fd,q->fq", x, vectors, _SHARES)  # of x; by the divergence theorem that of x·f gives ∫ f dV
    volume = flux.sum() / 3
    x = (x - np.einsum("fq,fqd->d", flux, x) / 4 / volume).reshape(-1, 3)
    flux = np.einsum("fqd,fd,q->fq", x.reshape(-1, 6, 3), vectors, _SHARES).ravel()
    second = np.einsum("p,pi,pj->ij", flux, x, x) / 5
    along, axes = np.linalg.eigh(second)
    square, total = np.einsum("pi,pi->p", x, x), along.sum()
    third, fourth = (flux * square) @ x / 6, flux @ square**2 / 7
    even = np.array([volume, *along, fourth])
    if not even.min() > 0:
        return np.zeros((7, 6))
    # How much each grows where the surface moves; the middle moves, too
    of_even = np.column_stack([np.ones(len(x)), (x @ axes) ** 2, square**2 - 4 * x @ third / volume]) / even
    skewed = x * square[:, None] - x @ (total * np.eye(3) + 2 * second) / volume
    length, part = max(float(np.linalg.norm(third)), 1e-9), volume**0.5 / total**1.5
    of_length = part * (skewed @ third / length + length * (of_even[:, 0] / 2 - 1.5 * square / total))
    grows = np.column_stack([of_even, of_length])
    weights = np.outer(np.linalg.norm(vectors, axis=1), _SHARES).ravel()
    gram = (weights[:, None] * grows).T @ grows
    gram[np.diag_indices(6)] *= 1 + _SECOND_ORDER**2
    scaled = np.array([3, 5, 5, 5, 7, 0]) * MOST_SCALED / most
    to_moves = np.linalg.inv(np.linalg.cholesky(gram + np.outer(scaled, scaled)))
    return np.vstack([[*np.log(even), part * length], to_moves])


def least_distances(one: Tensor, other: Tensor) -> Tensor:
    """(M, N) how far apart the surfaces of bodies are at least, over √area, of `moments` (M, 7, 6) and (N, 7, 6)."""

    def of_each(some: Tensor, others: Tensor) -> Tensor:
        found, maps = some[:, 0], some[:, 1:].movedim(1, 0)
        return sum(((to @ others[:, 0].T) - (to * found).sum(1, keepdim=True)).square() for to in maps).sqrt()

    # Of two third moments the longer one's direction tells how much longer it may be
    return torch.minimum(of_each(one, other), of_each(other, one).T)
