"""Values of pairs of points, and their count in operations of PyTorch: for any device, and for tracing."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from igps.nn._kernels.batches import BLOCK as _BLOCK
from igps.nn._kernels.pair_loops import COSINES, DISTANCES, VALUES
from igps.nn._precision import full_precision

Inputs = Sequence[Tensor]


@dataclass(frozen=True, eq=False)
class PairValues:
    """One or several values of every pair of points, and the centres of the bins of each value.

    A value must not depend on the order of the two points.
    """

    # (N, P, ...) or (P, ...) each, finite: the values are computed from them
    inputs: tuple[Tensor, ...]
    centres: tuple[Tensor, ...]  # (B,) ascending, for each of the k values
    # Differentiable function from inputs (N, I, ...) of I points and (N, J, ...) of J points to values (N, k, I, J)
    between: Callable[[Inputs, Inputs], Tensor]
    # How compiled loops obtain the values, see `pair_loops`; by default from `between`
    kinds: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if not self.kinds:
            object.__setattr__(self, "kinds", (VALUES,) * len(self.centres))


def euclidean_distances(points: Tensor, centres: Tensor) -> PairValues:
    """Return the Euclidean distances of points.

    Args:
        points: (N, P, D) or (P, D).
        centres: (B,) ascending.
    """
    return PairValues((points,), (centres,), _distances, (DISTANCES,))


def oriented_pairs(
    points: Tensor, directions: Tensor, towards: Tensor, among: Tensor
) -> PairValues:
    """Return the three `point_pair_features` of points with directions.

    Args:
        points: (N, P, D) or (P, D).
        directions: of the same shape, of length 1.
        towards: (A,) centres of the cosines between a direction and the line between two points.
        among: (A,) centres of the cosine between two directions.

    Raises:
        ValueError: points and directions have different shapes.
    """
    if (shape := directions.shape) != points.shape:
        raise ValueError(
            f"directions: expected the shape of the points, {tuple(points.shape)}, got {tuple(shape)}."
        )
    return PairValues((points, directions), (towards, towards, among), _cosines, (COSINES,))


def pair_twists(points: Tensor, directions: Tensor, centres: Tensor) -> PairValues:
    """Return the twists (m × n)·(q − p)/|q − p| of points p, q with directions m, n; a reflection changes their signs.

    Args:
        points: (N, P, 3) or (P, 3).
        directions: of the same shape, of length 1 at most.
        centres: (B,) ascending, in [−1, 1].
    """
    return PairValues((points, directions), (centres,), _twists)


def cosine_factors(points: Tensor, directions: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Return factors of the matrices u·(y − x), v·(x − y) and u·v of points x and y with directions u and v.

    Each matrix is the product of its first factor for the rows (x, u) with its transposed second factor for the columns
    (y, v).
    """
    own = (directions * points).sum(dim=-1, keepdim=True)
    ones = torch.ones_like(points[..., :1])
    extended_points = torch.cat([points, ones], dim=-1)
    extended_directions = torch.cat([directions, -own], dim=-1)
    return [
        (extended_directions, extended_points),
        (extended_points, extended_directions),
        (directions, directions),
    ]


