"""From a labelled collection to a metric or a classifier, and its answers."""

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
from igps.descriptors.individual import IndividualDescriptor
from igps.descriptors.molecular import SizedHistograms
from igps.nn.description import check_centres, describe
from igps.nn.descriptor import Descriptor, EmbeddedDescriptor, HistogramDescriptor
from igps.nn.heads import ClassifierHead, Head, WhitenedHead
from igps.nn.heads.classifier import folds
from igps.retrieval import chi_square, retrieval_scores

Goal = Literal["known", "new"]
HeadName = Literal["auto", "classifier", "whitened", "as_is"]
# Which heads a goal chooses from
_CANDIDATES: Mapping[Goal, tuple[HeadName, ...]] = {"known": ("classifier", "whitened"), "new": ("whitened", "as_is")}
# Of the prior beside a WhitenedHead for classes that come up later
_PRIOR_SHARE = 0.5
_N_FOLDS, _N_INNER_FOLDS = 5, 3
_N_BINS = 10
# Bodies between which distances are measured for their scale
_MOST_MEASURED = 1000


@dataclass(frozen=True, eq=False)
class Classification:
    """What N bodies are taken for."""

    names: tuple[str, ...]  # of the bodies
    classes: tuple[str, ...]  # C names
    probabilities: Tensor  # (N, C), calibrated
    strangeness: Tensor  # (N,), larger for what is like no class
    unknown: Tensor  # (N,) whether a body is unlike everything that the classifier knows

    @property
    def predicted(self) -> list[str | None]:
        """The most probable class of each body; None of what is unknown."""
        best = self.probabilities.argmax(dim=1).tolist()
        return [None if new else self.classes[i] for i, new in zip(best, self.unknown.tolist(), strict=True)]


