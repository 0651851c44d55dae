"""Values of pairs of points, and their count in operations of PyTorch: for any device, and for tracing."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from igps._tensors import with_axes_of
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
    kind: int = VALUES  # how compiled loops obtain the values, see `pair_loops`


def euclidean_distances(points: Tensor, centres: Tensor) -> PairValues:
    """Return the Euclidean distances of points.

    Args:
        points: (N, P, D) or (P, D).
        centres: (B,) ascending.
    """
    return PairValues((points,), (centres,), _distances, DISTANCES)


def oriented_pairs(
    points: Tensor, directions: Tensor, towards: Tensor, among: Tensor
) -> PairValues:
    """Return three cosines of each pair of points with directions (Wahl et al. 2003; Drost et al. 2010).

    With u the unit vector from point i to point j, and nᵢ and nⱼ the directions, the cosines are the larger and the
    smaller of nᵢ·u and −nⱼ·u, and nᵢ·nⱼ. The first two are 1 if a direction points to the other point, and 0 for
    coinciding points. All three are symmetric in i and j.

    Args:
        points: (N, P, D) or (P, D).
        directions: of the same shape, of length 1.
        towards: (A,) centres of the cosines between a direction and the line between two points.
        among: (A,) centres of the cosine between two directions.

    Raises:
        ValueError: points and directions have different shapes.
    """
    expected = tuple(points.shape)
    shape = tuple(directions.shape)
    if shape != expected:
        raise ValueError(f"directions: expected the shape of the points, {expected}, got {shape}.")
    return PairValues((points, directions), (towards, towards, among), _cosines, COSINES)


def pair_twists(points: Tensor, directions: Tensor, centres: Tensor) -> PairValues:
    """Return the twists (m × n)·(q − p)/|q − p| of points p, q with directions m, n; a reflection changes their signs.

    Args:
        points: (N, P, 3) or (P, 3).
        directions: of the same shape, of length 1 at most.
        centres: (B,) ascending, in [−1, 1].
    """
    return PairValues((points, directions), (centres,), _twists)


def cosine_products(rows: Inputs, columns: Inputs) -> tuple[Tensor, Tensor, Tensor]:
    """Return u·(y − x), v·(x − y) and u·v (N, I, J) of points x with directions u and points y with directions v."""
    row_points, row_directions = _extended(*rows)
    column_points, column_directions = _extended(*columns)
    along_row = row_directions @ column_points.mT
    along_column = row_points @ column_directions.mT
    among = rows[1] @ columns[1].mT
    return along_row, along_column, among


def _extended(points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Return (x, 1) and (u, −u·x) for points x with directions u, as u·(y − x) is their product for x and y."""
    own = (directions * points).sum(dim=-1, keepdim=True)
    ones = torch.ones_like(points[..., :1])
    extended_points = torch.cat([points, ones], dim=-1)
    extended_directions = torch.cat([directions, -own], dim=-1)
    return extended_points, extended_directions


def _distances(rows: Inputs, columns: Inputs) -> Tensor:
    x, y = _centred(rows[0], columns[0])
    x_squares = x.square().sum(dim=-1).unsqueeze(-1)
    y_squares = y.square().sum(dim=-1).unsqueeze(-2)
    squares = x_squares + y_squares - 2 * x @ y.mT
    return _where_apart(squares, torch.sqrt).unsqueeze(-3)


def _cosines(rows: Inputs, columns: Inputs) -> Tensor:
    along_row, along_column, among = cosine_products(rows, columns)
    inverse = _inverse_distances(rows[0], columns[0])
    by_row = (along_row * inverse).clamp(-1, 1)
    by_column = (along_column * inverse).clamp(-1, 1)
    larger = torch.maximum(by_row, by_column)
    smaller = torch.minimum(by_row, by_column)
    return torch.stack([larger, smaller, among], dim=-3)


