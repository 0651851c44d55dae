"""Histograms of point pair features: how two samples lie to each other and to the surface next to them."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.checkpoint import checkpoint

from igps.nn.bins import OrderedCentres, middles, position

# Pairs that are held at once: each of their many numbers fills a part of a core's second-level cache.
_BLOCK = 2**16


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
    first, second, between = (feature[i, j] for feature in _features(points, directions, 0, len(points)))
    return first, second, between


def _features(points: Tensor, directions: Tensor, first: int, last: int) -> tuple[Tensor, Tensor, Tensor]:
    """(last − first, P − first) features of the pairs of points from `first` to `last` with those from `first` on."""
    rows, row_directions = points[first:last], directions[first:last]
    columns, column_directions = points[first:], directions[first:]
    length = torch.cdist(rows, columns, compute_mode="donot_use_mm_for_euclid_dist")
    inverse = torch.where(length > 0, 1 / torch.where(length > 0, length, 1), 0)
    own_row, own_column = (row_directions * rows).sum(dim=1), (column_directions * columns).sum(dim=1)
    towards_column = (torch.addmm(-own_row[:, None], row_directions, columns.T) * inverse).clamp(-1, 1)
    towards_row = (torch.addmm(-own_column, rows, column_directions.T) * inverse).clamp(-1, 1)
    between = row_directions @ column_directions.T
    return torch.maximum(towards_column, towards_row), torch.minimum(towards_column, towards_row), between


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
        sums = torch.zeros(16, self.n_cells, dtype=torch.float64, device=points.device)
        with torch.autocast(points.device.type, enabled=False):
            for first in range(0, n_points - 1, n_rows):
                # What the gradient needs of the pairs is many times what it needs of the points: computed again.
                sums = sums + checkpoint(self._sums, *inputs, first, first + n_rows, use_reentrant=False)
        counts = sums.view(2, 2, 2, 2, self.n_bins, *[self.n_angle_bins] * 3)
        for _ in range(4):
            own, beyond = counts.unbind(0)
            # Beyond the last cell there is nothing to give, so that nothing is rolled over the end.
            counts = own + beyond.roll(1, dims=3)
        return (counts / (n_points * (n_points - 1) / 2)).to(dtype)

    def _sums(self, coordinates: Tensor, points: Tensor, directions: Tensor, first: int, last: int) -> Tensor:
        """(16, cells) weights of the pairs of points from `first` to `last` with those after them.

        By the cell of the lower centres, and by which of the cells next to it, along the four axes, the weight is of.
        """
        distance = torch.cdist(coordinates[first:last], coordinates[first:])
        higher, lower, between = _features(points, directions, first, last)
        towards = self.towards_centres()
        axes = (
            (distance, self.distance_centres()),
            (higher, towards),
            (lower, towards),
            (between, self.between_centres()),
        )
        cell = torch.zeros_like(distance, dtype=torch.long)
        # Pairs of a point with itself or with one before it weigh nothing.
        weights = [torch.ones_like(distance).triu(1)]
        for values, centres in axes:
            along = position(values, centres)
            before = along.detach().long().clamp_(max=len(centres) - 2)
            share = along - before
            cell = cell.mul_(len(centres)).add_(before)
            halves = ((weight, weight * share) for weight in weights)
            # Not weight·(1 − share), nor a difference of sums, which rounding could make negative.
            weights = [part for whole, beyond in halves for part in (whole - beyond, beyond)]
        cell = cell.flatten()
        none = torch.zeros(self.n_cells, dtype=torch.float64, device=cell.device)
        return torch.stack([none.index_add(0, cell, part.double().flatten()) for part in weights])

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
