"""Fit the metric of the descriptor `pretrained` to generated shapes, and measure it where it was not fitted.

    python training/pretrain.py --config configs/pretrain.yaml
    python training/pretrain.py --config configs/pretrain.yaml --data DATA

The first makes the file that the package ships; its only check is on held-out generated classes, beside the plain
descriptors. The second scores that metric on a labelled collection too, by the number of generated classes it is fitted
to and with a few labels of it.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from pathlib import Path

import torch
from jsonargparse import auto_cli
from torch import Tensor

import igps
from igps.descriptors.pretrained import PRETRAINED, save_pretrained, seven_parts, two_levels
from igps.geometry.reading import MeshReading
from igps.nn.description import describe
from igps.nn.descriptor import Descriptor, EmbeddedDescriptor
from igps.nn.levels import TwoLevelHead
from igps.shapes import GradedShapes, body_of, looks_alike
from transfer import curve, few_labels, report, two_level_scores


def pretrain(
    root: Path = Path("build/pretrain"),
    n_classes: int = 240,
    n_bodies: int = 4,
    n_poses: int = 4,
    n_held_out: int = 40,
    seed: int = 0,
    out: Path = PRETRAINED,
    cache_dir: Path | None = None,
    plain: Sequence[str] = ("gps", "interior", "multiscale", "rich"),
    data: Path | None = None,
    figures: Path = Path("build"),
    n_workers: int | None = None,
) -> None:
    """Generate shapes, fit the metric, save it, and print its scores.

    Args:
        root: folder of the generated meshes.
        n_classes, n_bodies, n_poses, seed: of `GradedShapes`.
        n_held_out: classes to check on, drawn by the seed.
        out: the file of parameters.
        cache_dir: folder of cached signatures; the user's cache directory if not given.
        plain: descriptors to score on the held-out classes beside the metric.
        data: a labelled collection to measure the transfer on.
        figures: folder of pretrain.png, FT on `data` against the number of generated classes.
        n_workers: processes; all cores if not given.
    """
    figures.mkdir(parents=True, exist_ok=True)
    shapes = GradedShapes(n_classes, n_bodies, n_poses, seed)
    try:
        shapes.write(root, progress=True, n_workers=n_workers)
    except ValueError as error:  # a body whose thin parts no grid resolves: the others are there
        print(error)
    descriptor = seven_parts().eval()
    generated = _usable(root, descriptor, cache_dir, n_workers)
    histograms, labels = describe(generated, descriptor, progress=True, n_workers=n_workers), generated.labels
    bodies = _numbers([body_of(name) for name in generated.files.names])
    present = labels.unique().tolist()  # nearly all: see above
    held_out = torch.isin(labels, torch.tensor(_drawn(present, n_held_out, seed)))

    def fit(n: int, seed: int, among: Tensor = ~held_out) -> TwoLevelHead:
        """The metric, of n classes drawn by the seed."""
        chosen = among & torch.isin(labels, torch.tensor(_drawn(labels[among].unique().tolist(), n, seed)))
        return two_levels().fit(histograms[chosen], labels[chosen], descriptor.part_cells, bodies=bodies[chosen])

    n_fitted = len(present) - n_held_out
    head = fit(n_fitted, seed)
    out.parent.mkdir(parents=True, exist_ok=True)
    save_pretrained(EmbeddedDescriptor(descriptor, head), out)

    where = torch.nonzero(held_out).flatten().tolist()
    print(f"{n_held_out} held-out generated classes, {len(where)} shapes, by the labels of bodies and of classes:")
    two_level_scores("pretrained", _distances(head, histograms[where]), labels[where], bodies[where])
    for name in plain:
        other = igps.descriptor(name)
        some = _usable(root, other, cache_dir, n_workers, where)
        described = describe(some, other, n_workers=n_workers)
        two_level_scores(name, other.distances(described, described), labels[where], bodies[where])
    alike = torch.tensor([looks_alike(name) for name in generated.classes])
    strangers = ~held_out & ~alike[labels]
    n_strangers = len(labels[strangers].unique())
    both = (("without look-alikes", strangers), ("as many, with them", ~held_out)) if n_strangers > 1 else ()
    for name, among in both:
        fitted = fit(n_strangers, seed, among)
        title = f"{name} ({n_strangers})"
        two_level_scores(title, _distances(fitted, histograms[where]), labels[where], bodies[where])
    if data is None:
        return

    real = _usable(data, descriptor, cache_dir, n_workers)
    found, classes = describe(real, descriptor, progress=True, n_workers=n_workers), real.labels
    report(str(data), found, classes, head)
    for name, among in both:
        report(f"{data}, fitted to {n_strangers} classes, {name}", found, classes, fit(n_strangers, seed, among))
    counts = [n for n in (10, 30, 100) if n < n_fitted] + [n_fitted]
    curve(fit, counts, found, classes, figures / "pretrain.png")
    # Two of each class are left to find each other.
    for n in (n for n in (1, 3, 5) if n + 2 <= int(classes.bincount().min())):
        few_labels(n, found, classes, head, descriptor.part_cells)


def _usable(
    root: Path, descriptor: Descriptor, cache_dir: Path | None, n_workers: int | None, some: list[int] | None = None
) -> igps.SignatureDataset:
    """The dataset of the meshes, or some of them, whose signatures could be computed; those that could not are told."""
    config = descriptor.needs.completed(igps.SignatureConfig())
    data = igps.SignatureDataset(root, config, cache_dir, reading=MeshReading())
    if some is not None:
        data = data.subset(some)
    failures = data.precompute(n_workers=n_workers)
    for failure in failures:
        print(failure)
    return data.usable(failures)


def _drawn(classes: Sequence[int], n: int, seed: int) -> list[int]:
    return random.Random(seed).sample(sorted(classes), n)


def _numbers(names: Sequence[str]) -> Tensor:
    number = {name: i for i, name in enumerate(sorted(set(names)))}
    return torch.tensor([number[name] for name in names])


def _distances(head: TwoLevelHead, histograms: Tensor) -> Tensor:
    vectors = head(histograms)
    return head.distances(vectors, vectors)


if __name__ == "__main__":
    auto_cli(pretrain)
