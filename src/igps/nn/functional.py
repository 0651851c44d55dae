"""The mathematics of the modules as functions of tensors, without parameters or state."""

from igps.nn._kernels.neighbours import ball_radii
from igps.nn._kernels.pairs_by_torch import (
    euclidean_distances,
    oriented_pairs,
    pair_twists,
)
from igps.nn.axes.points import soft_memberships
from igps.nn.embedding import (
    barycentroid_potential,
    interior_distance,
    spectral_embedding,
)
from igps.nn.histograms.pairs import joint_histogram, pair_histogram
from igps.nn.histograms.points import point_histogram
from igps.retrieval import chi_square
from igps.retrieval.distances import square_root

__all__ = [
    "ball_radii",
    "barycentroid_potential",
    "chi_square",
    "euclidean_distances",
    "interior_distance",
    "joint_histogram",
    "oriented_pairs",
    "pair_histogram",
    "pair_twists",
    "point_histogram",
    "soft_memberships",
    "spectral_embedding",
    "square_root",
]