def _twists(rows: Inputs, columns: Inputs) -> Tensor:
    p, q = _centred(rows[0], columns[0])
    m = rows[1]
    n = columns[1]
    # (m × n)·(q − p) = m·(n × q) − (p × m)·n, which are matrix products
    row_moments = torch.linalg.cross(p, m)
    column_moments = torch.linalg.cross(n, q)
    triple = m @ column_moments.mT - row_moments @ n.mT
    twists = triple * _inverse_distances(p, q)
    return twists.clamp(-1, 1).unsqueeze(-3)


def _centred(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Return points of rows and of columns relative to the mean of those of rows, which preserves digits in squares."""
    centre = x.detach().mean(dim=-2, keepdim=True)
    return x - centre, y - centre


def _inverse_distances(x: Tensor, y: Tensor) -> Tensor:
    """Return 1 / distance (N, I, J) of points (N, I, D) and (N, J, D), or 0 if they coincide."""
    if x.shape[-1] > 3:  # coordinate by coordinate would be slow
        squares = torch.cdist(x, y, compute_mode="donot_use_mm_for_euclid_dist").square()
    else:
        squares = x.new_zeros(())
        for a, b in zip(x.unbind(-1), y.unbind(-1), strict=True):
            difference = a.unsqueeze(-1) - b.unsqueeze(-2)
            squares = squares + difference.square()
    return _where_apart(squares, torch.rsqrt)


def _where_apart(squares: Tensor, root: Callable[[Tensor], Tensor]) -> Tensor:
    """Return a root of squared distances; 0 for coinciding points, and its derivative, which no root has there."""
    is_apart = squares > 0
    return torch.where(is_apart, root(torch.where(is_apart, squares, 1)), 0)


_EMPTY = torch.empty(0, device="cpu")
TEMPLATES = (
    euclidean_distances(_EMPTY, _EMPTY),
    oriented_pairs(_EMPTY, _EMPTY, _EMPTY, _EMPTY),
    pair_twists(_EMPTY, _EMPTY, _EMPTY),
)
"""All values that this module defines, with empty tensors, for `with_tensors`."""


def centres_of(pairs: Sequence[PairValues]) -> list[Tensor]:
    """Return the centres of all values, in order."""
    return [centres for pair in pairs for centres in pair.centres]


def bins_of(pairs: Sequence[PairValues]) -> list[int]:
    """Return the number of bins of each value, in order."""
    return [len(centres) for centres in centres_of(pairs)]


def with_tensors(pairs: Sequence[PairValues], tensors: Sequence[Tensor]) -> list[PairValues]:
    """Return the values with their inputs and centres replaced by tensors, in order."""
    remaining = iter(tensors)
    replaced = []
    for pair in pairs:
        inputs = tuple(next(remaining) for _ in pair.inputs)
        centres = tuple(next(remaining) for _ in pair.centres)
        replaced.append(replace(pair, inputs=inputs, centres=centres))
    return replaced


def find_intervals(values: Tensor, centres: Tensor) -> tuple[Tensor, Tensor]:
    """Return the interval of centres (B,) that contains each value of (..., P), and its position there from 0 to 1.

    Values beyond the outer centres are in the first or last of the B − 1 intervals, at position 0 or 1. The position is
    differentiable in both arguments.
    """
    # A copy of the boundaries, as up to PyTorch 2.11 code compiled for a GPU ignores the offset of a view.
    boundaries = centres.detach()[1:-1].clone()
    below = torch.bucketize(values.detach().contiguous(), boundaries, right=True)
    start = _centres_at(centres, below)
    end = _centres_at(centres, below + 1)
    position = (values - start) / (end - start)
    return below, position.clamp(0, 1)


def _centres_at(centres: Tensor, indices: Tensor) -> Tensor:
    # Not centres[indices], whose gradient on a GPU adds all contributions to a centre sequentially.
    rows = torch.atleast_2d(indices).flatten(0, -2)
    in_each_row = centres.expand(rows.shape[0], -1)
    return in_each_row.gather(1, rows).view_as(indices)


class Layout(NamedTuple):
    """The arguments of `count_pairs` for which no gradient is computed."""

    classes: Tensor
    n_classes: int
    pairs: Sequence[PairValues]
    mask: Tensor


def count_by_torch(layout: Layout, weights: Tensor, *tensors: Tensor) -> Tensor:
    """Return float64 counts (N, C(C+1)/2, B, ...), see `count_pairs`."""
    classes, n_classes, pairs, mask = layout
    clean = [_without_padding(tensor, mask) for tensor in tensors]
    weights = _without_padding(weights, mask)
    n_shapes, n_points, n_members = classes.shape
    bins = bins_of(pairs)
    n_cells = n_classes * math.prod(bins)
    if isinstance(n_shapes, torch.SymInt) or isinstance(n_points, torch.SymInt):
        # A program for any number of shapes or points has one block, as tracing would fix the number of blocks.
        n_rows = n_points
        firsts = range(1)
    else:
        n_corners = n_points * n_members * 2 ** len(bins)
        row_size = n_shapes * max(n_cells, n_corners)
        n_rows = max(1, _BLOCK // row_size)
        firsts = range(0, n_points - 1, n_rows)
    total = torch.zeros(n_shapes, n_classes, n_cells, dtype=torch.float64, device=classes.device)
    for first in firsts:
        task = partial(_count_rows, first, first + n_rows, layout)
        # The gradient computes the values of pairs again, as storing them takes much more memory than the points.
        if torch.is_grad_enabled():
            total = total + checkpoint(task, weights, *clean, use_reentrant=False)
        else:
            total = total + task(weights, *clean)
    total = total.view(n_shapes, n_classes, n_classes, *bins)
    total = total + total.transpose(1, 2)
    a, b = torch.triu_indices(n_classes, n_classes, device=classes.device)
    # The sum with its transpose counts pairs of one class twice
    factors = torch.where(a == b, 0.5, 1.0)
    return total[:, a, b] * factors.view(-1, *[1] * len(bins))


def _without_padding(tensor: Tensor, mask: Tensor) -> Tensor:
    """Return a tensor (N, P, ...) with 0 in place of padding, which may hold infinity: 0 times infinity is NaN."""
    if tensor.ndim == 1:  # centres
        return tensor
    return tensor.masked_fill(with_axes_of(~mask, tensor), 0)


def _count_rows(first: int, end: int, layout: Layout, weights: Tensor, *others: Tensor) -> Tensor:
    """Return counts (N, C, C·cells), by both classes, of pairs of the points [first, end) with later points."""
    classes = layout.classes
    n_classes = layout.n_classes
    pairs = with_tensors(layout.pairs, others)
    values = []
    with full_precision():
        for pair in pairs:
            rows = [x[:, first:end] for x in pair.inputs]
            columns = [x[:, first:] for x in pair.inputs]
            values.append(pair.between(rows, columns))
    # Each row is first counted separately, by the class of the column's point only, as this adds fewer numbers, and few
    # to the same cell. Indices and weights are (N, I, J, M), finally (N, I, J, M·2^K), for the corners of each cell.
    bins = bins_of(pairs)
    index = classes[:, None, first:]
    shares = []
    each_value = torch.cat(values, dim=1).unbind(1)
    for value, centres in zip(each_value, centres_of(pairs), strict=True):
        below, share = find_intervals(value, centres)
        shares.append(share)
        index = index * len(centres) + below.unsqueeze(3)
    # Pairs of a point with itself or with an earlier point have weight 0.
    is_later = torch.ones_like(values[0][0, 0]).triu(1)
    weight = weights[:, None, first:] * is_later.unsqueeze(2)
    n_cells = math.prod(bins)
    stride = n_cells
    for share, n_bins in zip(shares, bins, strict=True):
        stride //= n_bins
        upper = weight * share.unsqueeze(3)
        # Not weight·(1 − share), nor a difference of sums, as rounding could make them negative.
        weight = torch.cat([weight - upper, upper], dim=3)
        index = torch.cat([index, index + stride], dim=3)
    own = weights[:, first:end].double()
    counts = own.new_zeros(*own.shape[:2], n_classes * n_cells)
    counts = counts.scatter_add(2, index.flatten(2), weight.double().flatten(2))
    memberships = own.new_zeros(*own.shape[:2], n_classes)
    memberships = memberships.scatter_add(2, classes[:, first:end], own)
    return memberships.mT @ counts
