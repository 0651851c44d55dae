"""Retrieval scores as a metric of torchmetrics, accumulated over batches."""

import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from igps.retrieval.distances import Distance, chi_square
from igps.retrieval.scores import retrieval_scores

try:
    from torchmetrics import Metric
    from torchmetrics.utilities import dim_zero_cat
except ImportError as error:
    raise ImportError('needs torchmetrics: pip install "interior-gps[metric]".') from error


class RetrievalScoresMetric(Metric):
    """Leave-one-out retrieval scores of all descriptors, accumulated over batches, see `retrieval_scores`.

    `update` takes descriptors (N, ...) and integer labels (N,). `compute` returns the mean scores by name, as scalar
    tensors in [0, 1]. Call these methods rather than the metric itself, because a single batch seldom has two shapes
    of a class. Distributed samplers repeat some shapes to fill their batches, and a repeated shape would be a perfect
    match for itself. With `ids`, each shape counts once, whatever the number of processes.
    """

    is_differentiable = False
    higher_is_better = True
    full_state_update = False

    descriptors: list[Tensor]
    labels: list[Tensor]
    ids: list[Tensor]

    def __init__(self, distance: Distance = chi_square, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.distance = distance
        for name in ("descriptors", "labels", "ids"):
            self.add_state(name, default=[], dist_reduce_fx="cat")

    def update(self, descriptors: Tensor, labels: Tensor, ids: Sequence[str] | None = None) -> None:
        """Add descriptors (N, ...), integer labels (N,) and unique names of shapes; a ValueError if lengths differ."""
        if (
            labels.ndim != 1
            or labels.is_floating_point()
            or descriptors.ndim < 2
            or len(labels) != len(descriptors)
        ):
            raise ValueError(
                f"labels: expected one integer for each of the descriptors (N, ...), got {tuple(labels.shape)} of "
                f"{labels.dtype} for descriptors {tuple(descriptors.shape)}"
            )
        if ids is not None and len(ids) != len(labels):
            raise ValueError(
                f"ids: expected one name for each of {len(labels)} descriptors, got {len(ids)}"
            )
        if self.labels and (ids is None) == bool(self.ids):
            raise ValueError("ids: expected in every update or in none, got them in some")
        self.descriptors.append(descriptors.detach())
        self.labels.append(labels)
        if ids is not None:
            hashes = [_hash64(name) for name in ids]
            self.ids.append(torch.tensor(hashes, dtype=torch.int64, device=labels.device))

    def compute(self) -> dict[str, Tensor]:
        """Return the mean scores by name; a ValueError if no two descriptors share a label."""
        descriptors = dim_zero_cat(self.descriptors)
        labels = dim_zero_cat(self.labels)
        if len(self.ids):
            hashes = dim_zero_cat(self.ids).cpu().numpy()
            _, first = np.unique(hashes, return_index=True)
            unique = torch.from_numpy(np.sort(first)).to(labels.device)
            descriptors = descriptors[unique]
            labels = labels[unique]
        distances = self.distance(descriptors, descriptors)
        means = retrieval_scores(distances, labels).mean()
        return {name: torch.tensor(mean, device=distances.device) for name, mean in means.items()}


def _hash64(name: str) -> int:
    """A 64-bit hash, the same in every process: processes can exchange numbers, but no strings."""
    digest = hashlib.blake2b(name.encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little", signed=True)