def point_pair_features(points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return three cosines of each pair of oriented points (Wahl et al. 2003; Drost et al. 2010).

    With u the unit vector from point i to point j, and nᵢ and nⱼ the directions, the cosines are the larger and the
    smaller of nᵢ·u and −nⱼ·u, and nᵢ·nⱼ. The first two are 1 if a direction points to the other point. All three are
    symmetric in i and j.

    Args:
        points: (P, D).
        directions: (P, D) of length 1.

    Returns:
        Three tensors (P(P−1)/2,), in the order of `torch.triu_indices`. The first two are 0 for coinciding points.
    """
    i, j = torch.triu_indices(len(points), len(points), 1, device=points.device)
    first, second, among = _cosines((points, directions), (points, directions))[:, i, j]
    return first, second, among


def _distances(rows: Inputs, columns: Inputs) -> Tensor:
    centre = rows[0].detach().mean(dim=-2, keepdim=True)  # preserves digits in the squares
    x = rows[0] - centre
    y = columns[0] - centre
    squares = (
        x.square().sum(dim=-1).unsqueeze(-1) + y.square().sum(dim=-1).unsqueeze(-2) - 2 * x @ y.mT
    )
    # At 0 the square root has no derivative, so coinciding points get a derivative of 0.
    return torch.where(squares > 0, torch.where(squares > 0, squares, 1).sqrt(), 0).unsqueeze(-3)


def _cosines(rows: Inputs, columns: Inputs) -> Tensor:
    factors = zip(cosine_factors(*rows), cosine_factors(*columns), strict=True)
    *products, among = (left @ right.mT for (left, _), (_, right) in factors)
    inverse = _inverse_distances(rows[0], columns[0])
    by_row, by_column = ((x * inverse).clamp(-1, 1) for x in products)
    return torch.stack(
        [torch.maximum(by_row, by_column), torch.minimum(by_row, by_column), among], dim=-3
    )


def _twists(rows: Inputs, columns: Inputs) -> Tensor:
    centre = rows[0].detach().mean(dim=-2, keepdim=True)
    (p, m), (q, n) = (rows[0] - centre, rows[1]), (columns[0] - centre, columns[1])
    # (m × n)·(q − p) = m·(n × q) − (p × m)·n, which are matrix products
    triple = m @ torch.linalg.cross(n, q).mT - torch.linalg.cross(p, m) @ n.mT
    return (triple * _inverse_distances(p, q)).clamp(-1, 1).unsqueeze(-3)


def _inverse_distances(x: Tensor, y: Tensor) -> Tensor:
    """Return 1 / distance (N, I, J) of points (N, I, D) and (N, J, D), or 0 if they coincide."""
    if x.shape[-1] > 3:  # coordinate by coordinate would be slow
        squares = torch.cdist(x, y, compute_mode="donot_use_mm_for_euclid_dist").square()
    else:
        coordinates = zip(x.unbind(-1), y.unbind(-1), strict=True)
        squares = sum(
            ((a.unsqueeze(-1) - b.unsqueeze(-2)).square() for a, b in coordinates), x.new_zeros(())
        )
    return torch.where(squares > 0, torch.where(squares > 0, squares, 1).rsqrt(), 0)


_EMPTY = [torch.empty(0, device="cpu")] * 4
TEMPLATES = (euclidean_distances(*_EMPTY[:2]), oriented_pairs(*_EMPTY), pair_twists(*_EMPTY[:3]))
"""All values that this module defines, with empty tensors, for `with_tensors`."""


def centres_of(pairs: Sequence[PairValues]) -> list[Tensor]:
    """Return the centres of all values, in order."""
    return [centres for pair in pairs for centres in pair.centres]


def with_tensors(pairs: Sequence[PairValues], tensors: Sequence[Tensor]) -> list[PairValues]:
    """Return the values with their inputs and centres replaced by tensors, in order."""
    remaining = iter(tensors)
    return [
        replace(
            p,
            inputs=tuple(next(remaining) for _ in p.inputs),
            centres=tuple(next(remaining) for _ in p.centres),
        )
        for p in pairs
    ]


def find_intervals(values: Tensor, centres: Tensor) -> tuple[Tensor, Tensor]:
    """Return the interval of centres (B,) that contains each value of (..., P), and its position there from 0 to 1.

    Values beyond the outer centres are in the first or last of the B − 1 intervals, at position 0 or 1. The position is
    differentiable in both arguments.
    """
    # A copy of the boundaries, as up to PyTorch 2.11 code compiled for a GPU ignores the offset of a view.
    below = torch.bucketize(
        values.detach().contiguous(), centres.detach()[1:-1].clone(), right=True
    )
    # Not centres[below], whose gradient on a GPU adds all contributions to a centre sequentially.
    rows = torch.atleast_2d(below).flatten(0, -2)
    start, end = (
        centres.expand(rows.shape[0], -1).gather(1, i).view_as(values) for i in (rows, rows + 1)
    )
    return below, ((values - start) / (end - start)).clamp(0, 1)


def count_by_torch(
    classes: Tensor,
    n_classes: int,
    pairs: Sequence[PairValues],
    mask: Tensor,
    weights: Tensor,
    *tensors: Tensor,
) -> Tensor:
    """Return float64 counts (N, C(C+1)/2, B, ...), see `count_pairs`."""
    # Padding may hold infinity, and 0 times infinity is NaN.
    clean = [
        t.masked_fill(~mask.view(*mask.shape, *[1] * (t.ndim - 2)), 0) if t.ndim > 1 else t
        for t in tensors
    ]
    weights = weights.masked_fill(~mask[:, :, None], 0)
    n_shapes, n_points, n_members = classes.shape
    bins = [len(centres) for centres in centres_of(pairs)]
    n_cells = n_classes * math.prod(bins)
    total = torch.zeros(n_shapes, n_classes, n_cells, dtype=torch.float64, device=classes.device)
    n_rows = n_points
    firsts = range(1)
    # A program for any number of shapes or points has one block, as a number of blocks would be fixed by tracing.
    if not any(isinstance(n, torch.SymInt) for n in (n_shapes, n_points)):
        n_rows = max(1, _BLOCK // (n_shapes * max(n_cells, n_points * n_members * 2 ** len(bins))))
        firsts = range(0, n_points - 1, n_rows)
    for first in firsts:
        task = partial(_count_rows, first, first + n_rows, classes, n_classes, pairs)
        # The gradient computes the values of pairs again, as storing them takes much more memory than the points.
        if torch.is_grad_enabled():
            total = total + checkpoint(task, weights, *clean, use_reentrant=False)
        else:
            total = total + task(weights, *clean)
    total = total.view(n_shapes, n_classes, n_classes, *bins)
    total = total + total.transpose(1, 2)
    a, b = torch.triu_indices(n_classes, n_classes, device=classes.device)
    return total[:, a, b] * torch.where(a == b, 0.5, 1.0).view(-1, *[1] * len(bins))


def _count_rows(
    first: int,
    end: int,
    classes: Tensor,
    n_classes: int,
    pairs: Sequence[PairValues],
    weights: Tensor,
    *others: Tensor,
) -> Tensor:
    """Return counts (N, C, C·cells), by both classes, of pairs of the points [first, end) with later points."""
    pairs = with_tensors(pairs, others)
    bins = [len(centres) for centres in centres_of(pairs)]
    with full_precision():
        values = [
            p.between([x[:, first:end] for x in p.inputs], [x[:, first:] for x in p.inputs])
            for p in pairs
        ]
    # Each row is first counted separately, by the class of the column's point only, as this adds fewer numbers, and few
    # to the same cell. Indices and weights are (N, I, J, M), finally (N, I, J, M·2^K), for the corners of each cell.
    index = classes[:, None, first:]
    # Pairs of a point with itself or with an earlier point have weight 0.
    weight = weights[:, None, first:] * torch.ones_like(values[0][0, 0]).triu(1).unsqueeze(2)
    shares = []
    for value, centres in zip(torch.cat(values, dim=1).unbind(1), centres_of(pairs), strict=True):
        below, share = find_intervals(value, centres)
        shares.append(share)
        index = index * len(centres) + below.unsqueeze(3)
    stride = math.prod(bins)
    for share, n_bins in zip(shares, bins, strict=True):
        stride //= n_bins
        upper = weight * share.unsqueeze(3)
        # Not weight·(1 − share), nor a difference of sums, as rounding could make them negative.
        weight = torch.cat([weight - upper, upper], dim=3)
        index = torch.cat([index, index + stride], dim=3)
    own = weights[:, first:end].double()
    n_cells = n_classes * math.prod(bins)
    rows = own.new_zeros(*own.shape[:2], n_cells).scatter_add(
        2, index.flatten(2), weight.double().flatten(2)
    )
    memberships = own.new_zeros(*own.shape[:2], n_classes).scatter_add(
        2, classes[:, first:end], own
    )
    return memberships.mT @ rows
