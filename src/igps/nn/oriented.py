"""Histograms of point pair features: how two samples lie to each other and to the surface next to them."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.checkpoint import checkpoint

from igps.nn.bins import OrderedCentres, middles, position

# Pairs, of both orders, that are held at once.
_BLOCK = 2**18


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
    return _features(points, directions, *_pairs(points, slice(None)))


def _pairs(points: Tensor, rows: slice) -> tuple[slice, Tensor]:
    """The pairs (i, j > i) of some rows i: the rows, and a mask of (rows, P)."""
    first, last, _ = rows.indices(len(points))
    return slice(first, last), torch.ones(last - first, len(points), dtype=torch.bool, device=points.device).triu(
        1 + first
    )


def _features(points: Tensor, directions: Tensor, rows: slice, pairs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    length = torch.cdist(points[rows], points, compute_mode="donot_use_mm_for_euclid_dist")[pairs]
    inverse = torch.where(length > 0, 1 / torch.where(length > 0, length, 1), 0)
    own = (directions * points).sum(dim=1)
    towards_j = ((directions[rows] @ points.T - own[rows, None])[pairs] * inverse).clamp(-1, 1)
    towards_i = ((points[rows] @ directions.T - own)[pairs] * inverse).clamp(-1, 1)
    between = (directions[rows] @ directions.T)[pairs]
    return torch.maximum(towards_j, towards_i), torch.minimum(towards_j, towards_i), between


class OrientedPairHistogram(nn.Module):
    """Joint histograms of a distance and the `point_pair_features` of all pairs of oriented points.

    Each unordered pair counts once, in linear proportion in the two bins of each of the four axes whose centres
    surround its value; values beyond the outer centres count there. It is differentiable in all that it is given.

    Args:
        n_bins: B, of the distance.
        n_angle_bins: A, of each cosine.
        distance_range: largest distance told apart.
        learnable: whether the centres of all bins are parameters.
    """

    def __init__(
        self, n_bins: int = 6, n_angle_bins: int = 5, distance_range: float = 3.0, *, learnable: bool = False
    ) -> None:
        super().__init__()
        for name, value in (("n_bins", n_bins), ("n_angle_bins", n_angle_bins)):
            if value < 2:
                raise ValueError(f"{name}: expected at least 2, got {value}.")
        self.n_bins = n_bins
        self.n_angle_bins = n_angle_bins
        cosines = middles(n_angle_bins, 2.0, "angle_bins") - 1
        self.distance_centres = OrderedCentres(middles(n_bins, distance_range, "bins"), learnable)
        self.towards_centres = OrderedCentres(cosines, learnable)
        self.between_centres = OrderedCentres(cosines, learnable)

    @property
    def n_cells(self) -> int:
        """Cells of a histogram, over all its dimensions."""
        return self.n_bins * self.n_angle_bins**3

    @torch.compiler.disable
    def forward(self, coordinates: Tensor, points: Tensor, directions: Tensor, mask: Tensor) -> Tensor:
        """Histograms of N shapes.

        Args:
            coordinates: (N, P, K), whose Euclidean distances are counted.
            points: (N, P, D), what the directions lie in.
            directions: (N, P, D) of length 1.
            mask: (N, P) true where a point is real.

        Returns:
            (N, B, A, A, A), each shape's of sum 1.

        Raises:
            ValueError: fewer than two points, shapes that do not match, or values that are not finite.
        """
        histograms = []
        for i, real in enumerate(mask):
            inputs = [values[i, real] for values in (coordinates, points, directions)]
            _check(*inputs)
            histograms.append(self._histogram(*inputs))
        return torch.stack(histograms)

    def _histogram(self, coordinates: Tensor, points: Tensor, directions: Tensor) -> Tensor:
        dtype = torch.promote_types(coordinates.dtype, torch.float32)
        inputs = tuple(values.to(dtype) for values in (coordinates, points, directions))
        n_points = len(points)
        n_rows = max(1, _BLOCK // n_points)
        counts = torch.zeros(self.n_cells, dtype=torch.float64, device=points.device)
        with torch.autocast(points.device.type, enabled=False):
            for first in range(0, n_points - 1, n_rows):
                # What the gradient needs of the pairs is many times what it needs of the points: computed again.
                counts = counts + checkpoint(
                    self._counts, *inputs, slice(first, min(first + n_rows, n_points)), use_reentrant=False
                )
        shape = (self.n_bins, *[self.n_angle_bins] * 3)
        return (counts / (n_points * (n_points - 1) / 2)).to(dtype).view(shape)

    def _counts(self, coordinates: Tensor, points: Tensor, directions: Tensor, rows: slice) -> Tensor:
        """(cells,) counts of the pairs of some rows."""
        rows, pairs = _pairs(points, rows)
        distance = torch.cdist(coordinates[rows], coordinates)[pairs]
        first, second, between = _features(points, directions, rows, pairs)
        towards = self.towards_centres()
        axes = [
            (distance, self.distance_centres()),
            (first, towards),
            (second, towards),
            (between, self.between_centres()),
        ]
        # The cell of the lower centres, and how the weight of a pair is shared among it and the cells next to it.
        cell = torch.zeros_like(distance, dtype=torch.long)
        corners = [(0, torch.ones_like(distance))]
        for values, centres in axes:
            lower, share = position(values, centres)
            cell = cell * len(centres) + lower
            corners = [
                (len(centres) * offset + step, weight * share if step else weight - weight * share)
                for offset, weight in corners
                for step in (0, 1)
            ]
        counts = torch.zeros(self.n_cells, dtype=torch.float64, device=points.device)
        for offset, weight in corners:
            added = torch.zeros_like(counts).index_add(0, cell, weight.double())
            # The lower centre is the last but one at most, so that nothing is rolled over the end.
            counts = counts + added.roll(offset)
        return counts

    def extra_repr(self) -> str:
        return f"n_bins={self.n_bins}, n_angle_bins={self.n_angle_bins}"


def _check(coordinates: Tensor, points: Tensor, directions: Tensor) -> None:
    if coordinates.ndim != 2 or points.shape != directions.shape or len(points) != len(coordinates):
        raise ValueError(
            "expected coordinates of shape (N, P, K), points and directions of shape (N, P, D), got "
            f"{tuple(coordinates.shape)}, {tuple(points.shape)} and {tuple(directions.shape)} of one shape."
        )
    if len(points) < 2:
        raise ValueError(f"points: expected at least two points to form a pair, got {len(points)}.")
    if not all(bool(torch.isfinite(values).all()) for values in (coordinates, points, directions)):
        raise ValueError("coordinates, points, directions: expected finite values, got NaN or infinity.")


def nearest_directions(points: Tensor, targets: Tensor, n_nearest: int = 8) -> Tensor:
    """Unit vectors from points to the mean of the targets nearest to them.

    Args:
        points: (P, D).
        targets: (T, D).
        n_nearest: how many of the targets; all if there are fewer.

    Returns:
        (P, D); zero where the mean is the point itself.
    """
    nearest = torch.cdist(points.detach(), targets.detach()).topk(min(n_nearest, len(targets)), largest=False).indices
    return functional.normalize(targets[nearest].mean(dim=1) - points, dim=1)
