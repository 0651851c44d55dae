"""Fit the metric of the descriptor `pretrained` to generated shapes, and score it on held-out shapes."""

import random
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import Tensor

import igps
from igps.descriptors.pretrained.descriptor import PRETRAINED, pretrained_head, pretrained_parts
from igps.nn.description import describe
from igps.nn.descriptor import Descriptor, EmbeddedDescriptor
from igps.nn.heads.two_level import TwoLevelHead
from training.graded import GradedShapes, body_of, family_of, individual_of, looks_alike
from training.studies.generated import (
    N_VERTICES,
    deal_families,
    generated,
    number_names,
    usable_shapes,
)
from training.studies.transfer import few_labels, level_scores, report

# With two classes, each part has a single direction, and its vectors are signs, which may cancel.
_MIN_CLASSES = 3
_NO_PART = -1


class _Collection:
    """Generated shapes with their histograms.

    Args:
        shapes: the shapes.
        root: folder of their meshes.
        part_of: the part of each family.
        cache_dir: folder of cached signatures; the user's cache directory if not given.
        n_workers: processes; all cores if not given.
    """

    def __init__(
        self,
        shapes: GradedShapes,
        root: Path,
        part_of: Mapping[str, int],
        cache_dir: Path | None,
        n_workers: int | None,
    ) -> None:
        descriptor = pretrained_parts().eval()
        data = generated(shapes, root, descriptor, cache_dir, n_workers)
        self.root, self.names, self.labels = root, data.bodies.names, data.labels
        self.histograms = describe(data, descriptor, progress=True, n_workers=n_workers)
        of_levels = (individual_of, body_of) if shapes.n_individuals else (body_of,)
        self.levels = (
            *(number_names([of(name) for name in self.names]) for of in of_levels),
            self.labels,
        )
        self.parts = torch.tensor([part_of[family_of(name)] for name in data.classes])[self.labels]
        self.are_look_alikes = torch.tensor([looks_alike(name) for name in data.classes])[
            self.labels
        ]

    def draw_classes(self, part: int, n: int, seed: int) -> Tensor:
        """Return a mask of the shapes of at most n classes of a part, drawn by the seed."""
        classes = self.labels[self.parts == part].unique().tolist()
        return torch.isin(
            self.labels, torch.tensor(random.Random(seed).sample(classes, min(n, len(classes))))
        )


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

    The class head is fitted to one collection, the body heads to another one, of individuals that are nearly alike. Of
    the held-out families, some classes of the first collection and all individuals of the second one are scored.

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
        plain: descriptors to score on the same shapes for comparison.
        data: labelled collection on which to score the metric, too.
        n_workers: processes; all cores if not given.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    descriptor = pretrained_parts().eval()
    shapes = (
        GradedShapes(n_classes, n_bodies, n_poses, seed),
        GradedShapes(
            *individuals[:2],
            individuals[3],
            seed,
            n_vertices=N_VERTICES,
            n_individuals=individuals[2],
        ),
    )
    part_of = deal_families(
        [family_of(name) for one in shapes for name in one.class_names], n_parts, seed
    )
    first, second = (
        _Collection(one, folder, part_of, cache_dir, n_workers)
        for one, folder in zip(
            shapes, (root, root.with_name(f"{root.name}-individuals")), strict=True
        )
    )

    def chosen(held_out: int, look_alikes: bool) -> tuple[Tensor, Tensor]:
        """Return masks of the shapes of both collections, without a part, and perhaps without look-alikes."""
        masks = [
            (x.parts != held_out) & (look_alikes | ~x.are_look_alikes) for x in (first, second)
        ]
        return masks[0], masks[1]

    def suffice(of_first: Tensor, of_second: Tensor) -> bool:
        return len(first.labels[of_first].unique()) >= _MIN_CLASSES and bool(of_second.any())

    def fit(of_first: Tensor, of_second: Tensor) -> TwoLevelHead:
        return pretrained_head().fit(
            first.histograms[of_first],
            first.labels[of_first],
            descriptor.part_cells,
            bodies=second.levels[0][of_second],
            body_descriptions=second.histograms[of_second],
        )

    scored = [
        (first, [first.draw_classes(part, n_scored, seed) for part in range(n_parts)]),
        (second, [second.parts == part for part in range(n_parts)]),
    ]

    def score(name: str, distances: Callable[[_Collection, Tensor, int], Tensor]) -> None:
        """Print the scores of distances between the shapes of a collection that a mask chooses from a part."""
        for collection, masks in scored:
            level_scores(
                name,
                [
                    (
                        distances(collection, mask, part),
                        *(level[mask] for level in collection.levels),
                    )
                    for part, mask in enumerate(masks)
                ],
            )

    def score_heads(name: str, heads: Sequence[TwoLevelHead]) -> None:
        score(
            name,
            lambda collection, mask, part: _distances(heads[part], collection.histograms[mask]),
        )

    def score_plain(other: Descriptor) -> None:
        def distances(collection: _Collection, mask: Tensor, part: int) -> Tensor:
            names = [collection.names[i] for i in mask.nonzero().flatten().tolist()]
            data = usable_shapes(collection.root, other, cache_dir, n_workers, names)
            described = describe(data, other, n_workers=n_workers)
            return other.distances(described, described)

        score(other.name, distances)

    print(
        f"{n_parts} parts of the families, each scored by a metric that was fitted to the others:"
    )
    for name, look_alikes in (("pretrained", True), ("without look-alikes", False)):
        masks = [chosen(part, look_alikes) for part in range(n_parts)]
        if all(suffice(*each) for each in masks):
            score_heads(name, [fit(*each) for each in masks])
    for name in plain:
        score_plain(igps.descriptor(name))

    head = fit(*chosen(_NO_PART, True))
    save_pretrained(EmbeddedDescriptor(descriptor, head), out)
    print(f"fitted to all {n_classes} classes and written: {out}")
    if data is None:
        return

    real = usable_shapes(data, descriptor, cache_dir, n_workers)
    real_histograms, labels_of_real = (
        describe(real, descriptor, progress=True, n_workers=n_workers),
        real.labels,
    )
    report(str(data), real_histograms, labels_of_real, head)
    unlike = chosen(_NO_PART, False)
    if suffice(*unlike):
        report(f"{data}, without look-alikes", real_histograms, labels_of_real, fit(*unlike))
    # At least two shapes of each class remain to be scored against each other
    for n in (n for n in (1, 3, 5) if n + 2 <= int(labels_of_real.bincount().min())):
        few_labels(n, real_histograms, labels_of_real, head, descriptor.part_cells)


def save_pretrained(module: EmbeddedDescriptor, path: str | Path) -> None:
    """Save `pretrained_parts` with a fitted `pretrained_head` as safetensors, the head in half precision."""
    state = {
        name: (
            tensor.half() if name.startswith("head.") and tensor.is_floating_point() else tensor
        ).contiguous()
        for name, tensor in module.state_dict().items()
    }
    save_file(state, path)


def _distances(head: TwoLevelHead, histograms: Tensor) -> Tensor:
    vectors = head(histograms)
    return head.distances(vectors, vectors)
