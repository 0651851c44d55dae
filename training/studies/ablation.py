"""Ablation of the learned parts: bins, spectral filter, dimensions and head, over several seeded splits."""

import logging
from collections.abc import Sequence
from pathlib import Path
from statistics import mean, stdev
from typing import Any

from pytorch_lightning import Trainer, seed_everything

import igps
from igps.data.datamodule import SignatureDataModule
from igps.nn.axes import EuclideanDistance, InteriorDistance, PairCosines, Potential
from igps.nn.description import describe
from igps.nn.descriptor import HistogramDescriptor
from igps.nn.embedding import SpectralEmbedding
from igps.nn.heads.closed_form import WhitenedHead
from igps.nn.heads.learned import BlendedDistance
from igps.nn.histograms.pairs import PairHistogram
from igps.nn.learner import RetrievalLearner
from training.studies.learning import Row, score

HEADS: tuple[Row, ...] = ("none", "whitened", "kernel")
# Dimensions, whether bins are learned, and whether the spectral filter is learned.
ROWS = (
    ("interior", False, False),
    ("interior", True, False),
    ("interior", False, True),
    ("interior", True, True),
    ("euclidean", False, False),
    ("euclidean", True, True),
    ("oriented", False, False),
    ("oriented", True, True),
)


def ablate(
    root: Path,
    n_train: int = 10,
    n_splits: int = 5,
    first_seed: int = 100,
    n_epochs: int = 10,
    n_training_samples: int = 300,
    cache_dir: Path | None = None,
    dimensions: Sequence[str] = ("interior", "euclidean", "oriented"),
) -> None:
    """Print FT of each head on each descriptor, trained or not: mean ± standard deviation over splits.

    Args:
        root: labelled collection; every class is split.
        n_train: shapes of each class to train on.
        n_splits: number of splits, with consecutive seeds.
        first_seed: seed of the first split.
        n_epochs: epochs of training of bins and filters.
        n_training_samples: samples of each shape in training, drawn at each step.
        cache_dir: folder of cached signatures; the user's cache directory if not given.
        dimensions: rows of the table, by their first word.
    """
    logging.getLogger("pytorch_lightning").setLevel(logging.WARNING)
    config = layout("oriented", False, False, n_training_samples).requirements.apply_to(
        igps.SignatureConfig()
    )
    print(f"{'dimensions':<14}{'learned':<16}" + "".join(f"{head:>14}" for head in HEADS))
    for name, bins, spectrum in ROWS:
        if name not in dimensions:
            continue
        ft: dict[str, list[float]] = {head: [] for head in HEADS}
        for seed in range(first_seed, first_seed + n_splits):
            seed_everything(seed, verbose=False)
            data = SignatureDataModule(
                root, "seen", n_train, 0, split_seed=seed, config=config, cache_dir=cache_dir
            )
            data.prepare_data()
            descriptor = layout(name, bins, spectrum, n_training_samples)
            if bins or spectrum:
                train(descriptor, data, n_epochs)
            histograms = describe(data.dataset, descriptor.eval()).flatten(1)
            for head in HEADS:
                scores = score(
                    histograms, data.dataset.labels, data.split, head, descriptor.part_cells
                )
                ft[head].append(100 * scores["ft"])
        learned = (
            " + ".join(
                part for part, is_learned in (("bins", bins), ("spectrum", spectrum)) if is_learned
            )
            or "nothing"
        )
        cells = "".join(
            f"{mean(v):>8.1f} ± {stdev(v) if n_splits > 1 else 0:>3.1f}" for v in ft.values()
        )
        print(f"{name:<14}{learned:<16}{cells}", flush=True)


def layout(
    dimensions: str, bins: bool, spectrum: bool, n_training_samples: int
) -> HistogramDescriptor:
    """Return the descriptor of a row.

    "interior" has interior distance and potential, "euclidean" adds Euclidean distance, and "oriented" adds angles to
    the surface, too.
    """

    def histogram(*axes: Any) -> PairHistogram:
        embedding = SpectralEmbedding(n_eigenpairs=50, n_knots=12 if spectrum else 0)
        return PairHistogram(axes, embedding, n_samples=1000, n_training_samples=n_training_samples)

    potential = Potential(4, soft=True, learnable=bins)
    if dimensions == "interior":
        parts = [histogram(potential, InteriorDistance(64, learnable=bins))]
    else:
        distances = InteriorDistance(32, learnable=bins), EuclideanDistance(16, learnable=bins)
        parts = [histogram(potential, *distances)]
    if dimensions == "oriented":
        parts.append(
            histogram(InteriorDistance(6, 3.0, learnable=bins), PairCosines(5, learnable=bins))
        )
    return HistogramDescriptor(parts)


def train(descriptor: HistogramDescriptor, data: SignatureDataModule, n_epochs: int) -> None:
    """Train bins and filters on the training part, in place."""
    learner = RetrievalLearner(descriptor, BlendedDistance(WhitenedHead(), share=1.0))
    trainer = Trainer(
        max_epochs=n_epochs,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    trainer.fit(learner, data)
