"""What all heads share: they turn descriptions into unit vectors, and take their sizes from what they are fitted to."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, Self, runtime_checkable

import torch
from torch import Tensor, nn

from igps.retrieval.distances import Distance, cosine, square_root


@runtime_checkable
class Head(Protocol):
    """Descriptions to unit vectors, whose cosine distance is a metric."""

    def fit(self, descriptions: Tensor, labels: Tensor, part_cells: Sequence[int] | None = None) -> Self:
        """Take from the descriptions (N, ...) and classes (N,) of training shapes what is not learned by gradients.

        `part_cells` tells the cells of the parts that a description consists of; None takes all as one part.
        """
        ...

    def __call__(self, descriptions: Tensor) -> Tensor:
        """(N, ...) descriptions to (N, D) of length 1."""
        ...


def distances_of(head: object) -> Distance:
    """The distance of a head's vectors: its own, if it has one, or the cosine's."""
    own: Distance = getattr(head, "distances", cosine)
    return own


class SizedByData(nn.Module):
    """A module whose buffers have the size of the data that it was fitted to, also when it is loaded."""

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *arguments: Any) -> None:
        for name, buffer in self.named_buffers(recurse=False):
            stored = state_dict.get(prefix + name)
            if stored is not None and stored.shape != buffer.shape:
                setattr(self, name, buffer.new_zeros(stored.shape))
        super()._load_from_state_dict(state_dict, prefix, *arguments)


def square_roots(histograms: Tensor) -> Tensor:
    """(N, ...) histograms to the (N, cells) square roots of their cells, unit vectors with a finite gradient.

    Raises:
        ValueError: an entry below zero, as embeddings have.
    """
    cells = histograms.flatten(1)
    if bool((cells < 0).any()):
        raise ValueError("descriptions: expected histograms, entries ≥ 0, got a negative one.")
    return square_root(cells)


def check_cells(cells: Tensor, n_expected: int) -> None:
    """Raise a ValueError unless these (N, cells) are as many as the head was fitted to."""
    if cells.shape[1] != n_expected:
        raise ValueError(f"descriptions: expected {n_expected} cells as in training, got {cells.shape[1]}.")


def check_share(prior_share: float) -> None:
    """Raise a ValueError unless it is between 0 and 1."""
    if not 0 < prior_share < 1:
        raise ValueError(f"prior_share: expected a number between 0 and 1, got {prior_share}.")


def checked_cells(cells: Tensor, part_cells: Sequence[int] | None) -> list[int]:
    """How many of (N, cells) values each part has, all one part if None; a ValueError where they do not add up."""
    found = list(part_cells or (cells.shape[1],))
    if min(found) < 1 or sum(found) != cells.shape[1]:
        raise ValueError(f"part_cells: expected cells that add up to {cells.shape[1]}, got {found}.")
    return found


def checked_labels(descriptions: Tensor, labels: Tensor) -> Tensor:
    """The labels (N,) on the device of the descriptions (N, ...); raises a ValueError if they are not aligned."""
    if labels.shape != descriptions.shape[:1]:
        raise ValueError(
            f"labels: expected one for each of {len(descriptions)} descriptions, got shape {tuple(labels.shape)}."
        )
    return labels.to(descriptions.device)


def means_of(rows: Tensor, members: Tensor) -> Tensor:
    """(C, D) means of rows (N, D) by their classes (N,), numbered from 0 without a gap."""
    n_members = torch.bincount(members)
    return rows.new_zeros(len(n_members), rows.shape[1]).index_add_(0, members, rows) / n_members[:, None]
