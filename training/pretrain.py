"""Train the metric of the descriptor `pretrained` on generated shapes, and measure it where it was not trained.

    python training/pretrain.py --config configs/pretrain.yaml
    python training/pretrain.py --config configs/pretrain.yaml --data DATA

The first makes the file that the package ships; its only check is on held-out generated classes. The second scores that
metric on a labelled collection too, by the number of generated classes it is fitted to and with a few labels of it.
"""

from __future__ import annotations

from pathlib import Path

import torch
from jsonargparse import auto_cli
from pytorch_lightning import Trainer, seed_everything

import igps
from igps.data.datamodule import SignatureDataModule
from igps.data.splits import split_unseen
from igps.descriptors.pretrained import PRETRAINED, save_pretrained
from igps.descriptors.rich import rich
from igps.nn.description import describe
from igps.nn.descriptor import EmbeddedDescriptor
from igps.nn.fitted import WhitenedHead
from igps.nn.learner import RetrievalLearner
from igps.nn.metric import CorrectedDistance
from igps.report.learned import learned_layout
from transfer import curve, few_labels, report


def pretrain(
    root: Path = Path("build/pretrain"),
    n_classes: int = 260,
    n_per_class: int = 8,
    n_held_out: int = 60,
    n_eigenpairs: int = 64,
    n_epochs: int = 3,
    n_training_samples: int = 300,
    bin_rate: float = 0.01,
    n_directions: int = 32,
    shrinkage: float = 0.3,
    seed: int = 0,
    out: Path = PRETRAINED,
    cache_dir: Path | None = None,
    data: Path | None = None,
    figures: Path = Path("build"),
) -> None:
    """Generate shapes, train bins, filters and metric, save them, and print their scores.

    Args:
        root: folder of the generated meshes.
        n_classes, n_per_class, seed: of `ArticulatedShapes`.
        n_held_out: classes to check on.
        n_eigenpairs: of the signatures.
        n_epochs: of training bins and spectral filters; 0 leaves them as they are, and only the metric is fitted.
        n_training_samples: of each shape in those epochs, drawn anew at each step.
        bin_rate: learning rate of bins and filters.
        n_directions, shrinkage: of the `WhitenedHead`.
        out: the file of parameters.
        cache_dir: folder of cached signatures; the user's cache directory if not given.
        data: a labelled collection to measure the transfer on.
        figures: folder of pretrain.png, FT on `data` against the number of generated classes, and of
            pretrain_layout.png, the learned bins and filters.
    """
    seed_everything(seed)
    figures.mkdir(parents=True, exist_ok=True)
    igps.ArticulatedShapes(n_classes, n_per_class, seed).write(root, progress=True)
    descriptor = rich(learnable=n_epochs > 0)
    config = descriptor.needs.completed(igps.SignatureConfig(n_eigenpairs=n_eigenpairs))
    generated = igps.SignatureDataset(root, config, cache_dir)
    generated.precompute(strict=True)
    if n_epochs:
        thinned = rich(learnable=True, n_samples=n_training_samples, n_training_samples=n_training_samples)
        distance = CorrectedDistance(WhitenedHead(n_directions, shrinkage), share=1.0)
        shapes = SignatureDataModule(
            root, "unseen", n_classes - n_held_out, 0, split_seed=seed, classes_per_batch=16, config=config,
            cache_dir=cache_dir, n_samples_in_memory=2 * n_training_samples,
        )  # fmt: skip
        trainer = Trainer(max_epochs=n_epochs, logger=False, enable_checkpointing=False, num_sanity_val_steps=0)
        trainer.fit(RetrievalLearner(thinned, distance, bin_rate=bin_rate), shapes)
        descriptor.load_state_dict(thinned.state_dict())
        learned_layout(descriptor, figures / "pretrain_layout.png")
    descriptor.eval()
    histograms, labels = describe(generated, descriptor, progress=True), generated.labels

    def fit(n: int, seed: int) -> WhitenedHead:
        chosen = torch.tensor(split_unseen(labels, n, n_test=n_held_out, seed=seed).train)
        head = WhitenedHead(n_directions, shrinkage)
        return head.fit(histograms[chosen], labels[chosen], descriptor.part_cells)

    n_fitted = n_classes - n_held_out
    head = fit(n_fitted, seed)
    out.parent.mkdir(parents=True, exist_ok=True)
    save_pretrained(EmbeddedDescriptor(descriptor, head), out)
    held_out = torch.tensor(split_unseen(labels, n_fitted, seed=seed).test)
    report(f"{n_held_out} held-out generated classes", histograms[held_out], labels[held_out], head)
    if data is None:
        return
    real = igps.SignatureDataset(data, descriptor.needs.completed(igps.SignatureConfig()), cache_dir)
    real.precompute(strict=True)
    found, classes = describe(real, descriptor, progress=True), real.labels
    report(str(data), found, classes, head)
    counts = [n for n in (10, 30, 100) if n < n_fitted] + [n_fitted]
    curve(fit, counts, found, classes, figures / "pretrain.png")
    # Two of each class are left to find each other.
    for n in (n for n in (1, 3, 5) if n + 2 <= int(classes.bincount().min())):
        few_labels(n, found, classes, head)


if __name__ == "__main__":
    auto_cli(pretrain)
