"""Pairs of bodies with near descriptions, in a dataset or in a gallery."""

import math
from collections.abc import Iterator
from functools import cache

import torch
from torch import Tensor
from tqdm import tqdm

from igps.data.dataset import SignatureDataset
from igps.gallery.gallery import Gallery
from igps.mesh.mesh import millimetres
from igps.retrieval.distances import Distance

_ROWS = 256  # of the matrix of distances in memory at once
# Neighbours in a gallery that are searched first; four times as many if all are near
_FIRST_TOP = 32
# Bodies of one size differ by less in the logarithm of √area; levels of detail of a body differ by up to half of this
_SIZE_TOLERANCE = 0.05

NearPairs = Iterator[tuple[int, int, float]]  # indices i < j and distance


def near_pairs(descriptions: Tensor, distance: Distance, limit: float, progress: bool) -> NearPairs:
    """Yield the pairs i < j of descriptions whose distance is at most the limit, with the distance."""
    with tqdm(desc="compared", total=len(descriptions), disable=not progress) as bar:
        for start in range(0, len(descriptions), _ROWS):
            rows = descriptions[start : start + _ROWS]
            with torch.inference_mode():
                distances = distance(rows, descriptions[start:])
            for i, j in torch.nonzero(distances <= limit).tolist():
                if i < j:
                    yield start + i, start + j, float(distances[i, j])
            bar.update(len(rows))


def near_in_gallery(gallery: Gallery, limit: float, progress: bool) -> NearPairs:
    """Do the same as `near_pairs` for the bodies of a gallery; i and j are positions in its sorted ids."""
    numbers = {name: i for i, name in enumerate(sorted(row["id"] for row in gallery.rows("id")))}
    with tqdm(desc="compared", total=len(gallery), disable=not progress) as bar:
        for batch in gallery.table.batches():
            for description, row in zip(*gallery.table.decoded(batch), strict=True):
                top = min(_FIRST_TOP, len(gallery))
                neighbours, distances, _ = gallery.search(description[None], top=top)
                while float(distances[-1]) <= limit and top < len(gallery):
                    top = min(4 * top, len(gallery))
                    neighbours, distances, _ = gallery.search(description[None], top=top)
                for other, distance in zip(neighbours, distances.tolist(), strict=True):
                    if numbers[row["id"]] < numbers[other["id"]] and distance <= limit:
                        yield numbers[row["id"]], numbers[other["id"]], distance
                bar.update()


def of_one_size(near: NearPairs, dataset: SignatureDataset) -> NearPairs:
    """Yield the pairs whose bodies have the same size."""

    @cache
    def log_length(i: int) -> float:
        signature = dataset[i].signature
        return math.log(signature.area) / 2 + math.log(millimetres(signature.unit))

    return (
        pair for pair in near if abs(log_length(pair[0]) - log_length(pair[1])) < _SIZE_TOLERANCE
    )
