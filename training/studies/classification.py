"""Classification accuracy over several seeded splits, on fixed or on trained histograms."""

from collections.abc import Sequence
from pathlib import Path
from statistics import mean, stdev

import torch
from torch import Tensor

import igps
from igps.data.datamodule import SignatureDataModule
from igps.data.splits import Split, split_seen
from igps.learning.fitting import split_head
from igps.nn.description import describe
from igps.nn.heads.base import Head
from igps.nn.heads.closed_form import KernelHead
from igps.nn.learner import RetrievalLearner
from training.studies.learning import part_cells_of


def classify(
    root: Path,
    descriptor: str = "rich",
    checkpoint: Path | None = None,
    n_train: int = 10,
    n_splits: int = 5,
    first_seed: int = 100,
    cache_dir: Path | None = None,
) -> None:
    """Print the accuracy of a `KernelHead` on test shapes, mean ± standard deviation over splits.

    If the descriptor has a metric, as `pretrained` has, the metric is the prior of the head.

    Args:
        root: labelled collection.
        descriptor: name of the descriptor that gives the features.
        checkpoint: checkpoint of train.py with protocol seen, whose learned histograms are the features.
        n_train: shapes of each class to train on.
        n_splits: number of splits, with consecutive seeds.
        first_seed: seed of the first split.
        cache_dir: folder of cached signatures; the user's cache directory if not given.
    """
    prior: Head | None = None
    if checkpoint is None:
        module, prior = split_head(descriptor)
        dataset = igps.SignatureDataset(root, cache_dir=cache_dir, descriptor=module)
        dataset.precompute(strict=True)
        histograms, part_cells = describe(dataset, module, progress=True), part_cells_of(module)
        seeds = range(first_seed, first_seed + n_splits)
        splits = [split_seen(dataset.labels, n_train, seed=seed) for seed in seeds]
        labels = dataset.labels
    else:
        learner = RetrievalLearner.load_from_checkpoint(checkpoint)
        data = SignatureDataModule.load_from_checkpoint(checkpoint)
        data.prepare_data()
        histograms, labels = (
            describe(data.dataset, learner.descriptor, progress=True),
            data.dataset.labels,
        )
        part_cells = learner.part_cells
        # The validation part was not used to choose anything here
        splits = [Split(data.split.train + data.split.validation, (), data.split.test)]
    accuracy = [
        100 * _accuracy(histograms.flatten(1), labels, split, part_cells, prior) for split in splits
    ]
    spread = stdev(accuracy) if len(accuracy) > 1 else 0.0
    print(f"accuracy {mean(accuracy):.1f} ± {spread:.1f} percent over {len(accuracy)} splits")


def _accuracy(
    histograms: Tensor,
    labels: Tensor,
    split: Split,
    part_cells: Sequence[int] | None,
    prior: Head | None,
) -> float:
    train, test = torch.tensor(split.train), torch.tensor(split.test)
    predicted = (
        KernelHead(prior)
        .fit(histograms[train], labels[train], part_cells)
        .predict(histograms[test])
    )
    return float((predicted == labels[test]).float().mean())
