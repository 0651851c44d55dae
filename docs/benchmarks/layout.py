"""Does a learned layout help on classes that it was not trained on? The program behind the page.

    python -m docs.benchmarks.layout FOLDER [--picture docs/pictures/learned.png]

Generated bodies of ten families are written to the folder. In each of five splits, the layout of `interior` is trained
on five families, in a plain loop of PyTorch, and the bodies of the other five query each other. A head is fitted to the
training families with the fixed and with the learned layout.
"""

from __future__ import annotations

from pathlib import Path
from statistics import mean, stdev

import torch
from jsonargparse import auto_cli
from matplotlib.figure import Figure
from torch import Tensor
from training.generated import generated
from training.shapes import GradedShapes

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
N_FAMILIES, N_BODIES, N_POSES = 10, 7, 2
N_BATCH, N_SAMPLES = 20, 400


def families(folder: Path, *descriptors: igps.Descriptor) -> igps.SignatureDataset:
    """Return generated bodies of ten families, seven of each in two poses, with what the descriptors need."""
    shapes = GradedShapes(N_FAMILIES, N_BODIES, N_POSES, seed=7, n_vertices=(1500, 2000))
    requirements = descriptors[0].requirements
    for descriptor in descriptors[1:]:
        requirements |= descriptor.requirements
    return generated(shapes, folder / "shapes", requirements, folder / "cache", n_workers=1)


def contrastive(descriptions: Tensor, labels: Tensor) -> Tensor:
    """Return the supervised contrastive loss of Hellinger distances between descriptions."""
    roots = square_root(descriptions.flatten(1))
    is_self = torch.eye(len(labels), dtype=torch.bool)
    similarity = -20 * torch.cdist(roots, roots).masked_fill(is_self, torch.inf)
    is_positive = (labels[:, None] == labels) & ~is_self
    return -similarity.log_softmax(dim=1)[is_positive].mean()


def train(
    dataset: igps.SignatureDataset, parts: tuple[LayoutPart, ...], seed: int, n_steps: int
) -> igps.HistogramDescriptor:
    """Train parts of the layout of `interior` on all classes of a dataset."""
    torch.manual_seed(seed)
    descriptor = igps.descriptor("interior", learnable=parts, n_training_samples=N_SAMPLES).train()
    assert isinstance(descriptor, igps.HistogramDescriptor)
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
) -> list[float]:
    """Return FT in percent on the test classes, without a head and with one for the training classes."""
    train_histograms = igps.describe(train_set, descriptor).flatten(1)
    test_histograms = igps.describe(test_set, descriptor).flatten(1)
    head = WhitenedHead().fit(train_histograms, train_set.labels)
    vectors = head(test_histograms)
    plain = descriptor.distances(test_histograms, test_histograms)
    whitened = head.distances(vectors, vectors)
    return [first_tier(plain, test_set), first_tier(whitened, test_set)]


def first_tier(distances: Tensor, dataset: igps.SignatureDataset) -> float:
    """Return the mean FT in percent of all bodies of a dataset, from their distances."""
    return 100 * igps.retrieval_scores(distances, dataset.labels.tolist()).mean()["ft"]


def draw(before: igps.HistogramDescriptor, after: igps.HistogramDescriptor, path: Path) -> None:
    """Draw the centres of the classes and of the bins of `interior` before and after training."""
    figure = Figure(figsize=(7, 2.6), layout="constrained")
    panels = figure.subplots(2, 1)
    for panel, number, name in zip(panels, (0, 1), ("potential", "interior distance"), strict=True):
        for height, descriptor in ((1, before), (0, after)):
            centres = descriptor.histograms[0].axes[number].centres().detach()
            panel.vlines(centres, height, height + 0.8, "C1" if height == 0 else "C0")
        panel.set(title=name, yticks=(0.4, 1.4), yticklabels=("learned", "fixed"))
        panel.title.set_fontsize(9)
    figure.savefig(path, dpi=100)


def main(
    folder: Path, seeds: tuple[int, ...] = SEEDS, n_steps: int = 100, picture: Path | None = None
) -> None:
    """Print FT of the fixed layout, and what learning adds: mean and standard deviation over splits."""
    torch.set_num_threads(1)
    fixed = igps.descriptor("interior")
    assert isinstance(fixed, igps.HistogramDescriptor)
    dataset = families(folder, fixed).to_memory()
    labels = dataset.labels
    numbers = igps.descriptor("measures")
    starts = []
    plain_numbers = []
    gains: dict[tuple[LayoutPart, ...], list[list[float]]] = {parts: [] for parts in LEARNED}
    for seed in seeds:
        order = torch.randperm(N_FAMILIES, generator=torch.Generator().manual_seed(seed))
        is_train = torch.isin(labels, order[: N_FAMILIES // 2])
        train_set = dataset[is_train]
        test_set = dataset[~is_train]
        start = scores(fixed, train_set, test_set)
        starts.append(start)
        rows = igps.describe(test_set, numbers)
        plain_numbers.append([first_tier(numbers.distances(rows, rows), test_set)])
        for parts in LEARNED:
            learned = train(train_set, parts, seed, n_steps)
            found = scores(learned, train_set, test_set)
            gains[parts].append([b - a for a, b in zip(start, found, strict=True)])
            print(seed, " ".join(parts), start, found, flush=True)
            if picture is not None and parts == LEARNED[0] and seed == seeds[0]:
                draw(fixed, learned, picture)
    report("plain numbers", plain_numbers)
    report("fixed", starts)
    for parts in LEARNED:
        report(" ".join(parts), gains[parts])


def report(title: str, rows: list[list[float]]) -> None:
    """Print mean and standard deviation over the splits, without a head and, if measured, with one."""
    for name, column in zip(("no head", "whitened"), zip(*rows, strict=False), strict=False):
        spread = stdev(column) if len(column) > 1 else 0.0
        print(f"{title}, {name}: {mean(column):.1f} ± {spread:.1f}")


if __name__ == "__main__":
    with errors_as_messages():
        auto_cli(main)
