"""How much labels improve retrieval: the tables of learning.md.

    python -m docs.benchmarks.learning splits ROOT --protocol seen --out build/splits.json
    python -m docs.benchmarks.learning fitted ROOT
    python -m docs.benchmarks.learning plain ROOT

Heads with fixed parameters are fitted to the training part of each split, and the test part is scored once.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from statistics import mean, stdev
from typing import Any

import torch
from jsonargparse import auto_cli
from torchmetrics.functional.classification import binary_auroc, multiclass_calibration_error
from training.evaluate import COLUMNS, HEADS, fit_head, score

import igps
from igps.cli import errors_as_messages
from igps.data.splits import Split, SplitProtocol, split_seen, split_unseen
from igps.learning.fitting import Goal, classify, fit, split_head
from igps.nn.description import describe
from igps.nn.descriptor import Descriptor, EmbeddedDescriptor, HistogramDescriptor
from igps.nn.heads.classifier import ClassifierHead
from igps.retrieval import retrieval_scores

SEEDS = (200, 201, 202, 203, 204)


def splits(
    root: Path,
    descriptor: str = "pretrained",
    protocol: SplitProtocol = "seen",
    n_train: int = 10,
    seeds: Sequence[int] = SEEDS,
    cache_dir: Path | None = None,
    out: Path | None = None,
) -> None:
    """Print the scores of the plain chi-square distance and of the heads: mean ± standard deviation over splits.

    If the descriptor has a metric, as `pretrained` has, the metric is the prior of the heads.

    Args:
        root: labelled collection.
        descriptor: name of the descriptor.
        protocol: seen splits the shapes of every class, unseen splits the classes.
        n_train: shapes of each class (seen) or classes (unseen) to fit to.
        seeds: seed of each split.
        cache_dir: folder of cached signatures; by default the user's cache directory.
        out: a JSON file to which the rows are added.
    """
    module, prior = split_head(descriptor)
    cells = part_cells_of(module)
    dataset = igps.SignatureDataset(root, cache_dir=cache_dir, descriptor=module)
    dataset.precompute(strict=True)
    histograms = describe(dataset, module, progress=True).flatten(1)
    labels = dataset.labels
    scores: dict[str, list[dict[str, float]]] = {}
    for seed in seeds:
        split = draw_split(dataset, protocol, n_train, seed)
        scores.setdefault("none", []).append(score(histograms, labels, split))
        if prior is not None:
            scores.setdefault("prior", []).append(score(histograms, labels, split, prior))
        for name, head_class in HEADS.items():
            head = fit_head(head_class(prior=prior), histograms, labels, split, cells)
            scores.setdefault(name, []).append(score(histograms, labels, split, head))

    print(f"{descriptor}, {protocol}, n_train={n_train}, seeds {seeds}, percent")
    print(f"{'head':<10}" + "".join(f"{title:>14}" for title in COLUMNS.values()))
    rows: list[dict[str, Any]] = []
    for name, of_splits in scores.items():
        row = {column: spread([one[column] for one in of_splits]) for column in COLUMNS}
        cells_of_row = [
            f"{100 * value['mean']:>8.1f} ± {100 * value['stdev']:>3.1f}" for value in row.values()
        ]
        print(f"{name:<10}" + "".join(cells_of_row))
        rows.append({"descriptor": descriptor, "protocol": protocol, "head": name, **row})
    if out is not None:
        earlier = json.loads(out.read_text()) if out.exists() else []
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(json.dumps([*earlier, *rows], indent=1) + "\n")


def plain(
    root: Path,
    descriptor: str = "measures",
    n_train: int = 10,
    seeds: Sequence[int] = SEEDS,
    cache_dir: Path | None = None,
) -> None:
    """Print the scores of plain numbers, to which nothing is fitted, on the test parts of the same splits.

    Args:
        root: labelled collection.
        descriptor: "measures", or "measures+size".
        n_train: shapes of each class (seen) or classes (unseen) that are left out.
        seeds: seed of each split.
        cache_dir: folder of cached signatures; by default the user's cache directory.
    """
    module = igps.descriptor(descriptor)
    dataset = igps.SignatureDataset(root, cache_dir=cache_dir, descriptor=module)
    dataset.precompute(strict=True)
    vectors = describe(dataset, module)
    protocols: tuple[SplitProtocol, ...] = ("seen", "unseen")
    for protocol in protocols:
        scores = []
        for seed in seeds:
            test = torch.tensor(draw_split(dataset, protocol, n_train, seed).test)
            distances = module.distances(vectors[test], vectors[test])
            scores.append(retrieval_scores(distances, dataset.labels[test]).mean())
        for column, title in COLUMNS.items():
            value = spread([one[column] for one in scores])
            print(
                f"{protocol:<8}{title:<6}{100 * value['mean']:>6.1f} ± {100 * value['stdev']:.1f}"
            )


def fitted(
    root: Path,
    descriptor: str = "pretrained",
    n_train: int = 10,
    seeds: Sequence[int] = SEEDS,
    cache_dir: Path | None = None,
) -> None:
    """Print the scores of models that `igps fit` fits to the training part of several splits, in percent.

    Models of known classes are also scored as classifiers: by accuracy, by the expected calibration error, and by the
    area under the ROC curve for bodies of a class that is left out of the fit against all others, mean over classes.

    Args:
        root: labelled collection.
        descriptor: name of the descriptor.
        n_train: shapes of each class (known) or classes (new) to fit to.
        seeds: seed of each split.
        cache_dir: folder of cached signatures; by default the user's cache directory.
    """
    module = igps.descriptor(descriptor)
    dataset = igps.SignatureDataset(root, cache_dir=cache_dir, descriptor=module)
    dataset.precompute(strict=True)
    goals: tuple[Goal, ...] = ("known", "new")
    for goal in goals:
        protocol: SplitProtocol = "seen" if goal == "known" else "unseen"
        rows = []
        for seed in seeds:
            split = draw_split(dataset, protocol, n_train, seed)
            train = dataset.subset(split.train)
            test = dataset.subset(split.test)
            rows.append(score_fitted(train, test, descriptor, goal))
        for name in rows[0]:
            values = spread([row[name] for row in rows])
            print(
                f"{goal:<6}{name:<18}{100 * values['mean']:>6.1f} ± {100 * values['stdev']:.1f}",
                flush=True,
            )


def score_fitted(
    train: igps.SignatureDataset, test: igps.SignatureDataset, descriptor: str, goal: Goal
) -> dict[str, float]:
    """Fit a model to one dataset, and score it on another."""
    model = fit(train, descriptor, goal=goal)
    described = describe(test, model)
    scores = retrieval_scores(model.distances(described, described), test.labels).mean()
    result = {name: scores[name] for name in ("ft", "nn", "dcg")}
    if goal == "new":
        return result
    labels = test.labels
    probabilities = classify(test, model).probabilities
    n_classes = probabilities.shape[1]
    result["accuracy"] = float((probabilities.argmax(dim=1) == labels).float().mean())
    result["calibration_error"] = float(
        multiclass_calibration_error(probabilities, labels, n_classes, 10)
    )
    areas = []
    for label in labels.unique():
        is_known = train.labels != label
        others = train.subset(torch.nonzero(is_known).flatten().tolist())
        strangeness = classify(test, uncalibrated_classifier(others, descriptor)).strangeness
        areas.append(float(binary_auroc(strangeness, (labels == label).long())))
    return {**result, "unknown_auc": mean(areas)}


def uncalibrated_classifier(dataset: igps.SignatureDataset, descriptor: str) -> EmbeddedDescriptor:
    """Fit a classifier, without the calibration, on which strangeness does not depend."""
    base, prior = split_head(descriptor)
    histograms = describe(dataset, base).flatten(1)
    head = ClassifierHead(prior).fit(
        histograms, dataset.labels, part_cells_of(base), calibrate=False
    )
    return EmbeddedDescriptor(base, head)


def draw_split(
    dataset: igps.SignatureDataset, protocol: SplitProtocol, n_train: int, seed: int
) -> Split:
    """Split the shapes of each class, or the classes."""
    if protocol == "seen":
        return split_seen(dataset.labels, n_train, seed=seed)
    return split_unseen(dataset.labels, n_train, seed=seed)


def part_cells_of(descriptor: Descriptor) -> tuple[int, ...] | None:
    """Return the numbers of cells of the parts of a histogram descriptor, None for other descriptors."""
    return descriptor.part_cells if isinstance(descriptor, HistogramDescriptor) else None


def spread(values: Sequence[float]) -> dict[str, float]:
    """Return mean and standard deviation; 0 for a single value."""
    return {"mean": mean(values), "stdev": stdev(values) if len(values) > 1 else 0.0}


if __name__ == "__main__":
    with errors_as_messages():
        auto_cli([splits, fitted, plain])
