"""Canonical forms: embeddings of surfaces that undo bending, compared like rigid bodies (Elad and Kimmel 2003)."""

from itertools import product

import numpy as np
import torch
from scipy.spatial.distance import cdist
from torch import Tensor

from igps._arrays import Floats, Integers, Singles
from igps.data.batch import Body
from igps.data.requirements import Requirements
from igps.descriptors.literature.geodesics import geodesic_samples
from igps.nn.descriptor import BodyDescriptor
from igps.retrieval.distances import euclidean

_DIMENSION = 3
_TOLERANCE = 1e-4  # relative reduction of the stress by a step, below which the iteration ends
_MAX_STEPS = 300


class CanonicalForm(BodyDescriptor):
    """Moments of the canonical form, whose Euclidean distances approximate the geodesic distances of the surface.

    The canonical form is defined up to motions and reflections. It is aligned to its principal axes, and the distance
    of two forms is the least over the eight reflections of one of them. Elad and Kimmel compare raw moments of surfaces
    of the same size. Here, lengths are in units of √area, and a moment of order k is divided by the (k − 1)-th power of
    the root mean square radius. So moments of all orders are lengths of similar size.
    """

    name = "canonical_form"
    source = "Elad and Kimmel 2003"
    invariant_to = ("motion", "scale", "pose")
    requirements = Requirements(mesh=True)

    max_order = 4  # largest order of the moments
    n_samples = 200  # samples of the surface, by farthest-point sampling
    max_vertices = 1000  # larger meshes are simplified first

    def describe_body(self, body: Body) -> Singles:
        """(M,) moments in units of √area, in the order of `exponents`; raises the errors of `geodesic_samples`."""
        samples = geodesic_samples(body.mesh, self.n_samples, self.max_vertices)
        distances = samples.mutual / np.sqrt(body.mesh.area)
        start = classical_scaling(distances)
        form = least_squares_scaling(distances, start)
        return moments(form, self.max_order).astype(np.float32)

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, G) Euclidean distances of the moments, each the least over the eight reflections of the query."""
        odd = torch.as_tensor(
            exponents(self.max_order) % 2, dtype=queries.dtype, device=queries.device
        )
        candidates = []
        for reflected_axes in product((0.0, 1.0), repeat=_DIMENSION):
            factors = 1 - 2 * odd * odd.new_tensor(reflected_axes)
            signs = factors.prod(dim=1)
            candidates.append(euclidean(queries * signs, gallery))
        return torch.stack(candidates).amin(dim=0)


def classical_scaling(distances: Floats) -> Floats:
    """Embed distances (P, P) as points (P, 3) by classical multidimensional scaling (Torgerson 1952).

    The points are centred and aligned to their principal axes, longest axis first. Coordinates are 0 along the axes
    that the distances leave without extent.
    """
    squared = distances**2
    row = squared.mean(axis=0)
    gram = -(squared - row - row[:, None] + row.mean()) / 2
    values, vectors = np.linalg.eigh(gram)
    # The largest eigenvalues come last.
    largest = values[::-1][:_DIMENSION]
    axes = vectors[:, ::-1][:, :_DIMENSION]
    return axes * np.sqrt(np.maximum(largest, 0))


def least_squares_scaling(distances: Floats, start: Floats) -> Floats:
    """Improve points (P, D) to a local minimum of the stress Σ (‖xᵢ−xⱼ‖ − dᵢⱼ)² (SMACOF, de Leeuw 1977).

    The result is centred. No step raises the stress.
    """
    points = start - start.mean(axis=0)
    lengths = cdist(points, points)
    stress = _stress(lengths, distances)
    for _ in range(_MAX_STEPS):
        # Guttman transform with all weights 1. Pairs of coincident points have no direction and are left out.
        ratio = np.divide(distances, lengths, out=np.zeros_like(distances), where=lengths > 0)
        sums = ratio.sum(axis=1)
        points = (sums[:, None] * points - ratio @ points) / len(points)
        lengths = cdist(points, points)
        previous = stress
        stress = _stress(lengths, distances)
        if previous - stress <= _TOLERANCE * previous:
            break
    return points


def _stress(lengths: Floats, distances: Floats) -> float:
    return float(np.square(lengths - distances).sum())


def exponents(max_order: int) -> Integers:
    """(M, 3) exponents of the moments of orders 2 to `max_order` except xy, xz, yz, which vanish in principal axes."""
    powers = range(max_order + 1)
    candidates = np.array(list(product(powers, repeat=_DIMENSION)))
    order = candidates.sum(axis=1)
    is_in_range = (order >= 2) & (order <= max_order)
    is_mixed = (order == 2) & (candidates.max(axis=1) == 1)
    return candidates[is_in_range & ~is_mixed]


def moments(points: Floats, max_order: int) -> Floats:
    """(M,) moments of points (P, 3), as lengths, in the order of `exponents`.

    A moment is the mean of xᵖ yᵠ zʳ over the points in their principal axes, divided by ρ^(p+q+r−1), where ρ is their
    root mean square radius. The signs of the axes are arbitrary: a reflection in x changes the sign where p is odd.
    """
    centred = points - points.mean(axis=0)
    squares = np.square(centred).sum(axis=1)
    radius = np.sqrt(squares.mean())
    _, vectors = np.linalg.eigh(centred.T @ centred)
    axes = vectors[:, ::-1]
    unit = centred @ axes / radius
    powers = unit[:, None, :] ** exponents(max_order)
    return radius * powers.prod(axis=2).mean(axis=0)
