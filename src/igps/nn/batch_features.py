"""Features of a batch that several histograms share, such as embeddings and positions; each is computed once."""

import torch
from torch import Tensor, nn
from torch.nn import functional

from igps._tensors import above_zero
from igps.data.batch import SampleBatch, SignatureBatch
from igps.nn._kernels.batches import map_bodies
from igps.nn._kernels.neighbours import ball_radii, smallest
from igps.nn._precision import full_precision
from igps.nn.embedding import barycentroid_potential
from igps.signature.signature import SampleKind

WEIGHT = "weight"
"""Name of the attribute with the weights of samples in histograms; by default, all samples have equal weights."""

_FAR_AWAY = 1e18  # coordinates of padded targets: beyond any real target, with a square that does not overflow
_N_NEAREST = 8  # targets whose mean gives the direction to the surface in the embedding
# Neighbours in graphs of samples. 12 or more make no difference; with 8, limbs fall apart where samples are sparse.
N_NEIGHBOURS = 16


class SampleFeatures:
    """Features of the samples of one kind, all of them or a subset; each feature is computed once."""

    def __init__(self, batch: SignatureBatch, kind: SampleKind, samples: SampleBatch) -> None:
        self.batch = batch
        self.kind = kind
        self.samples = samples
        self._embedded: dict[nn.Module, Tensor] = {}
        self._ball_radii: Tensor | None = None
        self._neighbours: dict[nn.Module, Tensor] = {}

    def embedded(self, embedding: nn.Module) -> Tensor:
        """Return the embedding (N, P, D) of the samples."""
        if embedding not in self._embedded:
            self._embedded[embedding] = embedding(
                self.samples.eigenfunctions, self.batch.eigenvalues, self.batch.area
            )
        return self._embedded[embedding]

    def positions(self) -> Tensor:
        """Return the positions (N, P, 3) of the samples in units of √area."""
        points = _at_least_single(self.samples.points)
        unit = self.batch.area.sqrt().to(points.dtype)
        return points / unit[:, None, None]

    def attribute(self, name: str) -> Tensor:
        """Return an attribute (N, P) or (N, P, 3) of the samples; raise a ValueError if it is missing."""
        if name not in self.samples.attributes:
            raise ValueError(
                f"attributes: expected the {self.kind} samples to have {name!r}, got "
                f"{sorted(self.samples.attributes)}. Name it in SignatureConfig(attributes=...), or give its function "
                "to SignatureDataset(attributes=...)."
            )
        return _at_least_single(self.samples.attributes[name])

    def weights(self) -> Tensor | None:
        """Return the weights (N, P) of the samples, or None if all are equal."""
        return self.samples.attributes.get(WEIGHT)

    def weights_or_ones(self, values: Tensor) -> Tensor:
        """Return the weights (N, P) of the samples, or ones like `values` (N, P) if all are equal."""
        weights = self.weights()
        return torch.ones_like(values) if weights is None else weights

    def ball_radii(self) -> Tensor:
        """Return the `ball_radii` (N, P, 2) of surface samples with directions, over √area; 1 where padded."""
        if self._ball_radii is None:
            self._ball_radii = ball_radii(
                self.positions(), self.attribute("surface_direction"), self.samples.mask
            )
        return self._ball_radii

    def log_potential(self, embedding: nn.Module) -> Tensor:
        """Return the logarithm (N, P) of the barycentroid potential."""
        potential = barycentroid_potential(self.embedded(embedding))
        return above_zero(potential).log()

    def neighbours(self, embedding: nn.Module) -> Tensor:
        """Return the `nearest_neighbours` (N, P, k) of each sample in the embedding."""
        if embedding not in self._neighbours:
            points = self.embedded(embedding)
            mask = self.samples.mask
            self._neighbours[embedding] = map_bodies(nearest_neighbours, points, mask)
        return self._neighbours[embedding]

    def embedded_directions(self, embedding: nn.Module) -> Tensor:
        """Return unit vectors (N, P, D), in the embedding, towards the surface or, at surface samples, out of it."""
        is_inside = self.kind == "interior"
        other = self.batch.surface if is_inside else self.batch.interior
        targets = embedding(other.eigenfunctions, self.batch.eigenvalues, self.batch.area)
        inward = map_bodies(nearest_directions, self.embedded(embedding), targets, other.mask)
        return inward if is_inside else -inward


