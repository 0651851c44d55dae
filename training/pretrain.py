"""Fit the metric of VolumetricDescriptor.pretrained to generated shapes, and measure it where it was not fitted.

    python training/pretrain.py --config configs/pretrain.yaml
    python training/pretrain.py --config configs/pretrain.yaml --data DATA

The first makes the file that the package ships; its only check is on held-out generated classes. The second scores that
metric on a labelled collection too, by the number of generated classes it is fitted to and with a few labels of it.
"""

from __future__ import annotations

from pathlib import Path
from statistics import mean

import torch
from jsonargparse import auto_cli
from safetensors.torch import save_file
from torch import Tensor

from igps.data.datamodule import split_seen, split_unseen
from igps.data.dataset import SignatureDataset
from igps.data.shapes import ArticulatedShapes
from igps.figures.learned import transfer_curve
from igps.geometry.signature import SignatureConfig
from igps.nn.descriptor import PRETRAINED, CombinedDescriptor
from igps.nn.extraction import describe
from igps.nn.fitted import KernelHead, WhitenedHead
from igps.nn.head import square_roots
from igps.nn.presets import preset
from igps.retrieval import chi_square, cosine, retrieval_scores

COLUMNS = ("nn", "ft", "st", "dcg")


def pretrain(
    root: Path = Path("build/pretrain"),
    n_classes: int = 260,
    n_per_class: int = 8,
    n_held_out: int = 60,
    n_eigenpairs: int = 64,
    n_directions: int = 32,
    shrinkage: float = 1.0,
    seed: int = 0,
    out: Path = PRETRAINED,
    cache: Path | None = None,
    data: Path | None = None,
    figure: Path = Path("build/pretrain.png"),
) -> None:
    """Generate shapes, fit the metric, save it, and print its scores.

    Args:
        root: folder of the generated meshes.
        n_classes, n_per_class, seed: of `ArticulatedShapes`.
        n_held_out: classes to check on.
        n_eigenpairs: of the signatures.
        n_directions, shrinkage: of the `WhitenedHead`.
        out: the file of parameters.
        cache: folder of cached signatures; the user's cache directory if not given.
        data: a labelled collection to measure the transfer on.
        figure: picture of FT on `data` against the number of generated classes.
    """
    ArticulatedShapes(n_classes, n_per_class, seed).write(root, progress=True)
    generated = SignatureDataset(root, preset("rich").completed(SignatureConfig(n_eigenpairs=n_eigenpairs)), cache)
    generated.precompute(strict=True)
    descriptor = CombinedDescriptor.rich()
    shapes, labels = describe(generated, descriptor, progress=True), generated.labels

    def fit(n: int, seed: int) -> WhitenedHead:
        chosen = torch.tensor(split_unseen(labels, n, n_test=n_held_out, seed=seed).train)
        return WhitenedHead(descriptor.part_cells, n_directions, shrinkage).fit(shapes[chosen], labels[chosen])

    head = fit(n_classes - n_held_out, seed)
    out.parent.mkdir(parents=True, exist_ok=True)
    save_file({name: tensor.half().contiguous() for name, tensor in head.state_dict().items()}, out)
    held_out = torch.tensor(split_unseen(labels, n_classes - n_held_out, seed=seed).test)
    report(f"{n_held_out} held-out generated classes", shapes[held_out], labels[held_out], head)
    if data is None:
        return
    real = SignatureDataset(data, preset("rich").completed(SignatureConfig()), cache)
    real.precompute(strict=True)
    histograms, classes = describe(real, descriptor, progress=True), real.labels
    report(str(data), histograms, classes, head)
    counts = [n for n in (10, 30, 100) if n < n_classes - n_held_out] + [n_classes - n_held_out]
    curve = {n: [scores(fit(n, s)(histograms), classes)["ft"] for s in range(3)] for n in counts}
    plain = retrieval_scores(chi_square(histograms, histograms), classes).mean()["ft"]
    for n, values in curve.items():
        print(f"{n:>4} generated classes: FT {' '.join(f'{100 * value:.1f}' for value in values)} (three draws)")
    transfer_curve(curve, plain, figure)
    # Two of each class are left to find each other.
    for n in (n for n in (1, 3, 5) if n + 2 <= int(classes.bincount().min())):
        few_labels(n, histograms, classes, head)


def report(title: str, histograms: Tensor, labels: Tensor, head: WhitenedHead) -> None:
    """Print the scores of the plain distance and of the head."""
    print(f"{title}\n{'':<12}" + "".join(f"{name.upper():>7}" for name in COLUMNS))
    plain = retrieval_scores(chi_square(histograms, histograms), labels).mean()
    for name, found in (("plain", plain), ("pretrained", scores(head(histograms), labels))):
        print(f"{name:<12}" + "".join(f"{100 * found[column]:>7.1f}" for column in COLUMNS))


def scores(embedding: Tensor, labels: Tensor) -> dict[str, float]:
    """Leave-one-out scores of the cosine distance."""
    return retrieval_scores(cosine(embedding, embedding), labels).mean()


def few_labels(n: int, histograms: Tensor, labels: Tensor, pretrained: WhitenedHead) -> None:
    """Print FT of heads fitted to n shapes of each class, from the pretrained metric and from scratch."""
    found: dict[str, list[float]] = {"pretrained, no labels": [], "from pretrained": [], "from scratch": []}
    for seed in range(100, 105):
        split = split_seen(labels, n, seed=seed)
        train, test = torch.tensor(split.train), torch.tensor(split.test)
        fitted = {
            name: KernelHead(pretrained.part_cells, len(train), len(labels.unique()), len(pretrained.directions))
            for name in ("from pretrained", "from scratch")
        }
        fitted["from pretrained"].whitened.load_state_dict(pretrained.state_dict())
        # A single shape of a class tells nothing of the variation within it; what is left is to centre.
        fitted["from scratch"].whitened.mean.copy_(square_roots(histograms[train], histograms.shape[1]).mean(dim=0))
        fitted["from pretrained"].fit(histograms[train], labels[train], whiten=False)
        fitted["from scratch"].fit(histograms[train], labels[train], whiten=n > 1)
        for name, head in {"pretrained, no labels": pretrained, **fitted}.items():
            found[name].append(100 * scores(head(histograms[test]), labels[test])["ft"])
    print(f"{n} labels a class: " + ", ".join(f"{name} FT {mean(values):.1f}" for name, values in found.items()))


if __name__ == "__main__":
    auto_cli(pretrain)
