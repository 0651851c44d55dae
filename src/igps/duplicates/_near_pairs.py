"""Candidates: pairs of bodies whose moments allow a small distance."""

import math
from collections.abc import Iterator
from functools import cache

import torch
from torch import Tensor

from igps._progress import Progress
from igps.data.dataset import SignatureDataset
from igps.duplicates._moments import distance_bounds
from igps.mesh.mesh import millimetres

_ROWS = 256  # of the matrix of distances in memory at once
# Bodies of one size differ by less in the logarithm of √area; levels of detail of a body differ by up to half of this
_SIZE_TOLERANCE = 0.05

NearPairs = Iterator[tuple[int, int]]  # indices i < j


def near_pairs(moments: Tensor, limit: float, progress: bool) -> NearPairs:
    """Yield the pairs i < j of bodies whose distance may be at most the limit, by their `moments` (N, 7, 6)."""
    with Progress(desc="compared", total=len(moments), disable=not progress) as bar:
        for start in range(0, len(moments), _ROWS):
            rows = moments[start : start + _ROWS]
            with torch.inference_mode():
                bounds = distance_bounds(rows, moments[start:])
            for i, j in torch.nonzero(bounds <= limit).tolist():
                if i < j:
                    yield start + i, start + j
            bar.update(len(rows))


def of_one_size(near: NearPairs, dataset: SignatureDataset) -> NearPairs:
    """Yield the pairs whose bodies have the same size."""

    @cache
    def log_length(i: int) -> float:
        signature = dataset[i].signature
        return math.log(signature.area) / 2 + math.log(millimetres(signature.unit))

    return (
        pair for pair in near if abs(log_length(pair[0]) - log_length(pair[1])) < _SIZE_TOLERANCE
    )
