"""Heads fitted in closed form: within seconds, without a choice of step or stop, and the same every time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import torch
from torch import Tensor, nn
from torch.nn import functional

from igps.nn.head import square_roots


class WhitenedHead(nn.Module):
    """Histograms to unit vectors, with the directions damped along which shapes of one class differ.

    The square roots of the histograms are centred on the training shapes and multiplied by (W + s·I)^(−1/2) up to a
    factor, W the covariance within classes over its mean eigenvalue, s the shrinkage (within-class covariance
    normalisation, Hatch, Kajarekar and Stolcke 2006). How poses change a histogram is much the same from class to
    class, so that this metric, unlike a free one, serves classes that were not trained on. As made, it leaves
    histograms as they are but for the root and the length.

    The parts of a `CombinedDescriptor` may be treated one by one: each is whitened and brought to one length, so that
    the cosine distance is the mean of those of the parts.

    Args:
        n_cells: cells of a histogram, over all its dimensions, or of each of its parts; D is as large as all of them.
        n_directions: eigenvectors of W that are kept of each part, the largest.
        shrinkage: s; a large one leaves only the centring.
    """

    mean: Tensor
    directions: Tensor
    gains: Tensor

    def __init__(self, n_cells: int | Sequence[int], n_directions: int = 64, shrinkage: float = 0.3) -> None:
        super().__init__()
        self.part_cells = (n_cells,) if isinstance(n_cells, int) else tuple(n_cells)
        for name, value in (("n_cells", min(self.part_cells, default=0)), ("n_directions", n_directions)):
            if value < 1:
                raise ValueError(f"{name}: expected at least 1, got {value}.")
        if shrinkage <= 0:
            raise ValueError(f"shrinkage: expected a positive number, got {shrinkage}.")
        self.shrinkage = shrinkage
        self.register_buffer("mean", torch.zeros(sum(self.part_cells)))
        self.register_buffer("directions", torch.zeros(n_directions, len(self.mean)))
        self.register_buffer("gains", torch.ones(len(self.part_cells), n_directions))

    @torch.no_grad()
    def fit(self, histograms: Tensor, labels: Tensor) -> Self:
        """Take mean and directions from the histograms (N, ...) and classes (N,) of the training shapes.

        Raises:
            ValueError: shapes that do not match, or no class of two shapes.
        """
        roots = square_roots(histograms, len(self.mean))
        labels = _checked(roots, labels)
        _, members = labels.unique(return_inverse=True)
        n_members = torch.bincount(members)
        if len(roots) == len(n_members):
            raise ValueError("labels: expected a class of at least two shapes, got as many classes as shapes.")
        means = roots.new_zeros(len(n_members), roots.shape[1]).index_add_(0, members, roots) / n_members[:, None]
        self.mean.copy_(roots.mean(dim=0))
        self.directions.zero_()
        self.gains.fill_(1)
        residuals = self.parts((roots - means[members]).double())
        for part, directions, gains in zip(residuals, self.parts(self.directions), self.gains, strict=True):
            self._fit_part(part, len(roots) - len(n_members), directions, gains)
        return self

    def _fit_part(self, residuals: Tensor, rank: int, directions: Tensor, gains: Tensor) -> None:
        # The eigenvectors of the covariance from the smaller Gram matrix: there are fewer shapes than cells.
        spread, vectors = torch.linalg.eigh(residuals @ residuals.T)
        spread, vectors = spread.flip(0).clamp_min(0), vectors.flip(1)
        # What is left of the others is rounding: it has no direction.
        n_kept = min(len(directions), rank, int((spread > 1e-10 * spread[0]).sum()))
        relative = spread[:n_kept] * rank / spread.sum()
        lengths = spread[:n_kept].sqrt()
        directions[:n_kept] = (vectors[:, :n_kept].T @ residuals) / lengths[:, None]
        gains[:n_kept] = (self.shrinkage / (self.shrinkage + relative)).sqrt()

    def forward(self, histograms: Tensor) -> Tensor:
        """(N, ...) histograms to (N, D) of length 1."""
        centred = self.parts(square_roots(histograms, len(self.mean)) - self.mean)
        whitened = [
            part - ((part @ directions.T) * (1 - gains)) @ directions
            for part, directions, gains in zip(centred, self.parts(self.directions), self.gains, strict=True)
        ]
        return torch.cat([functional.normalize(part, dim=1) for part in whitened], dim=1) / len(whitened) ** 0.5

    def parts(self, cells: Tensor) -> tuple[Tensor, ...]:
        """Views of (N, D) values, one of each part."""
        return cells.split(self.part_cells, dim=1)


class KernelHead(nn.Module):
    """Histograms to what they have of each training class, by kernel ridge regression on a `WhitenedHead`.

    The kernel is exp(−d/m), d the cosine distance of the whitened histograms, m its median between training shapes, and
    the mean of such kernels if there are several parts. It is regressed onto the indicators of the classes. The best
    there is here for classes that were trained on; for other classes use the `WhitenedHead`.

    Args:
        n_cells, n_directions, shrinkage: see `WhitenedHead`.
        n_shapes: training shapes.
        n_classes: their classes; D is as large.
        ridge: added to the kernel's diagonal, which is 1.
    """

    anchors: Tensor
    medians: Tensor
    coefficients: Tensor
    classes: Tensor

    def __init__(
        self,
        n_cells: int | Sequence[int],
        n_shapes: int,
        n_classes: int,
        n_directions: int = 64,
        shrinkage: float = 0.3,
        ridge: float = 0.03,
    ) -> None:
        super().__init__()
        if ridge <= 0:
            raise ValueError(f"ridge: expected a positive number, got {ridge}.")
        if n_classes < 2 or n_shapes < n_classes:
            raise ValueError(
                f"n_classes: expected at least 2 and at most n_shapes, got n_classes={n_classes}, n_shapes={n_shapes}."
            )
        self.whitened = WhitenedHead(n_cells, n_directions, shrinkage)
        self.ridge = ridge
        self.register_buffer("anchors", torch.zeros(n_shapes, len(self.whitened.mean)))
        self.register_buffer("medians", torch.ones(len(self.whitened.part_cells)))
        self.register_buffer("coefficients", torch.zeros(n_shapes, n_classes))
        self.register_buffer("classes", torch.arange(n_classes))

    @torch.no_grad()
    def fit(self, histograms: Tensor, labels: Tensor, *, whiten: bool = True) -> Self:
        """Fit whitening and regression to the histograms (N, ...) and classes (N,) of the training shapes.

        Args:
            histograms, labels: of the training shapes.
            whiten: False leaves `whitened` as it is: where labels are few, one fitted to other shapes serves better.

        Raises:
            ValueError: numbers of shapes or classes other than the head was made for.
        """
        if whiten:
            self.whitened.fit(histograms, labels)
        classes, members = labels.to(self.classes.device).unique(return_inverse=True)
        if (len(histograms), len(classes)) != self.coefficients.shape:
            raise ValueError(
                f"histograms, labels: expected {self.coefficients.shape[0]} shapes of {self.coefficients.shape[1]} "
                f"classes, got {len(histograms)} of {len(classes)}."
            )
        self.classes.copy_(classes)
        self.anchors.copy_(self.whitened(histograms))
        i, j = torch.triu_indices(len(self.anchors), len(self.anchors), 1, device=self.anchors.device)
        distances = self._distances(self.anchors)[:, i, j]
        self.medians.copy_(distances.median(dim=1).values.clamp_min(torch.finfo(distances.dtype).tiny))
        kernel = self._kernel(self.anchors).double()
        kernel.diagonal().add_(self.ridge)
        targets = functional.one_hot(members, len(classes)).double()
        self.coefficients.copy_(torch.linalg.solve(kernel, targets))
        return self

    def scores(self, histograms: Tensor) -> Tensor:
        """(N, ...) histograms to (N, n_classes), about 1 for the class that a shape is of and 0 for others."""
        return self._kernel(self.whitened(histograms)) @ self.coefficients

    def predict(self, histograms: Tensor) -> Tensor:
        """(N, ...) histograms to (N,) classes, as they were named in `fit`."""
        return self.classes[self.scores(histograms).argmax(dim=1)]

    def forward(self, histograms: Tensor) -> Tensor:
        """(N, ...) histograms to (N, D) of length 1."""
        return functional.normalize(self.scores(histograms) - 1 / len(self.classes), dim=1)

    def _kernel(self, whitened: Tensor) -> Tensor:
        return (-self._distances(whitened) / self.medians[:, None, None]).exp().mean(dim=0)

    def _distances(self, whitened: Tensor) -> Tensor:
        """(parts, N, n_shapes) cosine distances to the training shapes."""
        parts = zip(self.whitened.parts(whitened), self.whitened.parts(self.anchors), strict=True)
        # The parts of a vector of length 1 have that length together.
        return torch.stack([1 - len(self.medians) * part @ anchors.T for part, anchors in parts])


def _checked(roots: Tensor, labels: Tensor) -> Tensor:
    if labels.shape != roots.shape[:1]:
        raise ValueError(f"labels: expected one for each of {len(roots)} histograms, got shape {tuple(labels.shape)}.")
    return labels.to(roots.device)
