"""Values of pairs of points, such as distances, which axes of pairs sort into bins."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from igps.nn._kernels.pair_cells import COSINES, DISTANCES, VALUES
from igps.retrieval.distances import row_distances

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
    # How compiled loops obtain the values, see `pair_cells`; by default from `between`
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
        squares = row_distances(x, y).square()
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
