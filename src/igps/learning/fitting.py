"""Fitting of metrics and classifiers to a labelled collection, and classification with them."""

import copy
import importlib.metadata
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from statistics import fmean
from typing import Literal, get_args

import torch
from torch import Tensor

from igps._parameters import check_one_of
from igps.data.dataset import Failure, SignatureDataset
from igps.data.sources import Bodies
from igps.descriptors import descriptor as descriptor_of
from igps.descriptors.fingerprint import cache_tag
from igps.descriptors.size_and_side import SizeAndSide
from igps.descriptors.sized_histograms import SizedHistograms
from igps.nn.description import check_centres, describe
from igps.nn.descriptor import Descriptor, EmbeddedDescriptor, HistogramDescriptor
from igps.nn.heads import ClassifierHead, Head, WhitenedHead
from igps.nn.heads.classifier import folds
from igps.retrieval import chi_square, retrieval_scores

Goal = Literal["known", "new"]
HeadName = Literal["auto", "classifier", "whitened", "as_is"]
# Heads that "auto" chooses from, by the goal
_CANDIDATES: Mapping[Goal, tuple[HeadName, ...]] = {
    "known": ("classifier", "whitened"),
    "new": ("whitened", "as_is"),
}
# Weights of the prior beside a WhitenedHead: equal for new classes, smaller for classes that the head is fitted to
_PRIOR_SHARES: Mapping[Goal, float] = {"new": 0.5, "known": 1 / 3}
_N_FOLDS, _N_INNER_FOLDS = (
    5,
    3,
)  # for the held-out scores, and within them for the choice of the head
_N_BINS = 10  # of the expected calibration error
_MAX_SCALE_BODIES = 1000  # bodies whose distances determine the scale


@dataclass(frozen=True, eq=False)
class Classification:
    """Classes of N bodies by a classifier of C classes."""

    names: tuple[str, ...]  # of the bodies
    classes: tuple[str, ...]  # of the classifier
    probabilities: Tensor  # (N, C), calibrated
    strangeness: Tensor  # (N,), larger for bodies that are less like every class
    unknown: Tensor  # (N,) whether a body is unlike every class

    @property
    def predicted(self) -> list[str | None]:
        """The most probable class of each body; None for an unknown body."""
        best = zip(self.probabilities.argmax(dim=1).tolist(), self.unknown.tolist(), strict=True)
        return [None if is_unknown else self.classes[i] for i, is_unknown in best]


def split_head(which: str | Descriptor) -> tuple[Descriptor, Head | None]:
    """Return the histograms of a descriptor, to which heads are fitted, and its own head, if any."""
    module = descriptor_of(which)
    module = module.without_size() if isinstance(module, SizedHistograms) else module
    return (
        (module.descriptor, module.head)
        if isinstance(module, EmbeddedDescriptor)
        else (module, None)
    )


