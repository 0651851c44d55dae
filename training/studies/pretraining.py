"""Fit the metric of the descriptor `pretrained` to generated shapes, and score it on held-out shapes."""

import random
from collections.abc import Sequence
from pathlib import Path

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

import igps
from igps.descriptors.pretrained.descriptor import PRETRAINED, pretrained_head, pretrained_parts
from igps.nn.description import describe
from igps.nn.descriptor import EmbeddedDescriptor
from igps.nn.heads.two_level import TwoLevelHead
from training.graded import GradedShapes, body_of, family_of, looks_alike
from training.studies.individuals import deal_families, fit_individuals, generated, number_names, usable_shapes
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
    keep: Path | None = None,
    out: Path = PRETRAINED,
    cache_dir: Path | None = None,
    plain: Sequence[str] = ("gps", "interior", "multiscale", "rich", "shape_dna"),
    data: Path | None = None,
    n_workers: int | None = None,
) -> None:
    """Generate shapes, score the metric on held-out families, fit it to all, and save it.

    Args:
        root: folder of the generated meshes; those of individuals are written to `ROOT-individuals`.
        n_classes, n_bodies, n_poses, seed: arguments of `GradedShapes`.
        n_parts: number of parts into which the families are dealt, by the seed. Whole families are held out, because
            classes of a fitted family are much easier to separate than the classes of users.
        n_scored: number of classes to score in each part, drawn by the seed.
        individuals: for the level of individuals, the numbers of classes, bodies of a class, individuals of a body, and
            poses of an individual.
        keep: file of parameters whose levels of classes and bodies are reused; only that of individuals is scored and
            fitted.
        out: file of the parameters.
        cache_dir: folder of cached signatures; the user's cache directory if not given.
        plain: descriptors to score on the same classes for comparison.
        data: labelled collection on which to score the metric, too.
        n_workers: processes; all cores if not given.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    descriptor = pretrained_parts().eval()

    def save(head: TwoLevelHead) -> TwoLevelHead:
        """Add the level of individuals to a head, save it and return it."""
        folder = root.with_name(f"{root.name}-individuals")
        complete = fit_individuals(head, descriptor, individuals, folder, n_parts, seed, plain, cache_dir, n_workers)
        save_pretrained(EmbeddedDescriptor(descriptor, complete), out)
        print(f"written: {out}")
        return complete

    if keep is not None:
        earlier = EmbeddedDescriptor(descriptor, pretrained_head(individuals=False))
        names = earlier.state_dict()
        earlier.load_state_dict({name: tensor.float() for name, tensor in load_file(keep).items() if name in names})
        assert isinstance(earlier.head, TwoLevelHead)
        save(earlier.head)
        return

    shapes = generated(GradedShapes(n_classes, n_bodies, n_poses, seed), root, descriptor, cache_dir, n_workers)
    histograms, labels = describe(shapes, descriptor, progress=True, n_workers=n_workers), shapes.labels
    bodies = number_names([body_of(name) for name in shapes.bodies.names])
    parts = deal_families([family_of(name) for name in shapes.classes], n_parts, seed)

    def fit(n: int, seed: int, classes: Tensor) -> TwoLevelHead:
        """Fit the metric to n of some classes, drawn by the seed."""
        chosen = torch.isin(labels, torch.tensor(_draw_classes(classes.tolist(), n, seed)))
        return pretrained_head(individuals=False).fit(
            histograms[chosen], labels[chosen], descriptor.part_cells, bodies=bodies[chosen]
        )

    scored = [torch.isin(labels, torch.tensor(_draw_classes(part.tolist(), n_scored, seed))) for part in parts]
    others = [torch.cat([*parts[:i], *parts[i + 1 :]]) for i in range(n_parts)]

    def score(name: str, distances: Sequence[Tensor]) -> None:
        level_scores(name, [(d, bodies[chosen], labels[chosen]) for d, chosen in zip(distances, scored, strict=True)])

    print(f"{n_parts} parts of the families, each scored by a metric that was fitted to the others:")
    is_look_alike = torch.tensor([looks_alike(name) for name in shapes.classes])  # of a class of SHREC'07
    unlike_others = [classes[~is_look_alike[classes]] for classes in others]
    variants = [("pretrained", others, others)]
    if min(map(len, unlike_others)) >= _MIN_CLASSES:
        variants += [
            ("without look-alikes", unlike_others, unlike_others), ("as many, with them", others, unlike_others)
        ]  # fmt: skip
    for name, pools, equally_many in variants:
        heads = [fit(len(classes), seed, pool) for pool, classes in zip(pools, equally_many, strict=True)]
        score(name, [_distances(head, histograms[part]) for head, part in zip(heads, scored, strict=True)])
    for name in plain:
        other = igps.descriptor(name)
        described = [
            describe(
                usable_shapes(root, other, cache_dir, n_workers, torch.nonzero(part).flatten().tolist()),
                other,
                n_workers=n_workers,
            )
            for part in scored
        ]
        score(name, [other.distances(x, x) for x in described])

    all_classes = torch.arange(len(shapes.classes))
    head = fit(len(all_classes), seed, all_classes)
    print(f"fitted to all {len(all_classes)} classes")
    head = save(head)
    if data is None:
        return

    real = usable_shapes(data, descriptor, cache_dir, n_workers)
    real_histograms, labels_of_real = describe(real, descriptor, progress=True, n_workers=n_workers), real.labels
    report(str(data), real_histograms, labels_of_real, head)
    unlike = all_classes[~is_look_alike]
    choices = (("without look-alikes", unlike), ("of all kinds", all_classes)) if len(unlike) >= _MIN_CLASSES else ()
    for name, classes in choices:
        title = f"{data}, fitted to {len(unlike)} classes {name}"
        report(title, real_histograms, labels_of_real, fit(len(unlike), seed, classes))
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


def _draw_classes(classes: Sequence[int], n: int, seed: int) -> list[int]:
    return random.Random(seed).sample(sorted(classes), min(n, len(classes)))


def _distances(head: TwoLevelHead, histograms: Tensor) -> Tensor:
    vectors = head(histograms)
    return head.distances(vectors, vectors)
