"""Shape-DNA: the first eigenvalues of the surface (Reuter, Wolter and Peinecke 2005)."""

import numpy as np
from torch import Tensor

from igps._arrays import Singles
from igps.data.batch import Body
from igps.data.requirements import Requirements
from igps.nn.descriptor import BodyDescriptor
from igps.retrieval.distances import euclidean


class ShapeDNA(BodyDescriptor):
    """The first non-zero eigenvalues of the Laplace–Beltrami operator, times the area of the surface.

    Source: Reuter, Wolter and Peinecke 2005 and 2006 (Euclidean distance); 12 eigenvalues with the normalisation by
    area as in Reuter's run at SHREC'11 (Lian et al. 2011).
    """

    name = "shape_dna"
    source = "Reuter, Wolter and Peinecke 2005"
    invariant_to = ("motion", "scale", "pose")

    n_eigenvalues = 12
    requirements = Requirements(n_eigenpairs=n_eigenvalues)

    def describe_body(self, body: Body) -> Singles:
        """(n_eigenvalues,) normalised eigenvalues, ascending, without unit."""
        eigenvalues = body.eigenvalues[: self.n_eigenvalues]
        return (eigenvalues * body.area).astype(np.float32)

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, G) Euclidean distances."""
        return euclidean(queries, gallery)
