"""Eigenvalues of an affinity matrix of geodesic distances (Jain and Zhang 2007)."""

import numpy as np

from igps._arrays import Floats, Singles
from igps.data.batch import Body
from igps.data.requirements import Requirements
from igps.descriptors.literature.geodesics import geodesic_samples
from igps.nn.descriptor import BodyDescriptor


class GeodesicSpectral(BodyDescriptor):
    """Square roots of the largest eigenvalues of the matrix exp(−d²/2σ²) of geodesic distances d, with σ their maximum.

    The distances are those between samples by farthest-point sampling, as for Nyström's method. The eigenvalues are
    divided by the number of samples, which then affects only the accuracy. σ removes the scale.
    """

    name = "geodesic_spectral"
    source = "Jain and Zhang 2007"
    invariant_to = ("motion", "scale", "pose")
    requirements = Requirements(mesh=True)

    n_eigenvalues = 20  # largest first
    n_samples = 200  # samples of the surface, by farthest-point sampling
    max_vertices = 1000  # larger meshes are simplified first

    def describe_body(self, body: Body) -> Singles:
        """(n_eigenvalues,) √|λₖ|, without unit; raises the errors of `geodesic_samples`."""
        samples = geodesic_samples(body.mesh, self.n_samples, self.max_vertices)
        values = affinity_eigenvalues(samples.mutual, self.n_eigenvalues)
        return np.sqrt(np.abs(values)).astype(np.float32)


def affinity_eigenvalues(distances: Floats, n_eigenvalues: int) -> Floats:
    """Largest eigenvalues of exp(−d²/2σ²) / P of distances d (P, P), descending, with σ the largest distance.

    The smaller ones may be negative, because geodesic distances need not embed in a Euclidean space.
    """
    affinity = np.exp(-np.square(distances / distances.max()) / 2)
    return np.linalg.eigvalsh(affinity / len(affinity))[::-1][:n_eigenvalues]
