"""The histogram of pair distances of points in hard classes, in equal bins: the fastest there is, without gradient."""

from __future__ import annotations

from itertools import combinations_with_replacement

import torch
from torch import Tensor
from torch.nn.functional import one_hot

from igps.nn._kernels.counted_pairs import can_count, count_pairs
from igps.nn._precision import full_precision

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
        distance_range: end of the last bin.
        potential_range: end of the last class.
        n_classes: C.
        n_bins: B.

    Returns:
        (C(C+1)/2, B) in the embedding's type, float32 at least, of sum 1; row order (0,0), (0,1), … (0,C−1), (1,1), …

    Raises:
        ValueError: fewer than two points, shapes that do not match, or values that are not finite.
    """
    if potential.shape != embedding.shape[:1]:
        raise ValueError(
            f"potential: expected shape {tuple(embedding.shape[:1])}, one of each point, got {tuple(potential.shape)}."
        )
    if not bool(((potential >= 0) & torch.isfinite(potential)).all()):
        raise ValueError("potential: expected non-negative, finite values, got others.")
    if n_classes < 1 or n_bins < 2 or distance_range <= 0 or potential_range <= 0:
        raise ValueError(
            "expected n_classes >= 1, n_bins >= 2 and positive ranges, got "
            f"{n_classes=}, {n_bins=}, {distance_range=}, {potential_range=}."
        )
    level = (potential * (n_classes / potential_range)).long().clamp_(max=n_classes - 1)
    return hard_pair_histogram(embedding, level, n_classes, n_bins, distance_range / n_bins)


def hard_pair_histogram(points: Tensor, level: Tensor, n_classes: int, n_bins: int, width: float) -> Tensor:
    """`pair_histogram` of points whose classes are known.

    Args:
        points: (P, D), at least two.
        level: (P,) int64 class of each, from 0 to C − 1.
        n_classes: C.
        n_bins: B.
        width: of a bin.

    Returns:
        (C(C+1)/2, B), see `pair_histogram`.

    Raises:
        ValueError: fewer than two points, or points that are not finite.
    """
    check_points(points)
    points = single_at_least(points.detach())
    if can_count(points):
        centres = (torch.arange(n_bins, dtype=points.dtype) + 0.5) * width
        memberships = one_hot(level, n_classes)
        return count_pairs(memberships, [(points, centres)]).to(points.dtype)
    # Sorted by class, a block of pairs has one class at either end, and needs no class index of its own.
    order = torch.argsort(level, stable=True)
    groups = (points[order] / width).split(torch.bincount(level, minlength=n_classes).tolist())
    with torch.autocast(points.device.type, enabled=False), full_precision():
        rows = [_group_histogram(groups[a], groups[b], a == b, n_bins) for a, b in class_pairs(n_classes)]
    n_points = len(points)
    return (torch.stack(rows) / (n_points * (n_points - 1) / 2)).to(points.dtype)


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


def check_points(points: Tensor) -> None:
    """Raise a ValueError unless these are at least two finite points, (P, D)."""
    if points.ndim != 2:
        raise ValueError(f"points: expected shape (P, D), got {tuple(points.shape)}.")
    if len(points) < 2:
        raise ValueError(f"points: expected at least two points to form a pair, got {len(points)}.")
    # A finite sum is one of finite values, and takes a tenth of the time; but theirs may be beyond all numbers too.
    if not torch.isfinite(points.sum()) and not torch.isfinite(points).all():
        raise ValueError("points: expected finite values, got NaN or infinity.")


def single_at_least(values: Tensor) -> Tensor:
    """Half precision as float32, all else as it is."""
    return values.float() if values.dtype in (torch.float16, torch.bfloat16) else values