def histograms_and_prior(which: str | Descriptor) -> tuple[Descriptor, Head | None]:
    """The descriptor whose histograms heads are fitted to, and the metric of these that it has already, if any."""
    found = descriptor_of(which)
    found = found.without_size() if isinstance(found, SizedHistograms) else found
    return (found.descriptor, found.head) if isinstance(found, EmbeddedDescriptor) else (found, None)


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
    """The descriptor under a head that is fitted to the classes of a dataset, with its held-out scores in its `card`.

    Held-out scores are of folds that neither the fit nor the choice of the head has seen; the head that is returned is
    fitted to all bodies.

    Example:
        >>> import tempfile
        >>> from igps.shapes import ArticulatedShapes
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = ArticulatedShapes(n_classes=2, n_per_class=4, n_vertices=600).write(f"{folder}/shapes")
        ...     dataset = SignatureDataset(f"{folder}/shapes", cache_dir=f"{folder}/cache", descriptor="interior")
        ...     model = fit(dataset, "interior", head="whitened", n_workers=1)
        >>> model.name, sorted(model.card["classes"].values())
        ('interior_whitened', [4, 4])

    Args:
        dataset: labelled bodies.
        descriptor: of histograms; or one with a metric, which is the prior.
        goal: known for classes of the dataset, whose other bodies are held out in turn; new for a metric of classes
            that come up later, where whole classes are held out.
        head: classifier (`ClassifierHead`), whitened (`WhitenedHead`), as_is for the descriptor itself; auto takes the
            one that is best on held-out bodies, by FT.
        prior: whether the descriptor's own metric counts beside the new head.
        failures: a list to which bodies that cannot be described are added; None to raise at the first.
        n_workers: threads that describe; all cores if None.

    Raises:
        ValueError: no labels, too few of them, or a descriptor without histograms.
    """
    check_one_of(get_args(Goal), goal=goal)
    check_one_of(get_args(HeadName), head=head)
    which = descriptor_of(descriptor)
    kept = {"size": isinstance(which, SizedHistograms), "side": False}  # they stay beside the head
    if isinstance(which, IndividualDescriptor):
        kept, which = {"size": which.keeps_size, "side": which.twists is not None}, which.descriptor
    base, metric = histograms_and_prior(which)
    check_centres(base)
    check_classes(dataset.bodies, goal)
    base, metric = copy.deepcopy(base), metric if prior else None  # the given one stays as it is
    histograms, dataset = _histograms(dataset, base, failures, n_workers, progress)
    check_classes(dataset.bodies, goal)  # those that are left
    labels, counts = dataset.labels, Counter(dataset.bodies.labels)
    names = tuple(dataset.classes[int(i)] for i in labels.unique())
    cells = base.part_cells if isinstance(base, HistogramDescriptor) else None

    def fitted(name: HeadName, x: Tensor, y: Tensor, calibrate: bool = True) -> Head | None:
        if name == "classifier":
            return ClassifierHead(metric, names=names).fit(x, y, cells, calibrate=calibrate)
        share = _PRIOR_SHARE if goal == "new" else 1 / 3
        return WhitenedHead(prior=metric, prior_share=share).fit(x, y, cells) if name == "whitened" else metric

    def chosen(x: Tensor, y: Tensor) -> HeadName:
        if head != "auto":
            return head
        of_each = _held_out(y, goal, _N_INNER_FOLDS)
        held_out = [out for out in of_each if _has_pair(y[out]) and _has_pair(y[~out])]

        def tier(name: HeadName) -> float:
            return fmean(_retrieved(fitted(name, x[~out], y[~out], False), x[out], y[out])["ft"] for out in held_out)

        return max(_CANDIDATES[goal], key=tier) if held_out else _CANDIDATES[goal][0]

    scores = _scores(histograms, labels, goal, chosen, fitted)
    name = chosen(histograms, labels)
    made = fitted(name, histograms, labels)
    model: Descriptor = base if made is None else EmbeddedDescriptor(base, made, name=f"{base.name}_{name}").eval()
    vectors = histograms[:_MOST_MEASURED] if made is None else made(histograms[:_MOST_MEASURED])
    apart = labels[:_MOST_MEASURED, None] != labels[None, :_MOST_MEASURED]
    # Bodies of one class that the head has seen are nearer than others will be
    scale = float(model.distances(vectors, vectors)[apart].median()) / 5
    if any(kept.values()):
        model = IndividualDescriptor(model, scale=scale, **kept).eval()
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
    """Raise a ValueError where there are too few to fit to."""
    counts, least = Counter(bodies.labels), 2 if goal == "known" else 4
    if len(counts) < least or max(counts.values()) < 2:
        raise ValueError(f"classes: expected at least {least}, one of them of two bodies, got {dict(counts)}.")


def classify(
    dataset: SignatureDataset,
    model: str | Descriptor,
    *,
    failures: list[Failure] | None = None,
    n_workers: int | None = None,
    progress: bool = False,
) -> Classification:
    """The classes of the bodies of a dataset by a model that `fit` made.

    Args:
        dataset: bodies, labelled or not.
        model: a file, or the model.
        failures, n_workers, progress: see `fit`.

    Raises:
        ValueError: the model has no classifier.
    """
    base, head = classifier_of(model)
    names = head.names or tuple(map(str, head.classes.tolist()))
    if len(names) != len(head.classes):
        raise ValueError(f"model: expected names of {len(head.classes)} classes, got {len(names)}. Fit it again.")
    histograms, dataset = _histograms(dataset, base, failures, n_workers, progress)
    strangeness = head.strangeness(histograms)
    return Classification(
        dataset.bodies.names, names, head.probabilities(histograms), strangeness, strangeness > head.strange_from
    )


def classifier_of(model: str | Descriptor) -> tuple[Descriptor, ClassifierHead]:
    """The classifier of a model, and the descriptor that it classifies by; a ValueError where there is none."""
    found = descriptor_of(model)
    found = found.descriptor if isinstance(found, IndividualDescriptor) else found
    if not isinstance(found, EmbeddedDescriptor) or not isinstance(found.head, ClassifierHead):
        raise ValueError(f"model: expected one with a classifier, got {found.name}. Fit one with head='classifier'.")
    return found.descriptor, found.head


