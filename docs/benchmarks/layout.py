"""Does a learned layout help on classes that it was not trained on? A program to try it.

    python -m docs.benchmarks.layout FOLDER

Generated bodies of ten classes are written to the folder. The layout is trained on five of them, in a plain loop of
PyTorch, and the bodies of the other five query each other. The head is fitted to the training classes with the fixed
and with the learned layout.
"""

from __future__ import annotations

from pathlib import Path
from statistics import mean, stdev

import torch
from jsonargparse import auto_cli
from torch import Tensor

import igps
from igps.cli import errors_as_messages
from igps.nn.functional import square_root
from igps.nn.heads import WhitenedHead
from igps.nn.layout import LayoutPart

SEEDS = (200, 201, 202, 203, 204)
LEARNED: tuple[tuple[LayoutPart, ...], ...] = (
    ("bins", "classes"),
    ("filter",),
    ("bins", "classes", "filter"),
)
N_BATCH, N_SAMPLES = 20, 400


def contrastive(descriptions: Tensor, labels: Tensor) -> Tensor:
    """Return the supervised contrastive loss of Hellinger distances between descriptions."""
    roots = square_root(descriptions.flatten(1))
    is_self = torch.eye(len(labels), dtype=torch.bool)
    similarity = -20 * torch.cdist(roots, roots).masked_fill(is_self, torch.inf)
    is_positive = (labels[:, None] == labels) & ~is_self
    return -similarity.log_softmax(dim=1)[is_positive].mean()


def train(
    dataset: igps.SignatureDataset, parts: tuple[LayoutPart, ...], seed: int, n_steps: int
) -> igps.Descriptor:
    """Train parts of the layout of `interior` on all classes of a dataset."""
    torch.manual_seed(seed)
    descriptor = igps.descriptor("interior", learnable=parts, n_training_samples=N_SAMPLES).train()
    optimizer = torch.optim.Adam(descriptor.parameters(), lr=0.03)
    for _ in range(n_steps):
        batch = dataset.batch(torch.randperm(len(dataset))[:N_BATCH].tolist())
        loss = contrastive(descriptor(batch), batch.labels)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return descriptor.eval()


def scores(
    descriptor: igps.Descriptor, train_set: igps.SignatureDataset, test_set: igps.SignatureDataset
) -> tuple[float, float]:
    """Return FT in percent on the test classes, without a head and with one for the training classes."""
    train_histograms = igps.describe(train_set, descriptor).flatten(1)
    test_histograms = igps.describe(test_set, descriptor).flatten(1)
    head = WhitenedHead().fit(train_histograms, train_set.labels)
    vectors = head(test_histograms)
    labels = test_set.labels.tolist()
    plain = descriptor.distances(test_histograms, test_histograms)
    learned = head.distances(vectors, vectors)
    return tuple(100 * igps.retrieval_scores(x, labels).mean()["ft"] for x in (plain, learned))  # type: ignore[return-value]


def main(folder: Path, seeds: tuple[int, ...] = SEEDS, n_steps: int = 40) -> None:
    """Print FT of the fixed layout, and what learning adds: mean and standard deviation over splits."""
    igps.ArticulatedShapes(n_classes=10, n_per_class=8, n_vertices=1000).write(folder / "shapes")
    fixed = igps.descriptor("interior")
    dataset = igps.SignatureDataset(folder / "shapes", descriptor=fixed, cache_dir=folder / "cache")
    dataset.precompute(n_workers=1)
    dataset = dataset.to_memory()
    labels = dataset.labels
    gains: dict[tuple[LayoutPart, ...], list[tuple[float, float]]] = {p: [] for p in LEARNED}
    for seed in seeds:
        order = torch.randperm(10, generator=torch.Generator().manual_seed(seed))
        is_train = torch.isin(labels, order[:5])
        train_set = dataset[is_train]
        test_set = dataset[~is_train]
        start = scores(fixed, train_set, test_set)
        print(f"{seed} fixed: plain {start[0]:.1f}, whitened {start[1]:.1f}", flush=True)
        for parts in LEARNED:
            found = scores(train(train_set, parts, seed, n_steps), train_set, test_set)
            gains[parts].append((found[0] - start[0], found[1] - start[1]))
            print(f"{seed} {parts}: {found[0]:.1f}, {found[1]:.1f}", flush=True)
    for parts, pairs in gains.items():
        for name, gain in zip(("plain", "whitened"), zip(*pairs, strict=True), strict=True):
            spread = stdev(gain) if len(gain) > 1 else 0.0
            print(f"{' '.join(parts)}, {name}: {mean(gain):+.1f} ± {spread:.1f}")


if __name__ == "__main__":
    with errors_as_messages():
        auto_cli(main)