def fit(
    dataset: SignatureDataset,
    descriptor: str | Descriptor = "pretrained",
    *,
    goal: Goal = "known",
    head: HeadName = "auto",
    prior: bool = True,
    failures: list[Failure] | None = None,
    n_workers: int | None = None,
    progress: bool = False,
) -> Descriptor:
    """Fit a head to the classes of a dataset, and return the descriptor under this head.

    The `card` of the result holds scores on folds that neither the fit nor the choice of the head has seen. The
    returned head is fitted to all bodies.

    Example:
        >>> import tempfile
        >>> from igps.shapes import ArticulatedShapes
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = ArticulatedShapes(n_classes=2, n_per_class=4, n_vertices=600).write(f"{folder}/shapes")
        ...     interior = descriptor_of("interior")
        ...     dataset = SignatureDataset(f"{folder}/shapes", descriptor=interior, cache_dir=f"{folder}/cache")
        ...     model = fit(dataset, interior, head="whitened", n_workers=1)
        >>> model.name, sorted(model.card["classes"].values())
        ('interior_whitened', [4, 4])

    Args:
        dataset: labelled bodies.
        descriptor: histograms, or histograms under a head, which is then the prior.
        goal: "known" to recognise the classes of the dataset, scored by holding out bodies of each class; "new" for a
            metric that also serves other classes, scored by holding out whole classes.
        head: "classifier" (`ClassifierHead`), "whitened" (`WhitenedHead`), or "as_is" for the descriptor itself; "auto"
            takes the head with the largest FT score on held-out bodies.
        prior: whether the new head also uses the descriptor's own head.
        failures: list to which bodies that cannot be described are appended; None raises for the first such body.
        n_workers: threads or processes that describe bodies; all cores if None.
        progress: whether to show a progress bar.

    Raises:
        ValueError: no labels, too few bodies or classes, or a descriptor without histograms.
    """
    check_one_of(get_args(Goal), goal=goal)
    check_one_of(get_args(HeadName), head=head)
    module = descriptor_of(descriptor)
    individual = {
        "size": isinstance(module, SizedHistograms),
        "side": False,
    }  # numbers that bypass the head
    if isinstance(module, SizeAndSide):
        individual = {"size": module.keeps_size, "side": module.twists is not None}
        module = module.descriptor
    base, metric = split_head(module)
    check_centres(base)
    check_classes(dataset.bodies, goal)
    base, metric = (
        copy.deepcopy(base),
        metric if prior else None,
    )  # the caller's descriptor stays unchanged
    histograms, dataset = _histograms(dataset, base, failures, n_workers, progress)
    check_classes(dataset.bodies, goal)  # without the bodies that could not be described
    labels, counts = dataset.labels, Counter(dataset.bodies.labels)
    names = tuple(dataset.classes[int(i)] for i in labels.unique())
    cells = base.part_cells if isinstance(base, HistogramDescriptor) else None

    def fit_head(name: HeadName, x: Tensor, y: Tensor, calibrate: bool = True) -> Head | None:
        if name == "classifier":
            return ClassifierHead(metric, names=names).fit(x, y, cells, calibrate=calibrate)
        if name == "whitened":
            return WhitenedHead(prior=metric, prior_share=_PRIOR_SHARES[goal]).fit(x, y, cells)
        return metric

    def choose_head(x: Tensor, y: Tensor) -> HeadName:
        if head != "auto":
            return head
        masks = [
            out
            for out in _held_out(y, goal, _N_INNER_FOLDS)
            if _has_pair(y[out]) and _has_pair(y[~out])
        ]

        def mean_ft(name: HeadName) -> float:
            heads = ((fit_head(name, x[~out], y[~out], False), out) for out in masks)
            return fmean(_retrieval_means(fitted, x[out], y[out])["ft"] for fitted, out in heads)

        return max(_CANDIDATES[goal], key=mean_ft) if masks else _CANDIDATES[goal][0]

    scores = _held_out_scores(histograms, labels, goal, choose_head, fit_head)
    name = choose_head(histograms, labels)
    new_head = fit_head(name, histograms, labels)
    model: Descriptor = base
    if new_head is not None:
        model = EmbeddedDescriptor(base, new_head, name=f"{base.name}_{name}").eval()
    first, first_labels = histograms[:_MAX_SCALE_BODIES], labels[:_MAX_SCALE_BODIES]
    vectors = first if new_head is None else new_head(first)
    # Only pairs of different classes, because the fit draws bodies of its classes closer together than later bodies
    is_measured = first_labels[:, None] != first_labels
    scale = float(model.distances(vectors, vectors)[is_measured].median()) / 5
    if any(individual.values()):
        model = SizeAndSide(model, scale=scale, **individual).eval()
    model.scale = scale
    model.card = {
        "scale": scale,
        "descriptor": descriptor if isinstance(descriptor, str) else descriptor.name,
        "goal": goal,
        "head": name,
        "prior": metric is not None,
        "classes": {name: counts[name] for name in names},
        "held_out_scores": scores,
        "signature": dataset.config.as_dict(),
        "reading": dataset.reading.as_dict(),
        "version": importlib.metadata.version("interior-gps"),
    }
    return model


def check_classes(bodies: Bodies, goal: Goal) -> None:
    """Raise a ValueError if there are too few classes, or no class of two bodies."""
    counts, min_classes = Counter(bodies.labels), 2 if goal == "known" else 4
    if len(counts) < min_classes or max(counts.values()) < 2:
        raise ValueError(
            f"classes: expected at least {min_classes}, one of them of two bodies, got {dict(counts)}."
        )


def classify(
    dataset: SignatureDataset,
    model: str | Descriptor,
    *,
    failures: list[Failure] | None = None,
    n_workers: int | None = None,
    progress: bool = False,
) -> Classification:
    """Classify the bodies of a dataset by a model with a classifier, see `fit`.

    Args:
        dataset: bodies, labelled or not.
        model: the model, or its file.
        failures, n_workers, progress: see `fit`.

    Raises:
        ValueError: the model has no classifier.
    """
    base, head = classifier_of(model)
    names = head.names or tuple(map(str, head.classes.tolist()))
    if len(names) != len(head.classes):
        raise ValueError(
            f"model: expected names of {len(head.classes)} classes, got {len(names)}. Fit it again."
        )
    histograms, dataset = _histograms(dataset, base, failures, n_workers, progress)
    strangeness = head.strangeness(histograms)
    return Classification(
        dataset.bodies.names,
        names,
        head.probabilities(histograms),
        strangeness,
        strangeness > head.strange_from,
    )


