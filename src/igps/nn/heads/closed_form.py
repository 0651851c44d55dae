"""Heads fitted in closed form: within seconds, without a choice of step or stop, and the same every time."""

from collections.abc import Sequence
from typing import Self

import torch
from torch import Tensor
from torch.nn import functional

from igps._parameters import check_at_least, check_positive, check_share
from igps.nn.heads.base import (
    Head,
    check_cells,
    checked_labels,
    checked_parts,
    class_means,
    class_members,
    damped,
    square_roots,
    within_class_whitening,
)
from igps.retrieval.distances import cosine

# With so many training shapes of a class, its scores are trusted in full
_MANY = 6
# Variances of distances below this are rounding
_SMALLEST_VARIANCE = 1e-8


class WhitenedHead(Head):
    """Histograms to unit vectors, damped along the directions in which shapes of one class differ.

    The square roots of histograms are centred on the training shapes and whitened within classes, see
    `within_class_whitening`. How poses change a histogram is much the same from class to class, so that this head,
    unlike one with free parameters, serves classes that were not trained on. Before it is fitted, it gives the roots of
    histograms, brought to length 1.

    The parts of a `HistogramDescriptor` may be treated one by one: each is whitened and brought to one length, so that
    the cosine distance is the mean of those of the parts.

    A prior is another head of the same descriptions, fitted elsewhere, such as that of `pretrained`. Beside one, the
    distance is the weighted mean of its own and the prior's. Of the many parts of such descriptions, not all serve the
    classes at hand. So the parts then count by Fisher's discriminant (1936) of pairs: each distance times
    (m − m′) / (v + v′), m and v its mean and variance between shapes of two training classes, m′ and v′ between those
    of one.

    Example:
        >>> import torch
        >>> histograms = torch.tensor([[0.9, 0.1, 0.0], [0.7, 0.3, 0.0], [0.1, 0.0, 0.9], [0.3, 0.0, 0.7]])
        >>> classes = torch.tensor([0, 0, 1, 1])
        >>> vectors = WhitenedHead().fit(histograms, classes)(histograms)
        >>> (vectors @ vectors.T > 0.5).int().tolist()
        [[1, 1, 0, 0], [1, 1, 0, 0], [0, 0, 1, 1], [0, 0, 1, 1]]

    Args:
        n_directions: directions that are damped in each part, the largest.
        shrinkage: s of the whitening; a large one leaves only the centring.
        prior: a fitted head, which stays as it is; None for no other.
        prior_share: its weight, between 0 and 1.
    """

    mean: Tensor
    directions: Tensor
    gains: Tensor
    part_cells: Tensor
    part_shares: Tensor
    prior_share: Tensor

    def __init__(
        self, n_directions: int = 64, shrinkage: float = 0.3, prior: Head | None = None, prior_share: float = 1 / 3
    ) -> None:
        super().__init__()
        check_at_least(1, n_directions=n_directions)
        check_positive(shrinkage=shrinkage)
        check_share(prior_share=prior_share)
        self.n_directions, self.shrinkage, self.prior = n_directions, shrinkage, prior
        self.register_buffer("prior_share", torch.tensor(prior_share))
        self.register_buffer("mean", torch.zeros(0))
        self.register_buffer("directions", torch.zeros(n_directions, 0))
        self.register_buffer("gains", torch.ones(0, n_directions))
        self.register_buffer("part_cells", torch.zeros(0, dtype=torch.long))
        self.register_buffer("part_shares", torch.ones(0))

    @torch.no_grad()
    def fit(self, descriptions: Tensor, labels: Tensor, part_cells: Sequence[int] | None = None) -> Self:
        """Take mean and directions from the training shapes, see `Head.fit`."""
        roots = square_roots(descriptions)
        members = class_members(roots, labels)
        means = class_means(roots, members)
        self.centre(descriptions, part_cells)
        residuals = self.parts((roots - means[members]).double())
        for part, directions, gains in zip(residuals, self.parts(self.directions), self.gains, strict=True):
            # The mean eigenvalue is that of the N − C that residuals of N shapes of C classes allow.
            rank = len(roots) - len(means)
            kept, left = within_class_whitening(part, rank, self.shrinkage, self.n_directions)
            directions[: len(kept)] = kept
            gains[: len(left)] = left
        if self.prior is not None and len(means) > 1:
            discriminants = torch.stack([_discriminant(part, members) for part in self.whitened_parts(roots)])
            if discriminants.sum() > 0:
                self.part_shares = discriminants / discriminants.sum()
        return self

    @torch.no_grad()
    def centre(self, descriptions: Tensor, part_cells: Sequence[int] | None = None) -> Self:
        """Take the mean alone from histograms (N, ...), and damp nothing: for shapes without labels, or one a class."""
        roots = square_roots(descriptions)
        self.part_cells = checked_parts(roots, part_cells)
        self._note_buffers()
        n_parts = len(self.part_cells)
        self.mean = roots.mean(dim=0)
        self.directions = roots.new_zeros(self.n_directions, roots.shape[1])
        self.gains = roots.new_ones(n_parts, self.n_directions)
        self.part_shares = roots.new_full((n_parts,), 1 / n_parts)
        return self

    def forward(self, descriptions: Tensor) -> Tensor:
        """(N, ...) histograms to (N, D) of length 1."""
        roots = square_roots(descriptions)
        if len(self.mean):
            shares = self.part_shares.sqrt()
            own = torch.cat([n * part for n, part in zip(shares, self.whitened_parts(roots), strict=True)], dim=1)
        else:
            own = functional.normalize(roots, dim=1)
        if self.prior is None:
            return own
        share = self.prior_share
        return torch.cat([(1 - share).sqrt() * own, share.sqrt() * self.prior(descriptions)], dim=1)

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, D) and (G, D) embeddings to (Q, G): the cosine distance, or beside a prior a mean with its own."""
        if self.prior is None:
            return cosine(queries, gallery)
        if not len(self.mean):
            raise self._not_fitted()
        own, priors = zip(*(one.tensor_split([len(self.mean)], dim=1) for one in (queries, gallery)), strict=True)
        of_prior = self.prior.distances(*(one / self.prior_share.sqrt() for one in priors))
        return (1 - self.prior_share) * cosine(*own) + self.prior_share * of_prior

    def whitened_parts(self, roots: Tensor) -> list[Tensor]:
        """Unit vectors (N, cells) of each part, of the square roots (N, D) of histograms."""
        check_cells(roots, len(self.mean))
        of_parts = zip(self.parts(roots - self.mean), self.parts(self.directions), self.gains, strict=True)
        return [functional.normalize(damped(*one), dim=1) for one in of_parts]

    def parts(self, cells: Tensor) -> tuple[Tensor, ...]:
        """Views of (N, D) values, one of each part."""
        return cells.split(self._noted["part_cells"], dim=1)


class KernelHead(Head):
    """Histograms to what they have of each training class, by kernel ridge regression on a `WhitenedHead`.

    The kernel is exp(−d/m), d the cosine distance of the whitened histograms, m its median between training shapes, and
    the mean of such kernels if there are several parts. It is regressed onto the indicators of the classes. Beside a
    prior (see `WhitenedHead`), the kernel of the prior's distance is one more, with a weight of its own. It is the best
    head here for classes that were trained on; for other classes use the `WhitenedHead`.

    An embedding is half the scores about their mean, how much of each class a shape has, and half the roots of their
    softmax, which class it is of: by the latter alone, shapes of one class would coincide.

    Example:
        >>> import torch
        >>> histograms = torch.tensor([[0.9, 0.1, 0.0], [0.7, 0.3, 0.0], [0.1, 0.0, 0.9], [0.3, 0.0, 0.7]])
        >>> classes = torch.tensor([0, 0, 1, 1])
        >>> head = KernelHead().fit(histograms, classes)
        >>> head.predict(torch.tensor([[0.8, 0.1, 0.1]])).tolist()
        [0]

    Args:
        prior: a fitted head, which stays as it is; None for no other. With one training shape of each class, which
            tells nothing of how the shapes of a class vary, its kernel is the only one.
        n_directions, shrinkage: of the `WhitenedHead`.
        ridge: added to the kernel's diagonal, which is 1.
        prior_share: weight of the prior's kernel, between 0 and 1.
        temperature: of the softmax, with six training shapes of a class or more; with n on average, 6 / n of it.
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
        check_share(prior_share=prior_share)
        self.whitened = WhitenedHead(n_directions, shrinkage)
        self.prior, self.ridge, self.prior_share = prior, ridge, prior_share
        self.register_buffer("temperature", torch.tensor(temperature))
        self.register_buffer("anchors", torch.zeros(0, 0))
        self.register_buffer("medians", torch.ones(0))
        self.register_buffer("shares", torch.ones(0))
        self.register_buffer("coefficients", torch.zeros(0, 0))
        self.register_buffer("classes", torch.zeros(0, dtype=torch.long))

    @torch.no_grad()
    def fit(self, descriptions: Tensor, labels: Tensor, part_cells: Sequence[int] | None = None) -> Self:
        """Fit whitening and regression to the training shapes, see `Head.fit`."""
        self.classes, members = checked_labels(descriptions, labels).unique(return_inverse=True)
        if len(self.classes) < 2:
            raise ValueError(f"labels: expected at least two classes, got {len(self.classes)}.")
        several = len(self.classes) < len(members)
        if several:
            self.whitened.fit(descriptions, labels, part_cells)
        else:
            self.whitened.centre(descriptions, part_cells)
        self.anchors = self._vectors(descriptions)
        n_parts = len(self.whitened.part_cells)
        share = 0.0 if self.prior is None else self.prior_share if several else 1.0
        shares = [(1 - share) / n_parts] * n_parts + ([] if self.prior is None else [share])
        self.shares = self.anchors.new_tensor(shares)
        i, j = torch.triu_indices(len(self.anchors), len(self.anchors), 1, device=self.anchors.device)
        distances = self._distances(self.anchors)[:, i, j]
        self.medians = distances.median(dim=1).values.clamp_min(torch.finfo(distances.dtype).tiny)
        kernel = self._kernel(self.anchors).double()
        kernel.diagonal().add_(self.ridge)
        targets = functional.one_hot(members, len(self.classes)).double()
        # As they lie in memory when loaded, so that products with them round alike
        self.coefficients = torch.linalg.solve(kernel, targets).to(self.anchors.dtype).contiguous()
        return self

    def scores(self, descriptions: Tensor) -> Tensor:
        """(N, ...) histograms to (N, n_classes), about 1 for the class that a shape is of and 0 for others."""
        if not len(self.anchors):
            raise self._not_fitted()
        kernel = self._kernel(self._vectors(descriptions))
        return kernel @ self.coefficients.to(kernel.dtype)

    def predict(self, descriptions: Tensor) -> Tensor:
        """(N, ...) histograms to (N,) classes, as they were named in `fit`."""
        return self.classes[self.scores(descriptions).argmax(dim=1)]

    def forward(self, descriptions: Tensor) -> Tensor:
        """(N, ...) histograms to (N, 2 n_classes) of length 1."""
        scores = self.scores(descriptions)
        of_each = functional.normalize(scores - 1 / len(self.classes), dim=1)
        # Few shapes of a class leave scores of other classes that are nearly as large
        n_of_each = len(self.anchors) / len(self.classes)
        likely = (scores / (self.temperature * max(1, _MANY / n_of_each))).softmax(dim=1).sqrt()
        return torch.cat([of_each, likely], dim=1) / 2**0.5

    def _kernel(self, vectors: Tensor) -> Tensor:
        kernels = (-self._distances(vectors) / self.medians[:, None, None]).exp()
        return torch.einsum("k,kij->ij", self.shares.to(kernels.dtype), kernels)

    def _vectors(self, descriptions: Tensor) -> Tensor:
        """Unit vectors of the parts and of the prior, side by side."""
        own = self.whitened.whitened_parts(square_roots(descriptions))
        return torch.cat(own if self.prior is None else [*own, self.prior(descriptions)], dim=1)

    def _distances(self, vectors: Tensor) -> Tensor:
        """(kernels, N, n_shapes) distances to the training shapes: cosine's of the parts, and the prior's own."""
        sizes, both = self.whitened._noted["part_cells"], (vectors, self.anchors.to(vectors.dtype))
        split = [one.split([*sizes, one.shape[1] - sum(sizes)], dim=1) for one in both]
        found = [1 - one @ other.T for one, other in list(zip(*split, strict=True))[: len(sizes)]]
        if self.prior is not None:
            found.append(self.prior.distances(split[0][-1], split[1][-1]))
        return torch.stack(found)


def _discriminant(vectors: Tensor, members: Tensor) -> Tensor:
    """How well cosine distances of unit vectors (N, D) tell pairs of one class (N,) from others, ≥ 0 (Fisher 1936)."""
    distances = 1 - vectors @ vectors.T
    alike = members[:, None] == members
    far, near = distances[~alike], distances[alike.fill_diagonal_(False)]
    variance = near.var(correction=0) + far.var(correction=0)
    return ((far.mean() - near.mean()) / variance.clamp_min(_SMALLEST_VARIANCE)).clamp_min(0)
