"""Features of a batch that histograms share: embeddings, positions, attributes, each computed once."""

import torch
from torch import Tensor, nn
from torch.nn import functional

from igps.data.batch import SampleBatch, SignatureBatch
from igps.nn._kernels.balls import ball_radii
from igps.nn._kernels.blocks import of_bodies
from igps.nn._kernels.nearest import smallest
from igps.nn._precision import full_precision
from igps.nn.embedding import barycentroid_potential
from igps.retrieval.distances import row_distances
from igps.signature.signature import SampleKind

WEIGHT = "weight"
"""An attribute of samples: how much each counts in histograms, all alike where there is none."""

# The place of padded targets: farther than any real one, with a square that does not overflow.
_FAR = 1e18
# For the direction to the surface in the embedding.
_N_NEAREST = 8
# For graphs of samples: with 12 or more it makes no difference, with 8 limbs fall apart where samples are sparse.
N_NEIGHBOURS = 16


class SampleFeatures:
    """All samples of a kind of each shape, or a subset, and what is computed from them, each once."""

    def __init__(self, batch: SignatureBatch, kind: SampleKind, samples: SampleBatch) -> None:
        self.batch = batch
        self.kind = kind
        self.samples = samples
        self._embedded: dict[nn.Module, Tensor] = {}
        self._ball_radii: Tensor | None = None
        self._neighbours: dict[nn.Module, Tensor] = {}

    def embedded(self, embedding: nn.Module) -> Tensor:
        """(N, P, D) embedding of the samples."""
        if embedding not in self._embedded:
            self._embedded[embedding] = embedding(self.samples.eigenfunctions, self.batch.eigenvalues, self.batch.area)
        return self._embedded[embedding]

    def positions(self) -> Tensor:
        """(N, P, 3) of the samples in units of √area."""
        points = _single(self.samples.points)
        return points / self.batch.area.sqrt().to(points.dtype)[:, None, None]

    def attribute(self, name: str) -> Tensor:
        """(N, P) or (N, P, 3) of the samples; a ValueError if they have no such attribute."""
        if name not in self.samples.attributes:
            raise ValueError(
                f"attributes: expected {name!r} among those of the {self.kind} samples, got "
                f"{sorted(self.samples.attributes)}. Name it in SignatureConfig(attributes=...), or give its function "
                "to SignatureDataset(attributes=...)."
            )
        return _single(self.samples.attributes[name])

    def weights(self) -> Tensor | None:
        """(N, P) how much each sample counts, None where all count alike; derivatives by them tell shares."""
        return self.samples.attributes.get(WEIGHT)

    def weights_or_ones(self, values: Tensor) -> Tensor:
        """(N, P) how much each sample counts, in the type of some values (N, P) where all count alike."""
        weights = self.weights()
        return torch.ones_like(values) if weights is None else weights

    def ball_radii(self) -> Tensor:
        """(N, P, 2) `ball_radii` of surface samples that have directions, over √area; 1 where padded."""
        if self._ball_radii is None:
            self._ball_radii = ball_radii(self.positions(), self.attribute("surface_direction"), self.samples.mask)
        return self._ball_radii

    def log_potential(self, embedding: nn.Module) -> Tensor:
        """(N, P) logarithms of the barycentroid potential."""
        potential = barycentroid_potential(self.embedded(embedding))
        return potential.clamp_min(torch.finfo(potential.dtype).tiny).log()

    def neighbours(self, embedding: nn.Module) -> Tensor:
        """(N, P, k) of each shape the other samples that are nearest to each in the embedding, see their function."""
        if embedding not in self._neighbours:
            asked = self.embedded(embedding), self.samples.mask
            self._neighbours[embedding] = of_bodies(lambda one, real: nearest_neighbours(one, mask=real), *asked)
        return self._neighbours[embedding]

    def embedded_directions(self, embedding: nn.Module) -> Tensor:
        """(N, P, D) unit vectors from interior samples to the surface in the embedding, or out of it on the surface."""
        other, outward = (self.batch.surface, 1) if self.kind == "interior" else (self.batch.interior, -1)
        targets = embedding(other.eigenfunctions, self.batch.eigenvalues, self.batch.area)
        return outward * of_bodies(nearest_directions, self.embedded(embedding), targets, other.mask)


class BatchFeatures:
    """A batch with the `SampleFeatures` of each kind and number of samples, shared by the parts of a descriptor.

    In training, subsets of samples are drawn anew; otherwise a subset is always the same.
    """

    def __init__(self, batch: SignatureBatch, training: bool) -> None:
        self.batch = batch
        self._training = training
        self._features: dict[tuple[SampleKind, int | None, bool], SampleFeatures] = {}

    def of(self, kind: SampleKind, n_samples: int | None, n_training_samples: int | None) -> SampleFeatures:
        """Those of at most `n_samples`, in training of `n_training_samples` drawn at random; None takes all."""
        drawn = self._training and n_training_samples is not None
        n_wanted = n_training_samples if drawn else n_samples
        key = (kind, n_wanted, drawn)
        if key not in self._features:
            samples = self.batch.interior if kind == "interior" else self.batch.surface
            if n_wanted is not None:
                samples = samples.subset(n_wanted, seed=None if drawn else 0)
            self._features[key] = SampleFeatures(self.batch, kind, samples)
        return self._features[key]


def _single(values: Tensor) -> Tensor:
    """In single precision at least: few operations take less."""
    return values.to(torch.promote_types(values.dtype, torch.float32))


def nearest_directions(points: Tensor, targets: Tensor, mask: Tensor, n_nearest: int = _N_NEAREST) -> Tensor:
    """(..., P, D) unit vectors from points to the mean of the nearest of targets (..., T, D), of the mask alone.

    Zero where the mean is the point itself; of all targets where there are fewer.
    """
    with full_precision():
        real = targets.detach().masked_fill(~mask.unsqueeze(-1), _FAR)
        distances = row_distances(points.detach(), real, "use_mm_for_euclid_dist_if_necessary")
    nearest, which = smallest(distances, min(n_nearest, mask.shape[-1]))
    found = (nearest < _FAR).unsqueeze(-1)
    rows = which.flatten(-2).unsqueeze(-1).expand(*which.shape[:-2], -1, points.shape[-1])
    taken = targets.gather(-2, rows).unflatten(-2, which.shape[-2:])
    mean = torch.where(found, taken, 0).sum(dim=-2) / found.sum(dim=-2)
    return functional.normalize(mean - points, dim=-1)


def nearest_neighbours(points: Tensor, n_nearest: int = N_NEIGHBOURS, mask: Tensor | None = None) -> Tensor:
    """(..., P, k) the others nearest to each of points (..., P, D), of the mask alone if there is one, nearest first.

    A point has itself for those that it lacks. A ValueError if there is no point.
    """
    if not (n_points := points.shape[-2]):
        raise ValueError("samples: expected at least one of each body, got none.")
    with full_precision():
        squares = row_distances(points.detach(), points.detach(), "use_mm_for_euclid_dist")
    squares.diagonal(dim1=-2, dim2=-1).fill_(torch.inf)
    if mask is not None:
        squares.masked_fill_(~mask.unsqueeze(-2), torch.inf)
    nearest, which = smallest(squares, min(n_nearest, n_points - 1))
    return torch.where(nearest < torch.inf, which, torch.arange(n_points, device=points.device)[:, None])
