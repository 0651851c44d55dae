"""Joint histograms of the distances between all pairs of points, split by the potential of both ends."""

from __future__ import annotations

from itertools import combinations_with_replacement

import torch
from torch import Tensor, nn

# Rows and columns of a block of pairs: its float32 distances fill half of a core's second-level cache.
_BLOCK = 512


def pair_histogram(
    embedding: Tensor,
    potential: Tensor,
    *,
    distance_range: float = 4.0,
    potential_range: float = 1.5,
    n_classes: int = 4,
    n_bins: int = 64,
) -> Tensor:
    """Histogram of pairwise distances for every unordered pair of potential classes (Rustamov 2010, section 4).

    Each unordered pair of distinct points counts once, in the row of the classes of its ends. Classes are `n_classes`
    equal intervals of [0, `potential_range`]. Bins have their centres in the middle of `n_bins` equal intervals of
    [0, `distance_range`]; a distance counts in the two bins whose centres surround it, in linear proportion. What lies
    beyond a range counts in its last class or bin.

    Args:
        embedding: (P, D) points; their Euclidean distances are counted.
        potential: (P,) non-negative.
        distance_range: largest distance told apart.
        potential_range: largest potential told apart.
        n_classes: C.
        n_bins: B.

    Returns:
        (C(C+1)/2, B) in the embedding's type, of sum 1; row order (0,0), (0,1), … (0,C−1), (1,1), …

    Raises:
        ValueError: fewer than two points, shapes that do not match, or values that are not finite.
    """
    _check(embedding, potential)
    if n_classes < 1 or n_bins < 2 or distance_range <= 0 or potential_range <= 0:
        raise ValueError(
            "expected n_classes >= 1, n_bins >= 2 and positive ranges, got "
            f"{n_classes=}, {n_bins=}, {distance_range=}, {potential_range=}."
        )
    level = (potential * (n_classes / potential_range)).long().clamp_(max=n_classes - 1)
    # Sorted by class, a block of pairs has one class at either end, and needs no class index of its own.
    order = torch.argsort(level, stable=True)
    points = embedding.detach()[order] * (n_bins / distance_range)
    groups = points.split(torch.bincount(level, minlength=n_classes).tolist())
    rows = [_group_histogram(groups[a], groups[b], a == b, n_bins) for a, b in class_pairs(n_classes)]
    counts = torch.stack(rows)
    n_points = len(points)
    return (counts / (n_points * (n_points - 1) / 2)).to(embedding.dtype)


def class_pairs(n_classes: int) -> list[tuple[int, int]]:
    """The unordered pairs of classes in the order of a histogram's rows."""
    return list(combinations_with_replacement(range(n_classes), 2))


def _group_histogram(p: Tensor, q: Tensor, same: bool, n_bins: int) -> Tensor:
    """(B,) float64 linear-kernel counts of the distances, in units of a bin, between two groups of points."""
    total = torch.zeros(2, n_bins, dtype=torch.float64, device=p.device)
    p_norm, q_norm = p.square().sum(dim=1), q.square().sum(dim=1)
    for i in range(0, len(p), _BLOCK):
        rows = slice(i, i + _BLOCK)
        for j in range(i if same else 0, len(q), _BLOCK):
            columns = slice(j, j + _BLOCK)
            squared = torch.addmm(p_norm[rows, None] + q_norm[columns], p[rows], q[columns].T, alpha=-2)
            if same and i == j:
                above = torch.triu_indices(len(squared), len(squared), 1, device=p.device)
                squared = squared[above[0], above[1]]
            # Position on the axis of bin centres, the first centre at 0; below it and beyond the last, held there.
            position = squared.clamp_(min=0.25).sqrt_().sub_(0.5).clamp_(max=n_bins - 1).flatten()
            lower = position.int()
            total[0] += torch.bincount(lower, minlength=n_bins)
            total[1] += torch.bincount(lower, weights=position.frac_(), minlength=n_bins)
    count, upper_share = total
    counts = count - upper_share
    counts[1:] += upper_share[:-1]
    return counts


def _check(embedding: Tensor, potential: Tensor) -> None:
    if embedding.ndim != 2 or potential.shape != embedding.shape[:1]:
        raise ValueError(
            "expected an embedding of shape (P, D) and a potential of shape (P,), got "
            f"{tuple(embedding.shape)} and {tuple(potential.shape)}."
        )
    if len(embedding) < 2:
        raise ValueError(f"embedding: expected at least two points to form a pair, got {len(embedding)}.")
    if not (torch.isfinite(embedding).all() and torch.isfinite(potential).all()):
        raise ValueError("embedding, potential: expected finite values, got NaN or infinity.")
    if (potential < 0).any():
        raise ValueError("potential: expected non-negative values, got a negative one.")


class PairHistogram(nn.Module):
    """`pair_histogram` over a padded batch of shapes.

    Args:
        n_classes, n_bins, distance_range, potential_range: see `pair_histogram`.
    """

    def __init__(
        self, n_classes: int = 4, n_bins: int = 64, distance_range: float = 4.0, potential_range: float = 1.5
    ) -> None:
        super().__init__()
        self.n_classes = n_classes
        self.n_bins = n_bins
        self.distance_range = distance_range
        self.potential_range = potential_range

    def forward(self, embedding: Tensor, potential: Tensor, mask: Tensor) -> Tensor:
        """(N, P, D) embedding, (N, P) potential and mask to (N, C(C+1)/2, B)."""
        return torch.stack(
            [
                pair_histogram(
                    points[real],
                    level[real],
                    distance_range=self.distance_range,
                    potential_range=self.potential_range,
                    n_classes=self.n_classes,
                    n_bins=self.n_bins,
                )
                for points, level, real in zip(embedding, potential, mask, strict=True)
            ]
        )

    def extra_repr(self) -> str:
        return (
            f"n_classes={self.n_classes}, n_bins={self.n_bins}, distance_range={self.distance_range}, "
            f"potential_range={self.potential_range}"
        )