def classifier_of(model: str | Descriptor) -> tuple[Descriptor, ClassifierHead]:
    """Return the descriptor of a model and its classifier; raise a ValueError if it has no classifier."""
    module = descriptor_of(model)
    module = module.descriptor if isinstance(module, SizeAndSide) else module
    if not isinstance(module, EmbeddedDescriptor) or not isinstance(module.head, ClassifierHead):
        raise ValueError(
            f"model: expected a classifier, got {module.name}. Fit one with head='classifier'."
        )
    return module.descriptor, module.head


def _histograms(
    dataset: SignatureDataset,
    base: Descriptor,
    failures: list[Failure] | None,
    n_workers: int | None,
    progress: bool,
) -> tuple[Tensor, SignatureDataset]:
    """Return the histograms (M, cells) of the M bodies that can be described, and a dataset of these bodies."""
    tag, n_earlier = cache_tag(base), len(failures or ())
    histograms = describe(
        dataset, base, failures=failures, cache_tag=tag, n_workers=n_workers, progress=progress
    )
    return histograms.flatten(1), dataset.usable((failures or [])[n_earlier:])


def _held_out(labels: Tensor, goal: Goal, n_folds: int) -> Iterator[Tensor]:
    """Yield masks (N,) of held-out bodies: folds for known classes, random halves of the classes for new classes."""
    if (
        goal == "known"
    ):  # at least two bodies of the largest class are held out together, as needed for retrieval
        largest = int(labels.unique(return_counts=True)[1].max())
        yield from folds(labels, max(2, min(n_folds, largest // 2)))
        return
    classes, generator = labels.unique(), torch.Generator().manual_seed(0)
    for _ in range(n_folds):
        half = torch.randperm(len(classes), generator=generator)[: len(classes) // 2]
        yield torch.isin(labels, classes[half])


def _has_pair(labels: Tensor) -> bool:
    return len(labels.unique()) < len(labels)


def _retrieval_means(head: Head | None, histograms: Tensor, labels: Tensor) -> dict[str, float]:
    """Return the mean retrieval scores among held-out bodies; bodies alone in their class are no queries."""
    vectors = histograms if head is None else head(histograms)
    distances = (chi_square if head is None else head.distances)(vectors, vectors)
    return retrieval_scores(distances, labels.tolist()).mean()


def _held_out_scores(
    histograms: Tensor,
    labels: Tensor,
    goal: Goal,
    choose_head: Callable[[Tensor, Tensor], HeadName],
    fit_head: Callable[..., Head | None],
) -> dict[str, float]:
    """Return the means over held-out folds of the retrieval scores and, for a classifier, classification scores."""
    from torchmetrics.functional.classification import binary_auroc, multiclass_calibration_error

    retrieval: list[dict[str, float]] = []
    probabilities_of_folds, targets_of_folds, unknown_aucs = [], [], []
    classes = labels.unique()
    for number, out in enumerate(_held_out(labels, goal, _N_FOLDS)):
        x, y = histograms[~out], labels[~out]
        name = choose_head(x, y)
        if name == "whitened" and not _has_pair(
            y
        ):  # a WhitenedHead is fitted to pairs of one class
            continue
        head = fit_head(name, x, y)
        if _has_pair(labels[out]):
            scores = _retrieval_means(head, histograms[out], labels[out])
            retrieval.append({score: scores[score] for score in ("nn", "ft", "dcg")})
        if isinstance(head, ClassifierHead):
            probabilities_of_folds.append(head.probabilities(histograms[out]))
            targets_of_folds.append(torch.searchsorted(head.classes, labels[out]))
            is_new = torch.isin(
                labels, classes[number::_N_FOLDS]
            )  # left out of the fit of a second classifier
            unknown, known, fit_to = out & is_new, out & ~is_new, ~out & ~is_new
            if bool(unknown.any() and known.any()) and len(labels[fit_to].unique()) > 1:
                partial = fit_head(name, histograms[fit_to], labels[fit_to], False)
                assert isinstance(partial, ClassifierHead)
                strangeness = [partial.strangeness(histograms[mask]) for mask in (unknown, known)]
                targets = torch.cat(
                    [torch.ones(len(strangeness[0])), torch.zeros(len(strangeness[1]))]
                ).long()
                unknown_aucs.append(float(binary_auroc(torch.cat(strangeness), targets)))
    means = {
        score: fmean(scores[score] for scores in retrieval)
        for score in (retrieval[0] if retrieval else ())
    }
    if probabilities_of_folds:
        probabilities, targets = torch.cat(probabilities_of_folds), torch.cat(targets_of_folds)
        means["accuracy"] = float((probabilities.argmax(dim=1) == targets).float().mean())
        n_classes = probabilities.shape[1]
        means["calibration_error"] = float(
            multiclass_calibration_error(probabilities, targets, n_classes, _N_BINS)
        )
    if unknown_aucs:
        means["unknown_auc"] = fmean(unknown_aucs)
    return means