class BatchFeatures:
    """A batch with the `SampleFeatures` of each kind and number of samples, shared by the parts of a descriptor.

    In training mode, subsets of samples are drawn at random; otherwise a subset is always the same.
    """

    def __init__(self, batch: SignatureBatch, training: bool) -> None:
        self.batch = batch
        self._training = training
        self._features: dict[tuple[SampleKind, int | None, bool], SampleFeatures] = {}

    def of(
        self, kind: SampleKind, n_samples: int | None, n_training_samples: int | None
    ) -> SampleFeatures:
        """Return features of `n_samples` samples at most (None: all), or of `n_training_samples` drawn in training."""
        is_random = self._training and n_training_samples is not None
        max_samples = n_training_samples if is_random else n_samples
        key = (kind, max_samples, is_random)
        if key not in self._features:
            samples = self.batch.interior if kind == "interior" else self.batch.surface
            if max_samples is not None:
                samples = samples.subset(max_samples, seed=None if is_random else 0)
            self._features[key] = SampleFeatures(self.batch, kind, samples)
        return self._features[key]


def _at_least_single(values: Tensor) -> Tensor:
    # Few operations of PyTorch support half precision.
    return values.to(torch.promote_types(values.dtype, torch.float32))


def nearest_directions(
    points: Tensor, targets: Tensor, mask: Tensor, n_nearest: int = _N_NEAREST
) -> Tensor:
    """Return unit vectors (..., P, D) from points to the mean of the nearest targets (..., T, D) in the mask (..., T).

    All targets are averaged if there are fewer than `n_nearest`. If the mean is the point itself, the vector is zero.
    """
    with full_precision():
        real = targets.detach().masked_fill(~mask.unsqueeze(-1), _FAR_AWAY)
        distances = torch.cdist(points.detach(), real)
    nearest, indices = smallest(distances, min(n_nearest, mask.shape[-1]))
    is_real = (nearest < _FAR_AWAY).unsqueeze(-1)
    rows = indices.flatten(-2).unsqueeze(-1)
    rows = rows.expand(*rows.shape[:-1], points.shape[-1])
    neighbours = targets.gather(-2, rows).unflatten(-2, indices.shape[-2:])
    sums = torch.where(is_real, neighbours, 0).sum(dim=-2)
    mean = sums / is_real.sum(dim=-2)
    return functional.normalize(mean - points, dim=-1)


def nearest_neighbours(
    points: Tensor, mask: Tensor | None = None, n_nearest: int = N_NEIGHBOURS
) -> Tensor:
    """Return the indices (..., P, k) of the nearest other points to each of points (..., P, D), nearest first.

    Only points in the mask (..., P), by default all, are neighbours. If a point has fewer than k neighbours, its own
    index fills the remaining places. Raises a ValueError if there is no point.
    """
    n_points = points.shape[-2]
    if not n_points:
        raise ValueError("samples: expected at least one of each body, got none.")
    points = points.detach()
    with full_precision():
        distances = torch.cdist(points, points, compute_mode="use_mm_for_euclid_dist")
    distances.diagonal(dim1=-2, dim2=-1).fill_(torch.inf)
    if mask is not None:
        distances.masked_fill_(~mask.unsqueeze(-2), torch.inf)
    nearest, indices = smallest(distances, min(n_nearest, n_points - 1))
    own = torch.arange(n_points, device=points.device)
    return torch.where(nearest < torch.inf, indices, own[:, None])
