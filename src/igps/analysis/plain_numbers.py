"""What plain numbers find: the row that stands beside every claim about form."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from igps.data.attribute_sources import named_source
from igps.data.dataset import SignatureDataset
from igps.descriptors.measures import Measures
from igps.mesh.formats import format_of
from igps.retrieval import RetrievalScores, chi_square, euclidean, scores_of_queries
from igps.signature.measures import POWERS

_COMPOSITION = "composition"  # 25 shares of residues, and the logarithm of their number


def plain_scores(
    dataset: SignatureDataset, is_query: Sequence[bool] | None = None
) -> dict[str, RetrievalScores]:
    """Return the scores of plain numbers among labelled bodies by the name of the row, see `scores_of_queries`.

    "measures" and "measures+size" are the logarithms of `igps.measures`, each over its spread in the collection.
    Molecules also have "composition", the shares of residues by χ², and "length of chain".

    Returns:
        No rows if a body has no measures.
    """
    labels = list(dataset.bodies.labels or ())
    distances = _of_measures(dataset.measured())
    if dataset.bodies.paths and all(map(_holds_chains, dataset.bodies.paths)):
        distances |= _of_residues(dataset)
    return {name: scores_of_queries(values, labels, is_query) for name, values in distances.items()}


def _of_measures(dataset: SignatureDataset) -> dict[str, Tensor]:
    """Return the distances (N, N) by plain numbers without and with size; none if a body has none."""
    found = {}
    for size in (False, True):
        measures = Measures(size=size)
        if not measures.fit_collection(dataset.measures(), dataset.units()):
            return {}
        rows = []
        for row in dataset.measures():
            rows.append([row.get(name, math.nan) for name in POWERS])
        numbers = torch.tensor(rows, dtype=torch.float64)
        columns = measures.logarithms(numbers, dataset.units())
        descriptions = columns / measures.spread
        found[measures.name] = euclidean(descriptions, descriptions)
    return found


def _of_residues(dataset: SignatureDataset) -> dict[str, Tensor]:
    """Return the distances (N, N) by the shares of residues and by their number; none if they are not known."""
    source = named_source(_COMPOSITION)
    if source is None:
        return {}
    anywhere = np.zeros((1, 3))
    values = np.concatenate([source(body, anywhere) for body in dataset.bodies])
    rows = torch.from_numpy(values)
    shares = rows[:, :-1]
    lengths = rows[:, -1:]
    return {
        _COMPOSITION: chi_square(shares, shares),
        "length of chain": euclidean(lengths, lengths),
    }


def _holds_chains(path: Path) -> bool:
    file_format = format_of(path)
    return file_format is not None and "chains" in file_format.bodies
