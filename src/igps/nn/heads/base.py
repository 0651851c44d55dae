"""What a head is, and the mathematics that several share: class means, principal directions, whitening."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, Self

import torch
from torch import Tensor

from igps.nn.specification import Specified
from igps.retrieval.distances import cosine, square_root

# Of the largest sum of squares: directions along which less is left are rounding
_NOTHING_LEFT = 1e-10


class Head(Specified, ABC):
    """Descriptions to embeddings of length 1, and the distance that compares embeddings.

    A head of your own defines `fit` and `forward`, and `distances` where the cosine distance is not its own. Its
    buffers take their sizes from what it is fitted to, also when it is loaded. One that must be fitted before it is
    used raises a RuntimeError.
    """

    @abstractmethod
    def fit(self, descriptions: Tensor, labels: Tensor, part_cells: Sequence[int] | None = None) -> Self:
        """Take from training shapes what is not learned by gradients.

        Args:
            descriptions: (N, ...), histograms for all heads of the library.
            labels: (N,) classes, integers.
            part_cells: cells of each part of a description, see `HistogramDescriptor.part_cells`; None takes all as one
                part.

        Raises:
            ValueError: shapes that do not match, or too few classes, or shapes of a class.
        """

    @abstractmethod
    def forward(self, descriptions: Tensor) -> Tensor:
        """(N, ...) descriptions to (N, D) embeddings of length 1."""

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, D) and (G, D) embeddings, as `forward` gives them, to (Q, G) distances; the cosine's unless redefined."""
        return cosine(queries, gallery)

    def within_class(self, embeddings: Tensor) -> Tensor:
        """(N, ≤ D) the numbers of (N, D) embeddings that tell bodies of one class apart; all, unless redefined."""
        return embeddings

    def short(self, embeddings: Tensor) -> Tensor:
        """(N, D) embeddings to (N, ≤ 256) of length 1 whose cosines are nearly theirs; a ValueError if it has none."""
        raise ValueError(
            f"short: expected a head that shortens its embeddings, as the TwoLevelHead of pretrained does, got "
            f"{type(self).__name__} and embeddings of {embeddings.shape[1]} numbers."
        )

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *arguments: Any) -> None:
        for name, buffer in self.named_buffers(recurse=False):
            stored = state_dict.get(prefix + name)
            if stored is not None and stored.shape != buffer.shape and stored.ndim == buffer.ndim:
                setattr(self, name, buffer.new_zeros(stored.shape))
        super()._load_from_state_dict(state_dict, prefix, *arguments)
        self._note_buffers()

    def _note_buffers(self) -> None:
        """Keep as numbers what buffers say of sizes: on a device to read them waits, and what is traced cannot."""
        buffers = self.named_buffers(recurse=False)
        # In a dictionary, which is no part of a fingerprint
        self._noted: dict[str, Any] = {name: one.tolist() for name, one in buffers if name in ("part_cells", "lengths")}

    def _not_fitted(self) -> RuntimeError:
        return RuntimeError(f"{type(self).__name__}: expected to be fitted first. Call fit(descriptions, labels).")


def square_roots(histograms: Tensor) -> Tensor:
    """(N, cells) roots of the cells of histograms (N, ...), with a finite gradient; a ValueError of one below zero."""
    cells = histograms.flatten(1)
    if not torch.compiler.is_compiling() and bool((cells < 0).any()):
        raise ValueError("descriptions: expected histograms, entries ≥ 0, got a negative one.")
    return square_root(cells)


def check_cells(cells: Tensor, n_expected: int) -> None:
    """Raise a ValueError unless these (N, cells) are as many as the head was fitted to."""
    if cells.shape[1] != n_expected:
        raise ValueError(f"descriptions: expected {n_expected} cells as in training, got {cells.shape[1]}.")


def checked_parts(cells: Tensor, part_cells: Sequence[int] | None) -> Tensor:
    """(parts,) how many of (N, cells) values each part has, one part if None; a ValueError if they do not add up."""
    found = list(part_cells or (cells.shape[1],))
    if min(found) < 1 or sum(found) != cells.shape[1]:
        raise ValueError(f"part_cells: expected cells that add up to {cells.shape[1]}, got {found}.")
    return torch.tensor(found, device=cells.device)


def checked_labels(descriptions: Tensor, labels: Tensor) -> Tensor:
    """The labels (N,) on the device of the descriptions (N, ...); raises a ValueError if they are not aligned."""
    if labels.shape != descriptions.shape[:1]:
        raise ValueError(
            f"labels: expected one for each of {len(descriptions)} descriptions, got shape {tuple(labels.shape)}."
        )
    return labels.to(descriptions.device)


def class_members(descriptions: Tensor, labels: Tensor) -> Tensor:
    """The classes (N,) of descriptions (N, ...), numbered from 0; a ValueError if not aligned, or all are single."""
    _, members = checked_labels(descriptions, labels).unique(return_inverse=True)
    if int(members.max()) + 1 == len(members):
        raise ValueError("labels: expected a class of at least two shapes, got as many classes as shapes.")
    return members


def class_means(rows: Tensor, members: Tensor) -> Tensor:
    """(C, D) means of rows (N, D) by their classes (N,), numbered from 0 without a gap."""
    n_members = torch.bincount(members)
    return rows.new_zeros(len(n_members), rows.shape[1]).index_add_(0, members, rows) / n_members[:, None]


def principal_directions(rows: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """The n orthonormal directions along which rows (N, D) differ most from the origin, and the sums of their squares.

    They are (k, D) and (k,), the largest first; k ≤ n, as directions without extent are left out.
    """
    n_rows, width = rows.shape
    wide = width > n_rows
    squares, axes = torch.linalg.eigh(rows @ rows.T if wide else rows.T @ rows)  # from the smaller matrix
    n = min(n, int((squares > _NOTHING_LEFT * squares[-1]).sum()))
    squares, axes = squares.flip(0)[:n], axes.flip(1)[:, :n]
    return (axes.T @ rows) / squares.sqrt()[:, None] if wide else axes.T, squares


def within_class_whitening(residuals: Tensor, rank: int, shrinkage: float, n: int) -> tuple[Tensor, Tensor]:
    """The directions along which shapes of one class differ most, and what is left of each: see `damped`.

    With W the covariance within classes over its mean eigenvalue, and s the shrinkage, (W + s·I)^(−1/2) is, up to a
    factor, the identity but for a gain along each eigenvector of W. Source: within-class covariance normalisation,
    Hatch, Kajarekar and Stolcke 2006.

    Of residuals (N, D), rows of the training shapes less the mean of their class, these are at most n orthonormal
    directions (k, D), of the largest eigenvalues, and gains (k,) in (0, 1]. The mean is taken over `rank` eigenvalues.
    """
    directions, squares = principal_directions(residuals, min(n, rank))
    relative = squares * rank / residuals.square().sum()
    return directions, (shrinkage / (shrinkage + relative)).sqrt()


def damped(rows: Tensor, directions: Tensor, gains: Tensor) -> Tensor:
    """(N, D) rows with what they have of each direction (k, D), orthonormal, times its gain (k,)."""
    directions = directions.to(rows.dtype)  # those of a head in half precision
    return rows - ((rows @ directions.T) * (1 - gains)) @ directions
