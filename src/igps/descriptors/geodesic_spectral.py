"""Eigenvalues of the affinities of geodesic distances (Jain and Zhang 2007)."""

from dataclasses import dataclass

import numpy as np

from igps._arrays import Floats, Singles
from igps._parameters import check_at_least
from igps.data.batch import Body
from igps.data.requirements import Requirements
from igps.descriptors._geodesics import geodesic_samples
from igps.nn.descriptor import BodyDescriptor


@dataclass(eq=False, repr=False)
class GeodesicSpectral(BodyDescriptor):
    """Square roots of the largest eigenvalues of exp(−d²/2σ²), d the geodesic distances and σ the longest of them.

    The matrix is that of farthest points, as for Nyström's method, and its eigenvalues are taken per point, so that
    their number does not matter but for accuracy. σ takes out the scale.
    """

    name = "geodesic_spectral"
    source = "Jain and Zhang 2007"
    invariant_to = ("motion", "scale", "pose")
    requirements = Requirements(mesh=True)

    n_eigenvalues: int = 20  # largest first
    n_samples: int = 200  # farthest points of the surface
    max_vertices: int = 1000  # larger meshes are simplified first

    def __post_init__(self) -> None:
        super().__init__()
        check_at_least(1, n_eigenvalues=self.n_eigenvalues)
        if not max(self.n_eigenvalues, 2) <= self.n_samples <= self.max_vertices:
            raise ValueError(
                f"n_samples: expected {max(self.n_eigenvalues, 2)} to max_vertices = {self.max_vertices}, "
                f"got {self.n_samples}."
            )

    def describe_body(self, body: Body) -> Singles:
        """(n_eigenvalues,) √|λₖ|, without unit; errors as of `geodesic_samples`."""
        samples = geodesic_samples(body.mesh, self.n_samples, self.max_vertices)
        values = affinity_eigenvalues(samples.mutual, self.n_eigenvalues)
        return np.sqrt(np.abs(values)).astype(np.float32)


def affinity_eigenvalues(distances: Floats, n_eigenvalues: int) -> Floats:
    """The largest eigenvalues of exp(−d²/2σ²) over the number of points, descending, σ the longest of distances (P, P).

    The last ones may be below zero: geodesic distances need not fit into a Euclidean space.
    """
    affinity = np.exp(-np.square(distances / distances.max()) / 2)
    return np.linalg.eigvalsh(affinity / len(affinity))[::-1][:n_eigenvalues]
