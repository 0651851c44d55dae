"""The base class of heads, and functions that several heads share: class means, principal directions, whitening."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, Self

import torch
from torch import Tensor

from igps.nn.specification import Specified
from igps.retrieval.distances import cosine, square_root

# Directions with smaller sums of squares, over the largest sum, are rounding errors
_MIN_RELATIVE_SQUARE = 1e-10


class Head(Specified, ABC):
    """A module from descriptions to embeddings of length 1, with a distance between embeddings.

    A head of your own defines `fit` and `forward`, and overrides `distances` if it does not use the cosine distance.
    The sizes of its buffers depend on the training shapes, and are restored on loading. A head that needs fitting
    raises a RuntimeError if it is used unfitted.
    """

    @abstractmethod
    def fit(
        self, descriptions: Tensor, labels: Tensor, part_cells: Sequence[int] | None = None
    ) -> Self:
        """Fit everything that is not trained by gradients to the training shapes.

        Args:
            descriptions: (N, ...), histograms for all heads of the library.
            labels: (N,) classes, integers.
            part_cells: number of cells of each part, see `HistogramDescriptor.part_cells`; None for a single part.

        Raises:
            ValueError: the shapes of tensors do not match, or there are too few classes or shapes in a class.
        """

    @abstractmethod
    def forward(self, descriptions: Tensor) -> Tensor:
        """Map descriptions (N, ...) to embeddings (N, D) of length 1."""

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """Return distances (Q, G) between embeddings (Q, D) and (G, D) of `forward`; by default, cosine distances."""
        return cosine(queries, gallery)

    def within_class(self, embeddings: Tensor) -> Tensor:
        """Return the columns (N, ≤ D) of embeddings (N, D) that distinguish bodies of one class; by default, all."""
        return embeddings

    def compared_within_class(self, embeddings: Tensor) -> Tensor:
        """Return those columns of `within_class` that `distances` compares directly; by default, all of them."""
        return self.within_class(embeddings)

    def shorten(self, embeddings: Tensor) -> Tensor:
        """Map embeddings (N, D) to (N, ≤ 256) of length 1 with nearly the same cosines; by default, a ValueError."""
        got = f"{type(self).__name__} and embeddings of {embeddings.shape[1]} numbers"
        raise ValueError(
            f"shorten: expected a head that shortens its embeddings, such as TwoLevelHead, got {got}."
        )

    def _load_from_state_dict(
        self, state_dict: dict[str, Any], prefix: str, *arguments: Any
    ) -> None:
        for name, buffer in self.named_buffers(recurse=False):
            stored = state_dict.get(prefix + name)
            if stored is not None and stored.shape != buffer.shape and stored.ndim == buffer.ndim:
                setattr(self, name, buffer.new_zeros(stored.shape))
        super()._load_from_state_dict(state_dict, prefix, *arguments)
        self._note_buffers()

    def _note_buffers(self) -> None:
        """Copy `part_cells` and `lengths` to Python: reading buffers of a GPU is slow, and impossible in tracing."""
        buffers = self.named_buffers(recurse=False)
        # A dictionary, as fingerprints ignore dictionaries.
        self._noted: dict[str, Any] = {
            name: x.tolist() for name, x in buffers if name in ("part_cells", "lengths")
        }

    def _not_fitted(self) -> RuntimeError:
        return RuntimeError(
            f"{type(self).__name__}: expected to be fitted first. Call fit(descriptions, labels)."
        )


def square_roots(histograms: Tensor) -> Tensor:
    """Return the square roots (N, cells) of histograms (N, ...), with finite gradients; a ValueError if any is < 0."""
    cells = histograms.flatten(1)
    has_values = not torch.compiler.is_compiling() and cells.device.type != "meta"
    if has_values and bool((cells < 0).any()):
        raise ValueError("descriptions: expected histograms, entries ≥ 0, got a negative one.")
    return square_root(cells)


def check_cells(cells: Tensor, n_expected: int) -> None:
    """Raise a ValueError unless descriptions (N, cells) have as many cells as the training shapes."""
    if cells.shape[1] != n_expected:
        raise ValueError(
            f"descriptions: expected {n_expected} cells as in training, got {cells.shape[1]}."
        )


def check_parts(cells: Tensor, part_cells: Sequence[int] | None) -> Tensor:
    """Return `part_cells` as a tensor, by default one part of all cells; raise a ValueError for a wrong sum."""
    sizes = list(part_cells or (cells.shape[1],))
    if min(sizes) < 1 or sum(sizes) != cells.shape[1]:
        raise ValueError(
            f"part_cells: expected cells that add up to {cells.shape[1]}, got {sizes}."
        )
    return torch.tensor(sizes, device=cells.device)


def check_labels(descriptions: Tensor, labels: Tensor) -> Tensor:
    """Return the labels (N,) on the device of the descriptions (N, ...); raise a ValueError for another shape."""
    n = len(descriptions)
    if labels.shape != (n,):
        raise ValueError(
            f"labels: expected one for each of {n} descriptions, got shape {tuple(labels.shape)}."
        )
    return labels.to(descriptions.device)


def class_members(descriptions: Tensor, labels: Tensor) -> Tensor:
    """Return the classes (N,) of descriptions, numbered from 0; raise a ValueError if no class has two members."""
    _, members = check_labels(descriptions, labels).unique(return_inverse=True)
    if int(members.max()) + 1 == len(members):
        raise ValueError(
            "labels: expected a class of at least two shapes, got as many classes as shapes."
        )
    return members


def class_means(rows: Tensor, members: Tensor) -> Tensor:
    """Return the means (C, D) of rows (N, D) by their classes (N,), which are numbered from 0 without gaps."""
    n_members = torch.bincount(members)
    sums = rows.new_zeros(len(n_members), rows.shape[1]).index_add_(0, members, rows)
    return sums / n_members[:, None]


def principal_directions(rows: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """Return the first k ≤ n principal directions of rows (N, D) about the origin, and the sums of squares along them.

    The directions (k, D) are orthonormal, the sums (k,) descend. Directions without extent are left out.
    """
    n_rows, width = rows.shape
    is_wide = width > n_rows
    smaller = rows @ rows.T if is_wide else rows.T @ rows
    squares, axes = torch.linalg.eigh(smaller)
    has_extent = squares > _MIN_RELATIVE_SQUARE * squares[-1]
    n = min(n, int(has_extent.sum()))
    squares = squares.flip(0)[:n]
    directions = axes.flip(1)[:, :n].T
    if is_wide:
        directions = (directions @ rows) / squares.sqrt()[:, None]
    return directions, squares


def within_class_whitening(
    residuals: Tensor, rank: int, shrinkage: float, n: int
) -> tuple[Tensor, Tensor]:
    """Return the directions along which shapes of one class differ most, and the gains that whiten them, for `damped`.

    Let W be the covariance within classes over its mean eigenvalue, and s the shrinkage. Up to a factor,
    (W + s·I)^(−1/2) is the identity except for a gain along each eigenvector of W (within-class covariance
    normalisation, Hatch, Kajarekar and Stolcke 2006).

    Residuals (N, D) are rows of the training shapes minus the mean of their class. The mean eigenvalue is taken over
    `rank` eigenvalues. Returns k ≤ n orthonormal directions (k, D), of the largest eigenvalues, and gains (k,) ≤ 1.
    """
    directions, squares = principal_directions(residuals, min(n, rank))
    relative = squares * rank / residuals.square().sum()
    gains = shrinkage / (shrinkage + relative)
    return directions, gains.sqrt()


def damped(rows: Tensor, directions: Tensor, gains: Tensor) -> Tensor:
    """Return rows (N, D) whose component along each orthonormal direction (k, D) is multiplied by a gain (k,)."""
    directions = directions.to(rows.dtype)  # the head may be in half precision
    along = rows @ directions.T
    return rows - (along * (1 - gains)) @ directions
