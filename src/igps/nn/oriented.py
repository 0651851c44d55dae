"""Histograms of point pair features: how two samples lie to each other and to the surface next to them."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.checkpoint import checkpoint

from igps.nn.bins import OrderedCentres, middles, position


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
    length = torch.cdist(points, points, compute_mode="donot_use_mm_for_euclid_dist")[i, j]
    reach = directions @ points.T
    own = reach.diagonal()
    length = length.clamp_min(torch.finfo(length.dtype).tiny)
    towards_j = ((reach[i, j] - own[i]) / length).clamp(-1, 1)
    towards_i = ((reach[j, i] - own[j]) / length).clamp(-1, 1)
    return torch.maximum(towards_j, towards_i), torch.minimum(towards_j, towards_i), (directions @ directions.T)[i, j]


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
            # The numbers of all pairs are many times those of the points: one shape's at a time.
            histograms.append(checkpoint(self._histogram, *inputs, use_reentrant=False))
        return torch.stack(histograms)

    def _histogram(self, coordinates: Tensor, points: Tensor, directions: Tensor) -> Tensor:
        dtype = torch.promote_types(coordinates.dtype, torch.float32)
        coordinates, points, directions = (values.to(dtype) for values in (coordinates, points, directions))
        with torch.autocast(points.device.type, enabled=False):
            i, j = torch.triu_indices(len(points), len(points), 1, device=points.device)
            distance = torch.cdist(coordinates, coordinates)[i, j]
            first, second, between = point_pair_features(points, directions)
            towards = self.towards_centres()
            axes = [
                (distance, self.distance_centres()),
                (first, towards),
                (second, towards),
                (between, self.between_centres()),
            ]
            # The cell of the lower centres, and how the weight of a pair is shared among it and the cells next to it.
            cell = torch.zeros_like(i)
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
                # The last centre but one is the lower one at most, so that nothing is rolled over the end.
                counts = counts + added.roll(offset)
            shape = (self.n_bins, *[self.n_angle_bins] * 3)
            return (counts / len(distance)).to(distance.dtype).view(shape)

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
