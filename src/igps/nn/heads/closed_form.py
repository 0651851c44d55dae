"""Heads fitted in closed form: within seconds, deterministically, without learning rates or stopping rules."""

import math
from collections.abc import Sequence
from typing import Self

import torch
from torch import Tensor
from torch.nn import functional

from igps._parameters import check_at_least, check_fraction, check_positive
from igps._tensors import above_zero
from igps.nn.heads.base import (
    Head,
    check_cells,
    check_labels,
    check_parts,
    class_means,
    class_members,
    damped,
    square_roots,
    within_class_whitening,
)
from igps.retrieval.distances import cosine

# With fewer training shapes per class on average, the temperature of the softmax is raised
_MIN_CLASS_SIZE = 6
_MIN_VARIANCE = 1e-8  # smaller variances of distances are rounding errors


class WhitenedHead(Head):
    """Maps histograms to unit vectors, damped along the directions in which shapes of one class differ.

    The square roots of histograms are centred on the training shapes and whitened within classes, see
    `within_class_whitening`. Changes of pose have similar effects on the histograms of all classes, so that this head,
    unlike a head with free parameters, also suits classes that are not in the training set. Before it is fitted, it
    returns the square roots of histograms, normalised to length 1.

    The parts of a `HistogramDescriptor` can be treated separately: each part is whitened and normalised, so that the
    cosine distance is the mean of the distances of the parts.

    A prior is another head for the same descriptions, fitted elsewhere, such as the head of `pretrained`. With a prior,
    the distance is the weighted mean of the head's own distance and the prior's. The parts are then weighted, as not
    all of them distinguish the training classes, by Fisher's discriminant (1936) of pairs, (m − m′) / (v + v′). Here m
    and v are the mean and variance of a part's distances between training shapes of different classes, m′ and v′ those
    between shapes of the same class.

    Example:
        >>> import torch
        >>> histograms = torch.tensor([[0.9, 0.1, 0.0], [0.7, 0.3, 0.0], [0.1, 0.0, 0.9], [0.3, 0.0, 0.7]])
        >>> classes = torch.tensor([0, 0, 1, 1])
        >>> vectors = WhitenedHead().fit(histograms, classes)(histograms)
        >>> (vectors @ vectors.T > 0.5).int().tolist()
        [[1, 1, 0, 0], [1, 1, 0, 0], [0, 0, 1, 1], [0, 0, 1, 1]]

    Args:
        n_directions: number of directions that are damped in each part: those of the largest variance.
        shrinkage: s of the whitening; with a large value, only the centring remains.
        prior: a fitted head, which is not changed; None for no prior.
        prior_share: weight of the prior, between 0 and 1.
    """

    mean: Tensor
    directions: Tensor
    gains: Tensor
    part_cells: Tensor
    part_shares: Tensor
    prior_share: Tensor

    def __init__(
        self,
        n_directions: int = 64,
        shrinkage: float = 0.3,
        prior: Head | None = None,
        prior_share: float = 1 / 3,
    ) -> None:
        super().__init__()
        check_at_least(1, n_directions=n_directions)
        check_positive(shrinkage=shrinkage)
        check_fraction(prior_share=prior_share)
        self.n_directions = n_directions
        self.shrinkage = shrinkage
        self.prior = prior
        self.register_buffer("prior_share", torch.tensor(prior_share))
        self.register_buffer("mean", torch.zeros(0))
        self.register_buffer("directions", torch.zeros(n_directions, 0))
        self.register_buffer("gains", torch.ones(0, n_directions))
        self.register_buffer("part_cells", torch.zeros(0, dtype=torch.long))
        self.register_buffer("part_shares", torch.ones(0))

    @torch.no_grad()
    def fit(
        self, descriptions: Tensor, labels: Tensor, part_cells: Sequence[int] | None = None
    ) -> Self:
        """Fit mean and directions to the training shapes, see `Head.fit`."""
        roots = square_roots(descriptions)
        members = class_members(roots, labels)
        means = class_means(roots, members)
        self.centre(descriptions, part_cells)
        residuals = (roots - means[members]).double()
        rank = len(roots) - len(means)  # the largest that residuals can have
        for part, directions, gains in zip(
            self.parts(residuals), self.parts(self.directions), self.gains, strict=True
        ):
            own_directions, own_gains = within_class_whitening(
                part, rank, self.shrinkage, self.n_directions
            )
            directions[: len(own_directions)] = own_directions
            gains[: len(own_gains)] = own_gains
        if self.prior is not None and len(means) > 1:
            parts = self.whitened_parts(roots)
            discriminants = torch.stack([_discriminant(part, members) for part in parts])
            total = discriminants.sum()
            if total > 0:
                self.part_shares = discriminants / total
        return self

    @torch.no_grad()
    def centre(self, descriptions: Tensor, part_cells: Sequence[int] | None = None) -> Self:
        """Fit only the mean to histograms (N, ...), without damping: for shapes without labels, or one per class."""
        roots = square_roots(descriptions)
        self.part_cells = check_parts(roots, part_cells)
        self._note_buffers()
        n_parts = len(self.part_cells)
        self.mean = roots.mean(dim=0)
        self.directions = roots.new_zeros(self.n_directions, roots.shape[1])
        self.gains = roots.new_ones(n_parts, self.n_directions)
        self.part_shares = roots.new_full((n_parts,), 1 / n_parts)
        return self

    def forward(self, descriptions: Tensor) -> Tensor:
        """Map histograms (N, ...) to embeddings (N, D) of length 1."""
        roots = square_roots(descriptions)
        if len(self.mean):
            lengths = self.part_shares.sqrt()
            parts = zip(lengths, self.whitened_parts(roots), strict=True)
            own = torch.cat([length * part for length, part in parts], dim=1)
        else:
            own = functional.normalize(roots, dim=1)
        if self.prior is None:
            return own
        own_length = (1 - self.prior_share).sqrt()
        prior_length = self.prior_share.sqrt()
        return torch.cat([own_length * own, prior_length * self.prior(descriptions)], dim=1)

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """Return cosine distances (Q, G) of embeddings (Q, D) and (G, D), or their weighted mean with the prior's."""
        if self.prior is None:
            return cosine(queries, gallery)
        if not len(self.mean):
            raise self._not_fitted()
        n_own = len(self.mean)
        own = cosine(queries[:, :n_own], gallery[:, :n_own])
        share = self.prior_share
        length = share.sqrt()  # of the columns by the prior
        by_prior = queries[:, n_own:] / length
        gallery_by_prior = gallery[:, n_own:] / length
        others = self.prior.distances(by_prior, gallery_by_prior)
        return (1 - share) * own + share * others

    def whitened_parts(self, roots: Tensor) -> list[Tensor]:
        """Return the whitened unit vectors (N, cells) of each part, from the square roots (N, D) of histograms."""
        check_cells(roots, len(self.mean))
        centred = self.parts(roots - self.mean)
        directions = self.parts(self.directions)
        whitened = map(damped, centred, directions, self.gains)
        return [functional.normalize(part, dim=1) for part in whitened]

    def parts(self, cells: Tensor) -> tuple[Tensor, ...]:
        """Split values (N, D) into a view for each part."""
        return cells.split(self._noted["part_cells"], dim=1)


