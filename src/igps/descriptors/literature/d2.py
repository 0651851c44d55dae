"""Shape distributions: histograms of a simple function of random surface points (Osada et al. 2002)."""

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from igps._arrays import Floats, Singles
from igps._parameters import check_at_least, check_one_of, check_positive
from igps.data.batch import Body
from igps.data.requirements import Requirements
from igps.nn.descriptor import BodyDescriptor

ShapeFunction = Literal["d2", "a3", "d1"]

_N_POINTS = {"d2": 2, "a3": 3, "d1": 1}


@dataclass(eq=False, repr=False)
class D2(BodyDescriptor):
    """Histogram of a shape function over the surface: "d2", which retrieves best, "d1" or "a3".

    D2 is the distance between two points, over all pairs of the signature's surface samples. D1 is the distance of a
    point from the centroid of the surface. Both are in units of √area. A3 is the angle between three points, in [0, π].

    Source: Osada, Funkhouser, Chazelle and Dobkin 2002, with 64 bins and the L1 norm, as recommended there. Lengths are
    normalised by the area in place of the mean distance.
    """

    name = "d2"
    source = "Osada, Funkhouser, Chazelle and Dobkin 2002"
    invariant_to = ("motion", "scale")
    requirements = Requirements()

    function: ShapeFunction = "d2"
    n_bins: int = 64  # bins of equal width
    reach: float = 2.0  # upper end of the last bin for distances, in units of √area; larger values go into this bin
    n_triples: int = 1024**2  # random triples of samples for A3; 1024² in the source
    seed: int = 0  # of the random triples

    def __post_init__(self) -> None:
        super().__init__()
        check_one_of(get_args(ShapeFunction), function=self.function)
        check_at_least(1, n_bins=self.n_bins, n_triples=self.n_triples)
        check_positive(reach=self.reach)

    def describe_body(self, body: Body) -> Singles:
        """(n_bins,) histogram of sum 1; a ValueError if the signature has too few surface samples."""
        points = body.surface.points / math.sqrt(body.area)
        if len(points) < _N_POINTS[self.function]:
            raise ValueError(
                f"surface samples: {self.function} needs at least {_N_POINTS[self.function]}, the signature has "
                f"{len(points)}. Raise n_surface_samples."
            )
        values, end = self._values(points)
        bins = (values * (self.n_bins / end)).astype(np.int64)
        bins = np.minimum(bins, self.n_bins - 1)
        counts = np.bincount(bins, minlength=self.n_bins)
        return (counts / len(bins)).astype(np.float32)

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, G) half the L1 distance of the histograms, in [0, 1]."""
        return torch.cdist(queries, gallery, p=1) / 2

    def _values(self, points: Floats) -> tuple[Floats, float]:
        """Values of the shape function, and the upper end of its last bin."""
        if self.function == "d2":
            between = torch.pdist(torch.from_numpy(points))
            return between.numpy(), self.reach
        if self.function == "d1":
            offsets = points - points.mean(axis=0)
            return np.linalg.norm(offsets, axis=1), self.reach
        generator = np.random.default_rng(self.seed)
        return _angles(points, self.n_triples, generator), math.pi


def _angles(points: Floats, n_triples: int, generator: np.random.Generator) -> Floats:
    """(n_triples,) angles at the first of three distinct random samples, in radians."""
    n_points = len(points)
    corner = generator.integers(n_points, size=n_triples)
    # Index offsets, modulo the number of samples. They are neither zero nor equal, so the three samples are distinct.
    first = generator.integers(1, n_points, size=n_triples)
    second = generator.integers(1, n_points - 1, size=n_triples)
    second += second >= first
    a = points[(corner + first) % n_points] - points[corner]
    b = points[(corner + second) % n_points] - points[corner]
    sine = np.linalg.norm(np.cross(a, b), axis=1)
    cosine = np.einsum("ni,ni->n", a, b)
    return np.arctan2(sine, cosine)
