"""Fit the metric of the descriptor `pretrained` to generated shapes, and score it on held-out shapes.

    python -m training.pretrain --config configs/pretrain.yaml
    python -m training.pretrain --config configs/pretrain.yaml --data DATA

The first command makes the file that the package ships. It scores the metric on held-out families of generated classes
and individuals, beside the plain descriptors. The second command also scores it on a labelled collection, alone and
with a few labels of the collection.

The class head is fitted to one collection of shapes, the body heads to another one, of individuals that are nearly
alike. Whole families are held out, because classes of a fitted family are much easier to separate than the classes of
users. Of the held-out families, some classes of the first collection and all individuals of the second one are scored.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean, stdev

import torch
from jsonargparse import auto_cli
from safetensors.torch import save_file
from torch import Tensor

import igps
from igps.cli import errors_as_messages
from igps.data.splits import split_seen
from igps.descriptors.pretrained.descriptor import PRETRAINED, pretrained_head, pretrained_parts
from igps.nn.description import describe
from igps.nn.descriptor import Descriptor, EmbeddedDescriptor
from igps.nn.heads.base import Head
from igps.nn.heads.closed_form import KernelHead
from igps.nn.heads.two_level import TwoLevelHead
from igps.retrieval import chi_square, retrieval_scores
from training.generated import generated, number_names, usable_shapes
from training.shapes import GradedShapes, body_of, family_of, individual_of, looks_alike

# With two classes, each part has a single direction, and its vectors are signs, which may cancel.
MIN_CLASSES = 3
COLUMNS = ("nn", "ft", "st", "dcg")
# Labels of each class, and seeds of the splits, for the scores with few labels.
FEW_LABELS = (1, 3, 5)
FEW_LABELS_SEEDS = range(100, 105)


@dataclass(frozen=True)
class Settings:
    """The values of configs/pretrain.yaml.

    Args:
        root: folder of the generated meshes; those of individuals are written to `ROOT-individuals`.
        n_classes, n_bodies, n_poses, seed: arguments of `GradedShapes`.
        individuals: of the second collection, the numbers of classes, bodies of a class, individuals of a body, and
            poses of an individual.
        n_vertices: smallest and largest number of vertices of the second collection.
        n_parts: number of parts into which the families are dealt, by the seed.
        n_scored: number of classes to score in each part, drawn by the seed.
        plain: descriptors to score on the same shapes for comparison.
        out: file of the parameters.
        data: labelled collection on which to score the metric, too.
        cache_dir: folder of cached signatures; by default the user's cache directory.
        n_workers: processes; by default all cores.
    """

    root: Path
    n_classes: int
    n_bodies: int
    n_poses: int
    seed: int
    individuals: tuple[int, int, int, int]
    n_vertices: tuple[int, int]
    n_parts: int
    n_scored: int
    plain: tuple[str, ...]
    out: Path = PRETRAINED
    data: Path | None = None
    cache_dir: Path | None = None
    n_workers: int | None = None


@dataclass(frozen=True, eq=False)
class Collection:
    """N generated shapes with their histograms."""

    data: igps.SignatureDataset
    histograms: Tensor  # (N, ...)
    levels: dict[str, Tensor]  # by level from fine to coarse, the number (N,) of each shape's group
    parts: Tensor  # (N,) the part of each shape's family
    look_alikes: Tensor  # (N,) whether the class resembles one of SHREC'07

    def fitted_to(self, held_out: int | None, look_alikes: bool) -> Tensor:
        """Return a mask of the shapes outside a part, with or without look-alikes."""
        mask = torch.ones_like(self.look_alikes) if look_alikes else ~self.look_alikes
        return mask if held_out is None else mask & (self.parts != held_out)


def pretrain(settings: Settings) -> None:
    """Generate shapes, score the metric on held-out families, fit it to all, and save it."""
    settings.out.parent.mkdir(parents=True, exist_ok=True)
    classes, individuals = make_collections(settings)
    seed = settings.seed
    scored_classes = [
        draw_classes(classes, part, settings.n_scored, seed) for part in range(settings.n_parts)
    ]
    scored_individuals = [individuals.parts == part for part in range(settings.n_parts)]
    scored = [(classes, scored_classes), (individuals, scored_individuals)]

    print(
        f"{settings.n_parts} parts of the families, each scored by a metric that was fitted to the others:"
    )
    for name, look_alikes in (("pretrained", True), ("without look-alikes", False)):
        heads = [
            fit(classes, individuals, part, look_alikes=look_alikes)
            for part in range(settings.n_parts)
        ]
        for collection, masks in scored:
            score_heads(name, heads, collection, masks)
    for name in settings.plain:
        for collection, masks in scored:
            score_plain(igps.descriptor(name), collection, masks, settings)

    head = fit(classes, individuals)
    if head is None:
        raise ValueError(f"n_classes: expected at least {MIN_CLASSES}, got {settings.n_classes}.")
    save_pretrained(EmbeddedDescriptor(pretrained_parts().eval(), head), settings.out)
    print(f"fitted to all {settings.n_classes} classes and written: {settings.out}")
    if settings.data is not None:
        score_on(settings.data, head, fit(classes, individuals, look_alikes=False), settings)


def make_collections(settings: Settings) -> tuple[Collection, Collection]:
    """Generate and describe the shapes of classes, and those of individuals."""
    shapes = GradedShapes(settings.n_classes, settings.n_bodies, settings.n_poses, settings.seed)
    n_classes, n_bodies, n_individuals, n_poses = settings.individuals
    alike = GradedShapes(
        n_classes,
        n_bodies,
        n_poses,
        settings.seed,
        n_vertices=settings.n_vertices,
        n_individuals=n_individuals,
    )
    families = [family_of(name) for name in shapes.class_names + alike.class_names]
    part_of = deal_families(families, settings.n_parts, settings.seed)
    root = settings.root
    first = collect(shapes, root, part_of, settings)
    second = collect(alike, root.with_name(f"{root.name}-individuals"), part_of, settings)
    return first, second


def deal_families(families: Sequence[str], n_parts: int, seed: int) -> dict[str, int]:
    """Deal families into parts at random; return the part of each family."""
    names = sorted(set(families))
    random.Random(seed).shuffle(names)
    return {name: place % n_parts for place, name in enumerate(names)}


def collect(
    shapes: GradedShapes, root: Path, part_of: dict[str, int], settings: Settings
) -> Collection:
    """Write shapes to a folder and describe them."""
    descriptor = pretrained_parts().eval()
    data = generated(shapes, root, descriptor, settings.cache_dir, settings.n_workers)
    names = data.bodies.names
    levels = {}
    if shapes.n_individuals:
        levels["individual"] = number_names([individual_of(name) for name in names])
    levels["body"] = number_names([body_of(name) for name in names])
    levels["class"] = data.labels
    parts = torch.tensor([part_of[family_of(name)] for name in data.classes])
    look_alikes = torch.tensor([looks_alike(name) for name in data.classes])
    return Collection(
        data,
        describe(data, descriptor, progress=True, n_workers=settings.n_workers),
        levels,
        parts[data.labels],
        look_alikes[data.labels],
    )


def draw_classes(collection: Collection, part: int, n: int, seed: int) -> Tensor:
    """Return a mask of the shapes of at most n classes of a part, drawn by the seed."""
    labels = collection.levels["class"]
    classes = labels[collection.parts == part].unique().tolist()
    chosen = random.Random(seed).sample(classes, min(n, len(classes)))
    return torch.isin(labels, torch.tensor(chosen))


def fit(
    classes: Collection,
    individuals: Collection,
    held_out: int | None = None,
    look_alikes: bool = True,
) -> TwoLevelHead | None:
    """Fit the head to both collections, without a part, and perhaps without look-alikes; None if too few remain."""
    first = classes.fitted_to(held_out, look_alikes)
    second = individuals.fitted_to(held_out, look_alikes)
    labels = classes.levels["class"][first]
    if len(labels.unique()) < MIN_CLASSES or not second.any():
        return None
    return pretrained_head().fit(
        classes.histograms[first],
        labels,
        pretrained_parts().part_cells,
        bodies=individuals.levels["individual"][second],
        body_descriptions=individuals.histograms[second],
    )


def save_pretrained(module: EmbeddedDescriptor, path: str | Path) -> None:
    """Save `pretrained_parts` with a fitted `pretrained_head` as safetensors, the head in half precision."""
    state = {}
    for name, tensor in module.state_dict().items():
        is_halved = name.startswith("head.") and tensor.is_floating_point()
        state[name] = (tensor.half() if is_halved else tensor).contiguous()
    save_file(state, path)


def score_heads(
    name: str,
    heads: Sequence[TwoLevelHead | None],
    collection: Collection,
    masks: Sequence[Tensor],
) -> None:
    """Score the shapes of each part by the head that was not fitted to it, if there are enough shapes to fit to."""
    fitted = [head for head in heads if head is not None]
    if len(fitted) == len(heads):
        print_levels(
            name,
            collection,
            masks,
            lambda mask, part: distances_by(fitted[part], collection.histograms[mask]),
        )


def score_plain(
    descriptor: Descriptor, collection: Collection, masks: Sequence[Tensor], settings: Settings
) -> None:
    """Score the same shapes by another descriptor."""

    def distances(mask: Tensor, part: int) -> Tensor:
        names = collection.data.bodies.names
        chosen = [names[i] for i in mask.nonzero().flatten().tolist()]
        root = settings.root
        if "individual" in collection.levels:
            root = root.with_name(f"{root.name}-individuals")
        shapes = igps.SignatureDataset(root, descriptor=descriptor, cache_dir=settings.cache_dir)
        data = usable_shapes(shapes[chosen], settings.n_workers)
        described = describe(data, descriptor, n_workers=settings.n_workers)
        return descriptor.distances(described, described)

    print_levels(descriptor.name, collection, masks, distances)


def print_levels(
    name: str,
    collection: Collection,
    masks: Sequence[Tensor],
    distances: Callable[[Tensor, int], Tensor],
) -> None:
    """Print the mean scores of parts by level, and the standard deviation of the first tier over parts.

    Args:
        name: name of the row.
        collection: the shapes.
        masks: for each part, which shapes are scored.
        distances: a function of a mask and the number of its part.
    """
    by_part = [distances(mask, part) for part, mask in enumerate(masks)]
    cells = []
    for level, groups in collection.levels.items():
        scores = [
            retrieval_scores(matrix, groups[mask]).mean()
            for matrix, mask in zip(by_part, masks, strict=True)
        ]
        nn, ft, dcg = ([100 * row[key] for row in scores] for key in ("nn", "ft", "dcg"))
        cells.append(
            f"{level} NN {mean(nn):.1f} FT {mean(ft):.1f} ± {stdev(ft):.1f} DCG {mean(dcg):.1f}"
        )
    print(f"{name:<28}" + " | ".join(cells), flush=True)


def score_on(
    root: Path, head: TwoLevelHead, without_look_alikes: TwoLevelHead | None, settings: Settings
) -> None:
    """Print the scores of heads on a labelled collection, alone and with a few of its labels."""
    descriptor = pretrained_parts().eval()
    shapes = igps.SignatureDataset(root, descriptor=descriptor, cache_dir=settings.cache_dir)
    data = usable_shapes(shapes, settings.n_workers)
    histograms = describe(data, descriptor, progress=True, n_workers=settings.n_workers)
    labels = data.labels
    plain = retrieval_scores(chi_square(histograms, histograms), labels).mean()
    rows = {"plain": plain, "pretrained": scores_of(head, histograms, labels)}
    if without_look_alikes is not None:
        rows["without look-alikes"] = scores_of(without_look_alikes, histograms, labels)
    print(f"{root}\n{'':<20}" + "".join(f"{name.upper():>7}" for name in COLUMNS))
    for name, row in rows.items():
        print(f"{name:<20}" + "".join(f"{100 * row[column]:>7.1f}" for column in COLUMNS))
    smallest_class = int(labels.bincount().min())
    for n in FEW_LABELS:
        # At least two shapes of each class remain to be scored against each other.
        if n + 2 <= smallest_class:
            print_few_labels(n, histograms, labels, head)


def print_few_labels(n: int, histograms: Tensor, labels: Tensor, pretrained: Head) -> None:
    """Print FT of heads fitted to n shapes of each class, on the pretrained metric and from scratch."""
    part_cells = pretrained_parts().part_cells
    names = ("pretrained, no labels", "from pretrained", "from scratch")
    ft: dict[str, list[float]] = {name: [] for name in names}
    for seed in FEW_LABELS_SEEDS:
        split = split_seen(labels, n, seed=seed)
        train = torch.tensor(split.train)
        test = torch.tensor(split.test)
        fitted = [
            head.fit(histograms[train], labels[train], part_cells)
            for head in (KernelHead(pretrained), KernelHead())
        ]
        for name, head in zip(names, (pretrained, *fitted), strict=True):
            scores = scores_of(head, histograms[test], labels[test])
            ft[name].append(100 * scores["ft"])
    cells = [f"{name} FT {mean(values):.1f} ± {stdev(values):.1f}" for name, values in ft.items()]
    print(f"{n} labels a class: " + ", ".join(cells))


def scores_of(head: Head, histograms: Tensor, labels: Tensor) -> dict[str, float]:
    """Return the leave-one-out scores of the distance of a head."""
    return retrieval_scores(distances_by(head, histograms), labels).mean()


def distances_by(head: Head, histograms: Tensor) -> Tensor:
    """Return the distances of a head between all shapes."""
    vectors = head(histograms)
    return head.distances(vectors, vectors)


if __name__ == "__main__":
    with errors_as_messages():
        pretrain(auto_cli(Settings, as_positional=False))