class KernelHead(Head):
    """Maps histograms to scores of the training classes, by kernel ridge regression on a `WhitenedHead`.

    The kernel is exp(−d/m), where d is the cosine distance of the whitened histograms and m its median between training
    shapes. With several parts, the kernel is the mean of the kernels of the parts. The targets of the regression are
    the indicators of the classes. A prior (see `WhitenedHead`) adds the kernel of its distance, with weight
    `prior_share`. As that kernel need not be positive definite, eigenvectors with negative eigenvalues are left out
    (Chen, Garcia, Gupta, Rahimi and Cazzanti 2009, "spectrum clip"). This is the library's best head for classes in the
    training set; for others use the `WhitenedHead`.

    An embedding consists of two halves of equal weight: the scores minus their mean, which show how similar a shape is
    to each class, and the square roots of the softmax of the scores, which show its class. With only the second half,
    shapes of one class would coincide.

    Example:
        >>> import torch
        >>> histograms = torch.tensor([[0.9, 0.1, 0.0], [0.7, 0.3, 0.0], [0.1, 0.0, 0.9], [0.3, 0.0, 0.7]])
        >>> classes = torch.tensor([0, 0, 1, 1])
        >>> head = KernelHead().fit(histograms, classes)
        >>> head.predict(torch.tensor([[0.8, 0.1, 0.1]])).tolist()
        [0]

    Args:
        prior: a fitted head, which is not changed; None for no prior. With one training shape per class, which does not
            show how the shapes of a class vary, only the kernel of the prior is used.
        n_directions, shrinkage: of the `WhitenedHead`.
        ridge: added to the kernel's diagonal, which is 1.
        prior_share: weight of the prior's kernel, between 0 and 1.
        temperature: of the softmax; with n < 6 training shapes per class on average, it is multiplied by 6 / n.
    """

    anchors: Tensor
    medians: Tensor
    shares: Tensor
    coefficients: Tensor
    classes: Tensor
    temperature: Tensor

    def __init__(
        self,
        prior: Head | None = None,
        n_directions: int = 64,
        shrinkage: float = 0.3,
        ridge: float = 0.03,
        prior_share: float = 1 / 3,
        temperature: float = 0.05,
    ) -> None:
        super().__init__()
        check_positive(ridge=ridge, temperature=temperature)
        check_fraction(prior_share=prior_share)
        self.whitened = WhitenedHead(n_directions, shrinkage)
        self.prior = prior
        self.ridge = ridge
        self.prior_share = prior_share
        self.register_buffer("temperature", torch.tensor(temperature))
        self.register_buffer("anchors", torch.zeros(0, 0))
        self.register_buffer("medians", torch.ones(0))
        self.register_buffer("shares", torch.ones(0))
        self.register_buffer("coefficients", torch.zeros(0, 0))
        self.register_buffer("classes", torch.zeros(0, dtype=torch.long))

    @torch.no_grad()
    def fit(
        self, descriptions: Tensor, labels: Tensor, part_cells: Sequence[int] | None = None
    ) -> Self:
        """Fit whitening and regression to the training shapes, see `Head.fit`."""
        self.classes, members = check_labels(descriptions, labels).unique(return_inverse=True)
        if len(self.classes) < 2:
            raise ValueError(f"labels: expected at least two classes, got {len(self.classes)}.")
        has_class_variation = len(self.classes) < len(members)
        if has_class_variation:
            self.whitened.fit(descriptions, labels, part_cells)
        else:
            self.whitened.centre(descriptions, part_cells)
        self.anchors = self._vectors(descriptions)
        of_prior = []
        if self.prior is not None:
            of_prior = [self.prior_share if has_class_variation else 1.0]
        n_parts = len(self.whitened.part_cells)
        of_parts = [(1 - sum(of_prior)) / n_parts] * n_parts
        self.shares = self.anchors.new_tensor([*of_parts, *of_prior])
        distances = self._distances(self.anchors)
        is_pair = torch.ones_like(distances[0], dtype=torch.bool).triu(1)
        medians = distances[:, is_pair].median(dim=1).values
        self.medians = above_zero(medians)
        values, vectors = torch.linalg.eigh(self._kernel(self.anchors).double())
        inverse = 1 / (values + self.ridge)
        factors = torch.where(values > 0, inverse, 0)
        targets = functional.one_hot(members, len(self.classes)).double()
        # Contiguous as after loading from a file, so that products with them are rounded in the same way.
        solution = vectors * factors @ (vectors.T @ targets)
        self.coefficients = solution.to(self.anchors.dtype).contiguous()
        return self

    def scores(self, descriptions: Tensor) -> Tensor:
        """Return scores (N, n_classes) of histograms (N, ...): about 1 for the class of a shape, 0 for others."""
        if not len(self.anchors):
            raise self._not_fitted()
        kernel = self._kernel(self._vectors(descriptions))
        return kernel @ self.coefficients.to(kernel.dtype)

    def predict(self, descriptions: Tensor) -> Tensor:
        """Return the predicted classes (N,) of histograms (N, ...), with the labels given to `fit`."""
        return self.classes[self.scores(descriptions).argmax(dim=1)]

    def forward(self, descriptions: Tensor) -> Tensor:
        """Map histograms (N, ...) to embeddings (N, 2 n_classes) of length 1."""
        scores = self.scores(descriptions)
        similarity = functional.normalize(scores - 1 / len(self.classes), dim=1)
        # With few shapes per class, the scores of other classes are nearly as large, so the temperature is raised.
        class_size = len(self.anchors) / len(self.classes)
        temperature = self.temperature * max(1, _MIN_CLASS_SIZE / class_size)
        class_roots = (scores / temperature).softmax(dim=1).sqrt()
        return torch.cat([similarity, class_roots], dim=1) / math.sqrt(2)

    def _kernel(self, vectors: Tensor) -> Tensor:
        relative = self._distances(vectors) / self.medians[:, None, None]
        kernels = (-relative).exp()
        return torch.einsum("k,kij->ij", self.shares.to(kernels.dtype), kernels)

    def _vectors(self, descriptions: Tensor) -> Tensor:
        """Return the unit vectors of the parts and of the prior, concatenated."""
        parts = self.whitened.whitened_parts(square_roots(descriptions))
        if self.prior is not None:
            parts.append(self.prior(descriptions))
        return torch.cat(parts, dim=1)

    def _distances(self, vectors: Tensor) -> Tensor:
        """Return distances (kernels, N, n_shapes) to the training shapes: cosine for each part, then the prior's."""
        sizes = self.whitened._noted["part_cells"]
        n_prior = vectors.shape[1] - sum(sizes)
        *parts, by_prior = vectors.split([*sizes, n_prior], dim=1)
        anchors = self.anchors.to(vectors.dtype)
        *anchor_parts, anchors_by_prior = anchors.split([*sizes, n_prior], dim=1)
        distances = [1 - part @ own.T for part, own in zip(parts, anchor_parts, strict=True)]
        if self.prior is not None:
            distances.append(self.prior.distances(by_prior, anchors_by_prior))
        return torch.stack(distances)


def _discriminant(vectors: Tensor, members: Tensor) -> Tensor:
    """Return the discriminant (Fisher 1936) ≥ 0 between cosine distances of unit vectors within and between classes."""
    distances = 1 - vectors @ vectors.T
    is_same = members[:, None] == members
    between = distances[~is_same]
    within = distances[is_same.fill_diagonal_(False)]
    variance = within.var(correction=0) + between.var(correction=0)
    difference = between.mean() - within.mean()
    return (difference / variance.clamp_min(_MIN_VARIANCE)).clamp_min(0)
