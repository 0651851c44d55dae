"""Score a checkpoint of `igps train` on the test part of its split.

    python -m training.evaluate build/own/checkpoints/best.ckpt

No parameter is tuned, and each test shape queries the others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from jsonargparse import auto_cli
from torch import Tensor

from igps.cli import errors_as_messages
from igps.data.datamodule import SignatureDataModule
from igps.data.splits import Split
from igps.nn.description import describe
from igps.nn.heads.base import Head
from igps.nn.heads.closed_form import KernelHead, WhitenedHead
from igps.nn.learner import RetrievalLearner
from igps.retrieval import chi_square, retrieval_scores

HEADS: Mapping[str, type[WhitenedHead | KernelHead]] = {
    "whitened": WhitenedHead,
    "kernel": KernelHead,
}
COLUMNS = {"ft": "FT", "nn": "NN", "dcg": "DCG", "st": "ST", "adr": "ADR", "map": "mAP"}


def evaluate(checkpoint: Path) -> None:
    """Print the scores of a checkpoint on the test part of its split, in percent.

    "plain" is the distance of its histograms without the head, and "learned" that with the head. "whitened" and
    "kernel" are heads in closed form, fitted to the histograms of its training and validation parts.

    Args:
        checkpoint: path of the checkpoint.
    """
    learner = RetrievalLearner.load_from_checkpoint(checkpoint).eval()
    data = SignatureDataModule.load_from_checkpoint(checkpoint)
    data.prepare_data()
    histograms = describe(data.dataset, learner.descriptor, progress=True)
    labels = data.dataset.labels
    test = torch.tensor(data.split.test)
    tested = histograms[test]
    with torch.inference_mode():
        plain = chi_square(tested, tested)
        learned = learner.distances(tested, tested)
    results = {
        "plain": retrieval_scores(plain, labels[test]).mean(),
        "learned": retrieval_scores(learned, labels[test]).mean(),
    }
    # The validation part was not used to choose anything on which these heads depend.
    split = Split(data.split.train + data.split.validation, (), data.split.test)
    for name, head_class in HEADS.items():
        head = fit_head(head_class(), histograms.flatten(1), labels, split, learner.part_cells)
        results[name] = score(histograms.flatten(1), labels, split, head)
    print(f"{'':<10}" + "".join(f"{title:>8}" for title in COLUMNS.values()))
    for name, scores in results.items():
        print(f"{name:<10}" + "".join(f"{100 * scores[column]:>8.1f}" for column in COLUMNS))


def fit_head(
    head: WhitenedHead | KernelHead,
    histograms: Tensor,
    labels: Tensor,
    split: Split,
    part_cells: Sequence[int] | None,
) -> Head:
    """Fit a head to the training part of a split."""
    train = torch.tensor(split.train)
    return head.fit(histograms[train], labels[train], part_cells)


def score(
    histograms: Tensor, labels: Tensor, split: Split, head: Head | None = None
) -> dict[str, float]:
    """Return the mean scores of the test part, each shape against the others; by chi-square without a head."""
    test = torch.tensor(split.test)
    tested = histograms[test]
    if head is None:
        distances = chi_square(tested, tested)
    else:
        vectors = head(tested)
        distances = head.distances(vectors, vectors)
    return retrieval_scores(distances, labels[test]).mean()


if __name__ == "__main__":
    with errors_as_messages():
        auto_cli(evaluate)
