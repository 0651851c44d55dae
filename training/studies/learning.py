"""Retrieval scores over several seeded splits, and of a trained checkpoint."""

import json
from collections.abc import Sequence
from pathlib import Path
from statistics import mean, stdev
from typing import Any, Literal

import torch
from torch import Tensor
from torchmetrics.functional.classification import binary_auroc, multiclass_calibration_error

import igps
from igps.data.datamodule import SignatureDataModule
from igps.data.splits import Split, SplitProtocol, split_seen, split_unseen
from igps.descriptors.fingerprint import cache_tag
from igps.learning.fitting import Goal, classify, fit, split_head
from igps.nn.description import describe
from igps.nn.descriptor import Descriptor, EmbeddedDescriptor, HistogramDescriptor
from igps.nn.heads.base import Head
from igps.nn.heads.classifier import ClassifierHead
from igps.nn.heads.closed_form import KernelHead, WhitenedHead
from igps.nn.learner import RetrievalLearner
from igps.retrieval import chi_square, retrieval_scores
from training.studies.learned_figures import learned_layout

Row = Literal["none", "prior", "whitened", "kernel"]
FITTED: dict[str, type[WhitenedHead | KernelHead]] = {
    "whitened": WhitenedHead,
    "kernel": KernelHead,
}
COLUMNS = {"ft": "FT", "nn": "NN", "dcg": "DCG", "st": "ST", "adr": "ADR", "map": "mAP"}


def splits(
    root: Path,
    descriptor: str = "interior",
    protocol: SplitProtocol = "seen",
    n_train: int = 10,
    n_splits: int = 5,
    first_seed: int = 100,
    cache_dir: Path | None = None,
    out: Path | None = None,
) -> None:
    """Print the scores of the plain chi-square distance and of the heads: mean ± standard deviation over splits.

    Args:
        root: labelled collection.
        descriptor: name of the descriptor.
        protocol: seen splits the shapes of every class, unseen splits the classes.
        n_train: shapes of each class (seen) or classes (unseen) to fit to.
        n_splits: number of splits, with consecutive seeds.
        first_seed: seed of the first split.
        cache_dir: folder of cached signatures; the user's cache directory if not given.
        out: a JSON file to which the rows are added.
    """
    module, prior = split_head(descriptor)
    cells = part_cells_of(module)
    dataset = igps.SignatureDataset(root, cache_dir=cache_dir, descriptor=module)
    dataset.precompute(strict=True)
    histograms, labels = describe(dataset, module, progress=True).flatten(1), dataset.labels
    print(
        f"{descriptor}, {protocol}, n_train={n_train}, {n_splits} splits from seed {first_seed}, percent"
    )
    print(f"{'head':<10}" + "".join(f"{title:>14}" for title in COLUMNS.values()))
    rows: list[dict[str, Any]] = []
    for head in ("none", "prior", "whitened", "kernel"):
        if head == "prior" and prior is None:
            continue
        results = []
        for seed in range(first_seed, first_seed + n_splits):
            split = (split_seen if protocol == "seen" else split_unseen)(labels, n_train, seed=seed)
            results.append(score(histograms, labels, split, head, cells, prior))
        values = {name: [result[name] for result in results] for name in COLUMNS}
        columns = {
            name: {"mean": mean(v), "stdev": stdev(v) if n_splits > 1 else 0.0}
            for name, v in values.items()
        }
        print(
            f"{head:<10}"
            + "".join(
                f"{100 * v['mean']:>8.1f} ± {100 * v['stdev']:>3.1f}" for v in columns.values()
            )
        )
        rows.append({"descriptor": descriptor, "protocol": protocol, "head": head, **columns})
    if out is not None:
        earlier = json.loads(out.read_text()) if out.exists() else []
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(json.dumps([*earlier, *rows], indent=1) + "\n")


def score(
    histograms: Tensor,
    labels: Tensor,
    split: Split,
    head: Row,
    part_cells: Sequence[int] | None,
    prior: Head | None = None,
) -> dict[str, float]:
    """Return the mean scores of the test part, each shape against the others."""
    train, test = torch.tensor(split.train), torch.tensor(split.test)
    chosen = prior if head == "prior" else None
    if head in FITTED:
        chosen = FITTED[head](prior=prior).fit(histograms[train], labels[train], part_cells)
    distance = chi_square if chosen is None else chosen.distances
    vectors = histograms[test] if chosen is None else chosen(histograms[test])
    return retrieval_scores(distance(vectors, vectors), labels[test]).mean()


