"""Retrieval scores accumulated over batches, as a metric of torchmetrics."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat

from igps.retrieval.distances import Distance, chi_square
from igps.retrieval.scores import retrieval_scores


class RetrievalScoresMetric(Metric):
    """Leave-one-out retrieval scores of all descriptors seen, accumulated over batches (see retrieval_scores).

    `update` takes descriptors (N, ...) and integer labels (N,); `compute` returns the means as a dict of scalar
    tensors, fractions. Call `update` and `compute`, not the metric itself: single batches seldom hold two of a class.
    A distributed sampler must not pad with repeated shapes, as a repetition is a perfect match.

    Args:
        distance: the distance function that compares the descriptors.
    """

    is_differentiable = False
    higher_is_better = True
    full_state_update = False

    descriptors: list[Tensor]
    labels: list[Tensor]

    def __init__(self, distance: Distance = chi_square, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.distance = distance
        self.add_state("descriptors", default=[], dist_reduce_fx="cat")
        self.add_state("labels", default=[], dist_reduce_fx="cat")

    def update(self, descriptors: Tensor, labels: Tensor) -> None:
        """Add descriptors (N, ...) and integer labels (N,); ValueError if they are not aligned."""
        if labels.ndim != 1 or labels.is_floating_point() or descriptors.ndim < 2 or len(labels) != len(descriptors):
            raise ValueError(
                f"labels: expected one integer for each of the descriptors (N, ...), got {tuple(labels.shape)} of "
                f"{labels.dtype} for descriptors {tuple(descriptors.shape)}"
            )
        self.descriptors.append(descriptors.detach())
        self.labels.append(labels)

    def compute(self) -> dict[str, Tensor]:
        """Mean scores by name; ValueError if no two descriptors share a label."""
        descriptors, labels = dim_zero_cat(self.descriptors), dim_zero_cat(self.labels)
        scores = retrieval_scores(self.distance(descriptors, descriptors), labels)
        return {name: torch.tensor(value, device=descriptors.device) for name, value in scores.mean().items()}
