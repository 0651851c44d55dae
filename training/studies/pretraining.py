"""Fit the metric of the descriptor `pretrained` to generated shapes, and score it on held-out shapes."""

import random
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import Tensor

import igps
from igps.descriptors.pretrained.descriptor import PRETRAINED, pretrained_head, pretrained_parts
from igps.nn.description import describe
from igps.nn.descriptor import EmbeddedDescriptor
from igps.nn.heads.two_level import TwoLevelHead
from training.graded import GradedShapes, body_of, family_of, individual_of, looks_alike
from training.studies.generated import N_VERTICES, deal_families, generated, number_names, usable_shapes
from training.studies.transfer import few_labels, level_scores, report

# With two classes, each part has a single direction, and its vectors are signs, which may cancel.
_MIN_CLASSES = 3


def pretrain(
    root: Path = Path("build/pretrain"),
    n_classes: int = 240,
    n_bodies: int = 4,
    n_poses: int = 4,
    n_parts: int = 3,
    n_scored: int = 12,
    seed: int = 0,
    individuals: tuple[int, int, int, int] = (27, 2, 3, 3),
    out: Path = PRETRAINED,
    cache_dir: Path | None = None,
    plain: Sequence[str] = ("gps", "interior", "multiscale", "rich", "shape_dna"),
    data: Path | None = None,
    n_workers: int | None = None,
) -> None:
    """Generate shapes, score the metric on held-out families, fit it to all, and save it.

    The class head is fitted to one collection, the body heads to another one, of individuals that are nearly alike.

    Args:
        root: folder of the generated meshes; those of individuals are written to `ROOT-individuals`.
        n_classes, n_bodies, n_poses, seed: arguments of `GradedShapes`.
        n_parts: number of parts into which the families are dealt, by the seed. Whole families are held out, because
            classes of a fitted family are much easier to separate than the classes of users.
        n_scored: number of classes to score in each part, drawn by the seed.
        individuals: of the second collection, the numbers of classes, bodies of a class, individuals of a body, and
            poses of an individual.
        out: file of the parameters.
        cache_dir: folder of cached signatures; the user's cache directory if not given.
        plain: descriptors to score on the same classes for comparison.
        data: labelled collection on which to score the metric, too.
        n_workers: processes; all cores if not given.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    descriptor = pretrained_parts().eval()
    shapes = generated(GradedShapes(n_classes, n_bodies, n_poses, seed), root, descriptor, cache_dir, n_workers)
    histograms, labels = describe(shapes, descriptor, progress=True, n_workers=n_workers), shapes.labels
    bodies = _numbers(shapes, body_of)
    second_root = root.with_name(f"{root.name}-individuals")
    second = GradedShapes(*individuals[:2], individuals[3], seed, n_vertices=N_VERTICES, n_individuals=individuals[2])
    alike = generated(second, second_root, descriptor, cache_dir, n_workers)
    histograms_alike = describe(alike, descriptor, progress=True, n_workers=n_workers)
    individuals_alike, bodies_alike = _numbers(alike, individual_of), _numbers(alike, body_of)
    parts = deal_families([family_of(name) for name in shapes.classes], n_parts, seed)
    families = [{family_of(shapes.classes[i]) for i in part.tolist()} for part in parts]
    parts_alike = [
        torch.tensor([family_of(alike.classes[i]) in held_out for i in alike.labels.tolist()]) for held_out in families
    ]

    def fit(classes: Tensor, n: int, held_out: Tensor) -> TwoLevelHead:
        """Fit the metric to n of some classes, drawn by the seed, and to all individuals that are not held out."""
        chosen = torch.isin(labels, torch.tensor(_draw_classes(classes.tolist(), n, seed)))
        return pretrained_head().fit(
            histograms[chosen],
            labels[chosen],
            descriptor.part_cells,
            bodies=individuals_alike[~held_out],
            body_descriptions=histograms_alike[~held_out],
        )

    scored = [torch.isin(labels, torch.tensor(_draw_classes(part.tolist(), n_scored, seed))) for part in parts]
    others = [torch.cat([*parts[:i], *parts[i + 1 :]]) for i in range(n_parts)]
    is_look_alike = torch.tensor([looks_alike(name) for name in shapes.classes])  # of a class of SHREC'07
    unlike_others = [classes[~is_look_alike[classes]] for classes in others]
    resembling = torch.tensor([looks_alike(name) for name in alike.classes])[alike.labels]
    variants = [("pretrained", others, others, parts_alike)]
    if min(map(len, unlike_others)) >= _MIN_CLASSES:
        variants += [
            ("without look-alikes", unlike_others, unlike_others, [part | resembling for part in parts_alike]),
            ("as many, with them", others, unlike_others, parts_alike),
        ]
    print(f"{n_parts} parts of the families, each scored by a metric that was fitted to the others:")

    def score(name: str, distances: Sequence[Tensor]) -> None:
        level_scores(name, [(d, bodies[chosen], labels[chosen]) for d, chosen in zip(distances, scored, strict=True)])

    def score_alike(name: str, distances: Sequence[Tensor]) -> None:
        levels = (individuals_alike, bodies_alike, alike.labels)
        parted = zip(distances, parts_alike, strict=True)
        level_scores(name, [(d, *(level[part] for level in levels)) for d, part in parted])

    for name, pools, equally_many, held_out in variants:
        counts = [len(classes) for classes in equally_many]
        heads = [fit(*arguments) for arguments in zip(pools, counts, held_out, strict=True)]
        score(name, [_distances(head, histograms[part]) for head, part in zip(heads, scored, strict=True)])
        score_alike(name, [_distances(x, histograms_alike[part]) for x, part in zip(heads, parts_alike, strict=True)])
    for name in plain:
        other = igps.descriptor(name)
        for folder, chosen, print_scores in ((root, scored, score), (second_root, parts_alike, score_alike)):
            datasets = [
                usable_shapes(folder, other, cache_dir, n_workers, torch.nonzero(part).flatten().tolist())
                for part in chosen
            ]
            described = [describe(dataset, other, n_workers=n_workers) for dataset in datasets]
            print_scores(name, [other.distances(x, x) for x in described])

    all_classes, nothing = torch.arange(len(shapes.classes)), torch.zeros(len(alike), dtype=torch.bool)
    head = fit(all_classes, len(all_classes), nothing)
    save_pretrained(EmbeddedDescriptor(descriptor, head), out)
    print(f"fitted to all {len(all_classes)} classes and written: {out}")
    if data is None:
        return

    real = usable_shapes(data, descriptor, cache_dir, n_workers)
    real_histograms, labels_of_real = describe(real, descriptor, progress=True, n_workers=n_workers), real.labels
    report(str(data), real_histograms, labels_of_real, head)
    unlike = all_classes[~is_look_alike]
    choices = ("without look-alikes", unlike, resembling), ("of all kinds", all_classes, nothing)
    for name, classes, left_out in choices if len(unlike) >= _MIN_CLASSES else ():
        title = f"{data}, fitted to {len(unlike)} classes {name}"
        report(title, real_histograms, labels_of_real, fit(classes, len(unlike), left_out))
    # At least two shapes of each class remain to be scored against each other
    for n in (n for n in (1, 3, 5) if n + 2 <= int(labels_of_real.bincount().min())):
        few_labels(n, real_histograms, labels_of_real, head, descriptor.part_cells)


def save_pretrained(module: EmbeddedDescriptor, path: str | Path) -> None:
    """Save `pretrained_parts` with a fitted `pretrained_head` as safetensors, the head in half precision."""
    state = {
        name: (tensor.half() if name.startswith("head.") and tensor.is_floating_point() else tensor).contiguous()
        for name, tensor in module.state_dict().items()
    }
    save_file(state, path)


def _numbers(shapes: igps.SignatureDataset, of: Callable[[str], str]) -> Tensor:
    """Number the bodies or individuals of generated shapes by their names."""
    return number_names([of(name) for name in shapes.bodies.names])


def _draw_classes(classes: Sequence[int], n: int, seed: int) -> list[int]:
    return random.Random(seed).sample(sorted(classes), min(n, len(classes)))


def _distances(head: TwoLevelHead, histograms: Tensor) -> Tensor:
    vectors = head(histograms)
    return head.distances(vectors, vectors)
