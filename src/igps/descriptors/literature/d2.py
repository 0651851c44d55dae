"""The shape distribution D2: the histogram of the distances between surface points (Osada et al. 2002)."""

import math

import numpy as np
import torch
from torch import Tensor

from igps._arrays import Singles
from igps.data.batch import Body
from igps.data.requirements import Requirements
from igps.nn.descriptor import BodyDescriptor


class D2(BodyDescriptor):
    """Histogram of the distances between all pairs of the Signature's surface samples, in units of √area.

    Source: Osada, Funkhouser, Chazelle and Dobkin 2002, with 64 bins and the L1 norm, as recommended there. Lengths are
    normalised by the area in place of the mean distance.
    """

    name = "d2"
    source = "Osada, Funkhouser, Chazelle and Dobkin 2002"
    invariant_to = ("motion", "scale")
    requirements = Requirements()

    n_bins = 64  # of equal width
    reach = 2.0  # upper end of the last bin, in units of √area; larger distances go into this bin

    def describe_body(self, body: Body) -> Singles:
        """(n_bins,) histogram of sum 1; a ValueError if the Signature has fewer than two surface samples."""
        points = body.surface.points / math.sqrt(body.area)
        if len(points) < 2:
            raise ValueError(
                f"surface samples: d2 needs at least 2, the signature has {len(points)}. "
                "Raise n_surface_samples."
            )
        lengths = torch.pdist(torch.from_numpy(points)).numpy()
        bins = (lengths * (self.n_bins / self.reach)).astype(np.int64)
        bins = np.minimum(bins, self.n_bins - 1)
        counts = np.bincount(bins, minlength=self.n_bins)
        return (counts / len(bins)).astype(np.float32)

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, G) half the L1 distance of the histograms, in [0, 1]."""
        return torch.cdist(queries, gallery, p=1) / 2
