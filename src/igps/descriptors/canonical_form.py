"""Canonical forms: a bent surface is unbent, and then compared like a rigid one (Elad and Kimmel 2003)."""

from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from scipy.spatial.distance import cdist
from torch import Tensor

from igps._arrays import Floats, Integers, Singles
from igps._parameters import check_at_least
from igps.data.batch import Body
from igps.data.requirements import Requirements
from igps.descriptors._geodesics import geodesic_samples
from igps.nn.descriptor import BodyDescriptor
from igps.retrieval.distances import euclidean

_DIMENSION = 3
# The iteration ends where a step takes off less than this share of the stress, or after so many steps.
_TOLERANCE = 1e-4
_MAX_STEPS = 300


@dataclass(eq=False, repr=False)
class CanonicalForm(BodyDescriptor):
    """Moments of the points in space whose straight distances come closest to the geodesic distances of the surface.

    The form is known up to motions and reflections. It is laid along its principal axes, and of the eight reflections
    of one form against another the closest counts. Elad and Kimmel compare raw moments of surfaces of one size; here
    lengths are in units of the square root of the surface area, and a moment of order k is divided by the (k − 1)-th
    power of the root mean square radius, so that moments of all orders are lengths of similar size.
    """

    name = "canonical_form"
    source = "Elad and Kimmel 2003"
    invariant_to = ("motion", "scale", "pose")
    requirements = Requirements(mesh=True)

    max_order: int = 4  # of the moments
    n_samples: int = 200  # farthest points of the surface
    max_vertices: int = 1000  # larger meshes are simplified first

    def __post_init__(self) -> None:
        super().__init__()
        check_at_least(2, max_order=self.max_order)  # lower moments are fixed
        if not _DIMENSION < self.n_samples <= self.max_vertices:
            raise ValueError(
                f"n_samples: expected {_DIMENSION + 1} to max_vertices = {self.max_vertices}, got {self.n_samples}."
            )

    def describe_body(self, body: Body) -> Singles:
        """(number of moments,), in √area, ordered as `exponents(max_order)`; errors as of `geodesic_samples`."""
        samples = geodesic_samples(body.mesh, self.n_samples, self.max_vertices)
        distances = samples.mutual / np.sqrt(body.mesh.area)
        form = least_squares_scaling(distances, classical_scaling(distances))
        return moments(form, self.max_order).astype(np.float32)

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, G) Euclidean distances of the moments, the least over the eight reflections of the query."""
        odd = torch.as_tensor(exponents(self.max_order) % 2, dtype=queries.dtype, device=queries.device)
        reflections = product((0.0, 1.0), repeat=_DIMENSION)
        signs = ((1 - 2 * odd * odd.new_tensor(axes)).prod(dim=1) for axes in reflections)
        return torch.stack([euclidean(queries * sign, gallery) for sign in signs]).amin(dim=0)


def classical_scaling(distances: Floats) -> Floats:
    """Points whose inner products come closest to those that distances (P, P) imply (Torgerson 1952).

    They are (P, 3), centred, along their principal axes, longest first; 0 where the distances span fewer.
    """
    squared = distances**2
    row = squared.mean(axis=0)
    gram = -(squared - row - row[:, None] + row.mean()) / 2
    values, vectors = np.linalg.eigh(gram)
    values, vectors = values[::-1][:_DIMENSION], vectors[:, ::-1][:, :_DIMENSION]
    return vectors * np.sqrt(np.maximum(values, 0))


def least_squares_scaling(distances: Floats, start: Floats) -> Floats:
    """Points (P, D) that locally minimise the stress Σ (‖xᵢ−xⱼ‖ − dᵢⱼ)², centred (SMACOF, de Leeuw 1977).

    No step raises the stress.
    """
    points = start - start.mean(axis=0)
    lengths = cdist(points, points)
    stress = float(np.square(lengths - distances).sum())
    for _ in range(_MAX_STEPS):
        # Guttman transform for weights 1. Points that coincide do not pull.
        pull = np.divide(distances, lengths, out=np.zeros_like(distances), where=lengths > 0)
        points = (pull.sum(axis=1)[:, None] * points - pull @ points) / len(points)
        lengths = cdist(points, points)
        before, stress = stress, float(np.square(lengths - distances).sum())
        if before - stress <= _TOLERANCE * before:
            break
    return points


def exponents(max_order: int) -> Integers:
    """(M, 3) exponents of the moments that principal axes leave open: orders 2 to `max_order` without xy, xz and yz."""
    every = np.array(list(product(range(max_order + 1), repeat=_DIMENSION)))
    order = every.sum(axis=1)
    fixed = (order == 2) & (every.max(axis=1) == 1)
    return every[(order >= 2) & (order <= max_order) & ~fixed]


def moments(points: Floats, max_order: int) -> Floats:
    """Mean of xᵖ yᵠ zʳ over points laid along their principal axes, over ρ^(p+q+r−1) with their rms radius ρ.

    The signs of the axes are arbitrary: a reflection in x changes the sign of the moments with odd p. Of points (P, 3)
    these are (M,), a length each, ordered as `exponents(max_order)`.
    """
    centred = points - points.mean(axis=0)
    radius = np.sqrt(np.square(centred).sum(axis=1).mean())
    axes = np.linalg.eigh(centred.T @ centred)[1][:, ::-1]
    unit = centred @ axes / radius
    powers = unit[:, None, :] ** exponents(max_order)
    return radius * powers.prod(axis=2).mean(axis=0)
