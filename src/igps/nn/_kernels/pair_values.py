"""What is measured of pairs of points: the values that axes of pairs sort into bins."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from igps.nn._kernels.pair_cells import COSINES, DISTANCES, VALUES
from igps.retrieval.distances import row_distances

Inputs = Sequence[Tensor]


@dataclass(frozen=True, eq=False)
class PairValues:
    """One or several values of every pair of points, and the centres of the bins that each is sorted into.

    A value must be the same whichever point comes first.
    """

    inputs: tuple[Tensor, ...]  # (N, P, ...) or (P, ...) each, what the values are computed from; finite
    centres: tuple[Tensor, ...]  # (B,) ascending, one of each value
    # The inputs of I points, (N, I, ...) each, and of J others to the values (N, k, I, J); differentiable
    between: Callable[[Inputs, Inputs], Tensor]
    kinds: tuple[int, ...] = ()  # how compiled loops get the values, see `pair_loops`; if none, as `between` gives them

    def __post_init__(self) -> None:
        if not self.kinds:
            object.__setattr__(self, "kinds", (VALUES,) * len(self.centres))


def euclidean_distances(points: Tensor, centres: Tensor) -> PairValues:
    """Euclidean distances.

    Args:
        points: (N, P, D) or (P, D).
        centres: (B,) ascending.
    """
    return PairValues((points,), (centres,), _distances, (DISTANCES,))


def oriented_pairs(points: Tensor, directions: Tensor, towards: Tensor, among: Tensor) -> PairValues:
    """The three `point_pair_features` of points with directions.

    Args:
        points: (N, P, D) or (P, D).
        directions: the same, of length 1.
        towards: (A,) centres of the cosines that tell how directions lie to the line between two points.
        among: (A,) centres of the cosine between two directions.

    Raises:
        ValueError: points and directions of different shapes.
    """
    if points.shape != directions.shape:
        raise ValueError(
            f"directions: expected the shape of the points, {tuple(points.shape)}, got {tuple(directions.shape)}."
        )
    return PairValues((points, directions), (towards, towards, among), _cosines, (COSINES,))


def pair_twists(points: Tensor, directions: Tensor, centres: Tensor) -> PairValues:
    """Twists (m × n)·(q − p)/|q − p| of points p and q with directions m and n; a reflection turns their signs.

    Args:
        points: (N, P, 3) or (P, 3).
        directions: the same, of length 1 at most.
        centres: (B,) ascending, in [−1, 1].
    """
    return PairValues((points, directions), (centres,), _twists)


def cosine_factors(points: Tensor, directions: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Matrices whose products hold u·(y − x), v·(x − y) and u·v of points x and y with directions u and v.

    Each product is of a matrix of the rows, x and u, with one of the columns, y and v, transposed.
    """
    own, ones = (directions * points).sum(dim=-1, keepdim=True), torch.ones_like(points[..., :1])
    extended, turned = torch.cat([points, ones], dim=-1), torch.cat([directions, -own], dim=-1)
    return [(turned, extended), (extended, turned), (directions, directions)]


def point_pair_features(points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Cosines that tell how each pair of oriented points lies (Wahl et al. 2003; Drost et al. 2010).

    With u the unit vector from point i to j and n their directions, these are the larger and the smaller of nᵢ·u and
    −nⱼ·u, which are 1 where a direction points to the other point, and nᵢ·nⱼ: they do not depend on which is i.

    Args:
        points: (P, D).
        directions: (P, D) of length 1.

    Returns:
        Three tensors (P(P−1)/2,), pairs in the order of `torch.triu_indices`; of points that coincide the first two
        are 0.
    """
    i, j = torch.triu_indices(len(points), len(points), 1, device=points.device)
    first, second, among = _cosines((points, directions), (points, directions))[:, i, j]
    return first, second, among


def _distances(rows: Inputs, columns: Inputs) -> Tensor:
    centre = rows[0].detach().mean(dim=-2, keepdim=True)  # keeps digits in the squares
    x, y = rows[0] - centre, columns[0] - centre
    squares = x.square().sum(dim=-1).unsqueeze(-1) + y.square().sum(dim=-1).unsqueeze(-2) - 2 * x @ y.mT
    # The root has no derivative at 0, and points that coincide no direction to move apart in.
    return torch.where(squares > 0, torch.where(squares > 0, squares, 1).sqrt(), 0).unsqueeze(-3)


def _cosines(rows: Inputs, columns: Inputs) -> Tensor:
    factors = zip(cosine_factors(*rows), cosine_factors(*columns), strict=True)
    here, there, among = (left @ right.mT for (left, _), (_, right) in factors)
    inverse = _inverse_distances(rows[0], columns[0])
    here, there = (here * inverse).clamp(-1, 1), (there * inverse).clamp(-1, 1)
    return torch.stack([torch.maximum(here, there), torch.minimum(here, there), among], dim=-3)


def _twists(rows: Inputs, columns: Inputs) -> Tensor:
    centre = rows[0].detach().mean(dim=-2, keepdim=True)
    (p, m), (q, n) = (rows[0] - centre, rows[1]), (columns[0] - centre, columns[1])
    # (m × n)·(q − p) = m·(n × q) − (p × m)·n: products of matrices
    triple = m @ torch.linalg.cross(n, q).mT - torch.linalg.cross(p, m) @ n.mT
    return (triple * _inverse_distances(p, q)).clamp(-1, 1).unsqueeze(-3)


def _inverse_distances(x: Tensor, y: Tensor) -> Tensor:
    """(N, I, J) one over the distances of points (N, I, D) and (N, J, D), 0 where they coincide."""
    if x.shape[-1] > 3:  # one difference after the other would be slow
        squares = row_distances(x, y).square()
    else:
        both = zip(x.unbind(-1), y.unbind(-1), strict=True)
        squares = sum(((a.unsqueeze(-1) - b.unsqueeze(-2)).square() for a, b in both), x.new_zeros(()))
    return torch.where(squares > 0, torch.where(squares > 0, squares, 1).rsqrt(), 0)


_NONE = torch.empty(0, device="cpu")
WAYS = (euclidean_distances(_NONE, _NONE), oriented_pairs(_NONE, _NONE, _NONE, _NONE), pair_twists(_NONE, _NONE, _NONE))
"""The values that this module makes, without their tensors."""


def centres_of(pairs: Sequence[PairValues]) -> list[Tensor]:
    """The centres of all values, in order."""
    return [one for pair in pairs for one in pair.centres]


def with_tensors(pairs: Sequence[PairValues], tensors: Sequence[Tensor]) -> list[PairValues]:
    """The values with other tensors in place of their inputs and centres."""
    remaining = iter(tensors)
    return [
        replace(
            one, inputs=tuple(next(remaining) for _ in one.inputs), centres=tuple(next(remaining) for _ in one.centres)
        )
        for one in pairs
    ]