def _histograms(
    dataset: SignatureDataset, base: Descriptor, failures: list[Failure] | None, n_workers: int | None, progress: bool
) -> tuple[Tensor, SignatureDataset]:
    tag, found_before = cache_tag(base), len(failures or ())
    found = describe(dataset, base, failures=failures, cache_tag=tag, n_workers=n_workers, progress=progress)
    return found.flatten(1), dataset.usable((failures or [])[found_before:])


def _held_out(labels: Tensor, goal: Goal, n_folds: int) -> Iterator[Tensor]:
    """(N,) masks: of known classes folds of their bodies, of new ones random halves of the classes."""
    if goal == "known":  # of a class of four two at a time, so that they find each other
        largest = int(labels.unique(return_counts=True)[1].max())
        yield from folds(labels, max(2, min(n_folds, largest // 2)))
        return
    classes, generator = labels.unique(), torch.Generator().manual_seed(0)
    for _ in range(n_folds):
        half = torch.randperm(len(classes), generator=generator)[: len(classes) // 2]
        yield torch.isin(labels, classes[half])


def _has_pair(labels: Tensor) -> bool:
    return len(labels.unique()) < len(labels)


def _retrieved(head: Head | None, histograms: Tensor, labels: Tensor) -> dict[str, float]:
    """Retrieval scores among some bodies, without those that are alone in their class."""
    vectors = histograms if head is None else head(histograms)
    distances = (chi_square if head is None else head.distances)(vectors, vectors)
    return retrieval_scores(distances, labels.tolist()).mean()


def _scores(
    histograms: Tensor,
    labels: Tensor,
    goal: Goal,
    chosen: Callable[[Tensor, Tensor], HeadName],
    fitted: Callable[..., Head | None],
) -> dict[str, float]:
    """Means over held-out folds: scores of retrieval, and of classification if the head is a classifier."""
    from torchmetrics.functional.classification import binary_auroc, multiclass_calibration_error

    found: list[dict[str, float]] = []
    said, truth, known, strange = [], [], [], []
    classes = labels.unique()
    for number, out in enumerate(_held_out(labels, goal, _N_FOLDS)):
        x, y = histograms[~out], labels[~out]
        name = chosen(x, y)
        if name == "whitened" and not _has_pair(y):  # nothing to fit it to
            continue
        head = fitted(name, x, y)
        if _has_pair(labels[out]):
            scores = _retrieved(head, histograms[out], labels[out])
            found.append({one: scores[one] for one in ("nn", "ft", "dcg")})
        if isinstance(head, ClassifierHead):
            said.append(head.probabilities(histograms[out]))
            truth.append(torch.searchsorted(head.classes, labels[out]))
            left_out = torch.isin(labels, classes[number::_N_FOLDS])
            new, old = out & left_out, out & ~left_out
            if bool(new.any() and old.any()) and len(labels[~out & ~left_out].unique()) > 1:
                less = fitted(name, histograms[~out & ~left_out], labels[~out & ~left_out], False)
                assert isinstance(less, ClassifierHead)
                known.append(less.strangeness(histograms[old]))
                strange.append(less.strangeness(histograms[new]))
    means = {one: fmean(scores[one] for scores in found) for one in (found[0] if found else ())}
    if said:
        probabilities, right = torch.cat(said), torch.cat(truth)
        means["accuracy"] = float((probabilities.argmax(dim=1) == right).float().mean())
        n_classes = probabilities.shape[1]
        means["calibration_error"] = float(multiclass_calibration_error(probabilities, right, n_classes, _N_BINS))
    if strange:
        means["unknown_auc"] = fmean(
            float(binary_auroc(torch.cat([new, old]), torch.cat([torch.ones(len(new)), torch.zeros(len(old))]).long()))
            for new, old in zip(strange, known, strict=True)
        )
    return means