def fitted(
    root: Path,
    descriptor: str = "pretrained",
    n_train: int = 10,
    n_splits: int = 5,
    first_seed: int = 100,
    cache_dir: Path | None = None,
) -> None:
    """Print the scores of models that `igps fit` fits to the training part of several splits, in percent.

    Models of known classes are also scored as classifiers: by accuracy, by the expected calibration error, and by the
    area under the ROC curve for bodies of a class that is left out of the fit against all others, mean over classes.

    Args:
        root: labelled collection.
        descriptor: name of the descriptor.
        n_train: shapes of each class (known) or classes (new) to fit to.
        n_splits: number of splits, with consecutive seeds.
        first_seed: seed of the first split.
        cache_dir: folder of cached signatures; the user's cache directory if not given.
    """
    dataset = igps.SignatureDataset(
        root, cache_dir=cache_dir, descriptor=igps.descriptor(descriptor)
    )
    dataset.precompute(strict=True)
    goals: tuple[Goal, ...] = ("known", "new")
    for goal in goals:
        rows = [
            _fitted(dataset, descriptor, goal, n_train, first_seed + i) for i in range(n_splits)
        ]
        for name in rows[0]:
            values = [100 * row[name] for row in rows]
            print(
                f"{goal:<6}{name:<18}{mean(values):>6.1f} ± {stdev(values) if n_splits > 1 else 0:.1f}"
            )


def _fitted(
    dataset: igps.SignatureDataset, descriptor: str, goal: Goal, n_train: int, seed: int
) -> dict[str, float]:
    split = (split_seen if goal == "known" else split_unseen)(dataset.labels, n_train, seed=seed)
    train, test = dataset.subset(split.train), dataset.subset(split.test)
    model = fit(train, descriptor, goal=goal)
    described = describe(test, model, cache_tag=cache_tag(model))
    scores = retrieval_scores(model.distances(described, described), test.labels).mean()
    result = {name: scores[name] for name in ("ft", "nn", "dcg")}
    if goal == "new":
        return result
    probabilities, labels = classify(test, model).probabilities, test.labels
    result["accuracy"] = float((probabilities.argmax(dim=1) == labels).float().mean())
    n_classes = probabilities.shape[1]
    result["calibration_error"] = float(
        multiclass_calibration_error(probabilities, labels, n_classes, 10)
    )
    areas = []
    for label in labels.unique():
        others = train.subset(torch.nonzero(train.labels != label).flatten().tolist())
        strangeness = classify(test, _classifier(others, descriptor)).strangeness
        areas.append(float(binary_auroc(strangeness, (labels == label).long())))
    return {**result, "unknown_auc": mean(areas)}


def _classifier(dataset: igps.SignatureDataset, descriptor: str) -> EmbeddedDescriptor:
    base, prior = split_head(descriptor)
    histograms = describe(dataset, base, cache_tag=cache_tag(base)).flatten(1)
    head = ClassifierHead(prior).fit(
        histograms, dataset.labels, part_cells_of(base), calibrate=False
    )
    return EmbeddedDescriptor(base, head)


def part_cells_of(descriptor: Descriptor) -> tuple[int, ...] | None:
    """Return the numbers of cells of the parts of a histogram descriptor, None for other descriptors."""
    return descriptor.part_cells if isinstance(descriptor, HistogramDescriptor) else None


def checkpoint(path: Path, out: Path = Path("build/evaluation")) -> None:
    """Print the scores of a checkpoint on the test part of its split, and draw what it has learned.

    "plain" is the distance of its histograms without the head, and "learned" that with the head. "whitened" and
    "kernel" are heads fitted to the histograms of its training and validation parts.

    Args:
        path: path of the checkpoint.
        out: folder for layout.png, a picture of the learned bins and filter beside the initial ones.
    """
    learner = RetrievalLearner.load_from_checkpoint(path).eval()
    data = SignatureDataModule.load_from_checkpoint(path)
    data.prepare_data()
    histograms, labels = (
        describe(data.dataset, learner.descriptor, progress=True),
        data.dataset.labels,
    )
    test = torch.tensor(data.split.test)
    part = histograms[test]
    results = {"plain": retrieval_scores(learner.distance.plain(part, part), labels[test]).mean()}
    with torch.inference_mode():
        results["learned"] = retrieval_scores(learner.distances(part, part), labels[test]).mean()
    # The validation part was not used to choose anything on which these heads depend
    split = Split(data.split.train + data.split.validation, (), data.split.test)
    for head in ("whitened", "kernel"):
        results[head] = score(histograms.flatten(1), labels, split, head, learner.part_cells)
    print(f"{'':<10}" + "".join(f"{title:>8}" for title in COLUMNS.values()))
    for name, scores in results.items():
        print(f"{name:<10}" + "".join(f"{100 * scores[column]:>8.1f}" for column in COLUMNS))
    if isinstance(learner.descriptor, HistogramDescriptor):
        out.mkdir(parents=True, exist_ok=True)
        learned_layout(learner.descriptor, out / "layout.png")
        print(f"learned bins and filter: {out / 'layout.png'}")
