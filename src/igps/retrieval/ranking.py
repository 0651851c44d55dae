"""Ranking of a gallery for each query."""

from dataclasses import dataclass

import torch
from torch import Tensor

from igps.retrieval.distances import Distance, check_tensor, chi_square


@dataclass(frozen=True, eq=False)
class SearchResult:
    """The gallery entries closest to each query, closest first."""

    indices: Tensor  # (Q, top) int64, positions in the gallery
    distances: Tensor  # (Q, top), ascending along each row


def rank(distances: Tensor) -> Tensor:
    """Return gallery indices (Q, G) as int64, closest first, ties in gallery order.

    A ValueError is raised unless the distances are a real matrix (Q, G) with entries ≥ 0. Infinity is allowed.
    """
    check_tensor("distances", distances)
    if distances.ndim != 2 or distances.is_complex() or distances.dtype == torch.bool:
        raise ValueError(
            f"distances: expected a real matrix (Q, G), got shape {tuple(distances.shape)} of {distances.dtype}; "
            "compute it with a function of igps.retrieval.distances"
        )
    # NaN if any entry is NaN
    smallest = distances.detach().amin().item() if distances.numel() else 0.0
    if smallest != smallest:
        raise ValueError(
            "distances: expected numbers, got NaN, which has no rank; look for the descriptor with NaN"
        )
    if smallest < 0:
        raise ValueError(
            f"distances: expected entries ≥ 0 (smaller is closer), the smallest is {smallest:g}; give distances in "
            "place of similarities, and remove rounding errors below zero with .clamp_min(0)"
        )
    return torch.sort(distances, dim=1, stable=True).indices


def search(
    query_descriptors: Tensor,
    gallery_descriptors: Tensor,
    *,
    top: int,
    distance: Distance = chi_square,
) -> SearchResult:
    """Return the `top` gallery entries closest to each query, ties in gallery order.

    A query that is itself in the gallery is found like any other entry, at distance 0.

    Example:
        >>> import torch
        >>> from igps.retrieval import euclidean
        >>> found = search(torch.tensor([[0.0]]), torch.tensor([[3.0], [1.0], [-2.0]]), top=2, distance=euclidean)
        >>> found.indices.tolist(), found.distances.tolist()
        ([[1, 2]], [[1.0, 2.0]])

    Args:
        query_descriptors: (Q, ...).
        gallery_descriptors: (G, ...).
        top: number of entries for each query, 1 to G.
        distance: the distance function.

    Raises:
        ValueError: `top` is out of range, or the distance function rejects the descriptors.
    """
    n_gallery = len(gallery_descriptors)
    if not 1 <= top <= n_gallery:
        raise ValueError(f"top: expected 1 to {n_gallery}, the size of the gallery, got {top}")
    distances = distance(query_descriptors, gallery_descriptors)
    indices = rank(distances)[:, :top]
    return SearchResult(indices=indices, distances=distances.gather(1, indices))
