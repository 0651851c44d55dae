"""Scores of a metric on shapes to which it was not fitted, as printed by pretrain.py."""

from collections.abc import Sequence
from statistics import mean, stdev

import torch
from torch import Tensor

from igps.data.splits import split_seen
from igps.nn.heads.base import Head
from igps.nn.heads.closed_form import KernelHead
from igps.retrieval import chi_square, retrieval_scores

COLUMNS = ("nn", "ft", "st", "dcg")


def report(title: str, histograms: Tensor, labels: Tensor, head: Head) -> None:
    """Print the scores of the plain distance and of the head."""
    print(f"{title}\n{'':<12}" + "".join(f"{name.upper():>7}" for name in COLUMNS))
    plain = retrieval_scores(chi_square(histograms, histograms), labels).mean()
    for name, row in (("plain", plain), ("pretrained", scores(head, histograms, labels))):
        print(f"{name:<12}" + "".join(f"{100 * row[column]:>7.1f}" for column in COLUMNS))


def scores(head: Head, histograms: Tensor, labels: Tensor) -> dict[str, float]:
    """Return the leave-one-out scores of the distance of a head."""
    vectors = head(histograms)
    return retrieval_scores(head.distances(vectors, vectors), labels).mean()


def few_labels(
    n: int, histograms: Tensor, labels: Tensor, pretrained: Head, part_cells: Sequence[int]
) -> None:
    """Print FT of heads fitted to n shapes of each class, on the pretrained metric and from scratch."""
    ft: dict[str, list[float]] = {
        "pretrained, no labels": [],
        "from pretrained": [],
        "from scratch": [],
    }
    for seed in range(100, 105):
        split = split_seen(labels, n, seed=seed)
        train, test = torch.tensor(split.train), torch.tensor(split.test)
        fitted = {
            "from pretrained": KernelHead(pretrained),
            "from scratch": KernelHead(),
        }
        for head in fitted.values():
            head.fit(histograms[train], labels[train], part_cells)
        for name, other in {"pretrained, no labels": pretrained, **fitted}.items():
            ft[name].append(100 * scores(other, histograms[test], labels[test])["ft"])
    rows = ", ".join(
        f"{name} FT {mean(values):.1f} ± {stdev(values):.1f}" for name, values in ft.items()
    )
    print(f"{n} labels a class: {rows}")


def level_scores(name: str, parts: Sequence[tuple[Tensor, ...]]) -> None:
    """Print the mean scores of parts by level, and the standard deviation of the first tier over parts.

    Args:
        name: name of the row.
        parts: of each part, the distances, then the labels of each level: individuals, bodies and classes, or only
            bodies and classes.
    """
    rows = []
    names = ("individual", "body", "class")[4 - len(parts[0]) :]
    for place, level in enumerate(names, 1):
        results = [retrieval_scores(part[0], part[place]).mean() for part in parts]
        words = [
            f"{key.upper()} {100 * mean(row[key] for row in results):.1f}"
            for key in ("nn", "ft", "dcg")
        ]
        words[1] += f" ± {100 * stdev(row['ft'] for row in results):.1f}"
        rows.append(f"{level} " + " ".join(words))
    print(f"{name:<28}" + " | ".join(rows), flush=True)
