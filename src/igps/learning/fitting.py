"""Fitting of metrics and classifiers to a labelled collection, and classification with them."""

import copy
import importlib.metadata
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from igps._parameters import check_one_of
from igps.data.collation import collate
from igps.data.dataset import Failure, SignatureDataset
from igps.data.sources import Bodies
from igps.descriptors import descriptor as descriptor_of
from igps.descriptors.fingerprint import cache_tag
from igps.descriptors.size_and_side import SizeAndSide, form_of
from igps.descriptors.with_numbers import N_NUMBERS, Numbers, WithNumbers
from igps.learning.shortcuts import shortcuts
from igps.nn.description import check_centres, describe
from igps.nn.descriptor import Descriptor, EmbeddedDescriptor, HistogramDescriptor
from igps.nn.heads import ClassifierHead, ClassifyingHead, Head, LinearHead, WhitenedHead
from igps.nn.heads.classifier import folds
from igps.nn.heads.linear import LinearPart
from igps.retrieval import chi_square, retrieval_scores

Goal = Literal["known", "new"]
HeadName = Literal["auto", "classifier", "linear", "whitened", "as_is"]
# Weights of the prior beside a WhitenedHead: equal for new classes, smaller for classes that the head is fitted to
_PRIOR_SHARES: Mapping[Goal, float] = {"new": 0.5, "known": 1 / 3}
# For the held-out scores, and within them for the choice of the head
_N_FOLDS = 5
_N_INNER_FOLDS = 3
_N_BINS = 10  # of the expected calibration error
_MIN_GAIN = 0.005  # in the mean of balanced accuracy and AUC, by which a later candidate is better
_MAX_SCALE_BODIES = 1000  # bodies whose distances determine the scale


@dataclass(frozen=True)
class Candidate:
    """A head that may be fitted: its name, whether it uses the prior, and the parts of descriptions that it uses."""

    head: HeadName
    prior: bool
    parts: tuple[LinearPart, ...] = ("form",)

    def __str__(self) -> str:
        metric = "with" if self.prior else "without"
        return f"{self.head} of {', '.join(self.parts)}, {metric} prior"


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
        best = self.probabilities.argmax(dim=1).tolist()
        found = zip(best, self.unknown.tolist(), strict=True)
        return [None if is_unknown else self.classes[i] for i, is_unknown in found]


def split_head(which: str | Descriptor) -> tuple[Descriptor, Head | None]:
    """Return the histograms of a descriptor, to which heads are fitted, and its own head, if any."""
    module = descriptor_of(which)
    if isinstance(module, EmbeddedDescriptor):
        return module.descriptor, module.head
    return module, None


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

    The `card` of the result holds what was chosen, the scores of all candidates, and scores on folds that neither the
    fit nor the choice has seen, beside those of plain numbers with size, see `igps.measures`, on the same folds. The
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
        head: "classifier" (`ClassifierHead`), "linear" (`LinearHead`, which also uses plain numbers and size),
            "whitened" (`WhitenedHead`), or "as_is" for the descriptor itself. "auto" chooses on held-out bodies: for
            known classes among classifiers, with the prior and without, of form, plain numbers and size, by balanced
            accuracy and area under the curve; for new classes by FT.
        prior: whether the new head may also use the descriptor's own head.
        failures: list to which bodies that cannot be described are appended; None raises for the first such body.
        n_workers: threads or processes that describe bodies; all cores if None.
        progress: whether to show a progress bar.

    Raises:
        ValueError: no labels, too few bodies or classes, or a descriptor without histograms.
    """
    check_one_of(get_args(Goal), goal=goal)
    check_one_of(get_args(HeadName), head=head)
    module = descriptor_of(descriptor)
    individual = {"size": False, "side": False}  # numbers that bypass the head
    if isinstance(module, SizeAndSide):
        individual = {"size": module.keeps_size, "side": module.twists is not None}
        module = module.descriptor
    base, metric = split_head(module)
    check_centres(base)
    check_classes(dataset.bodies, goal)
    base = copy.deepcopy(base)  # the caller's descriptor stays unchanged
    metric = metric if prior else None
    options = {"n_workers": n_workers, "progress": progress}
    dataset = dataset.measured(n_workers)
    histograms, dataset = _histograms(dataset, base, failures, **options)
    rows = torch.cat([histograms, _numbers(dataset)], dim=1)
    check_classes(dataset.bodies, goal)  # without the bodies that could not be described
    labels = dataset.labels
    counts = Counter(dataset.bodies.labels)
    names = tuple(dataset.classes[int(i)] for i in labels.unique())
    has_numbers = bool(rows[:, -1].isfinite().all())
    fitting = _Fitting(base, metric, goal, names, has_numbers)
    candidates = fitting.candidates(head)
    held_out = fitting.held_out_scores(rows, labels, candidates)
    plain = {}
    if has_numbers:
        numbers = Candidate("linear", False, ("numbers", "size"))
        plain = fitting.held_out_scores(rows, labels, [numbers])
    chosen, scores = fitting.choose(rows, labels, candidates)
    new_head = fitting.fit_head(chosen, rows, labels)
    model: Descriptor = base
    if new_head is not None:
        described = WithNumbers(base) if chosen.head == "linear" else base
        name = f"{base.name}_{chosen.head}"
        model = EmbeddedDescriptor(described, new_head, name=name).eval()
    scale = _scale(model, new_head, fitting.used(chosen, rows), labels)
    if any(individual.values()):
        model = SizeAndSide(model, scale=scale, **individual).eval()
    model.scale = scale
    model.card = {
        "scale": scale,
        "descriptor": descriptor if isinstance(descriptor, str) else descriptor.name,
        "goal": goal,
        "head": chosen.head,
        "prior": chosen.prior,
        "parts": list(chosen.parts),
        "candidates": {str(one): score for one, score in scores.items()},
        "classes": {name: counts[name] for name in names},
        "held_out_scores": held_out,
        "held_out_scores_of_plain_numbers": plain,
        "shortcuts": shortcuts(dataset),
        "signature": dataset.config.as_dict(),
        "reading": dataset.reading.as_dict(),
        "version": importlib.metadata.version("interior-gps"),
    }
    return model


def _scale(model: Descriptor, head: Head | None, rows: Tensor, labels: Tensor) -> float:
    """Return the scale of a model, from its distances between bodies of different classes.

    The fit draws bodies of its own classes closer together than later bodies.
    """
    first = rows[:_MAX_SCALE_BODIES]
    first_labels = labels[:_MAX_SCALE_BODIES]
    vectors = first if head is None else head(first)
    is_measured = first_labels[:, None] != first_labels
    return float(model.distances(vectors, vectors)[is_measured].median()) / 5


@dataclass(frozen=True, eq=False)
class _Fitting:
    """Fits and scores heads; rows (N, cells + numbers + 1) are those of `WithNumbers`."""

    base: Descriptor
    metric: Head | None
    goal: Goal
    names: tuple[str, ...]
    has_numbers: bool

    @property
    def part_cells(self) -> tuple[int, ...] | None:
        return self.base.part_cells if isinstance(self.base, HistogramDescriptor) else None

    def candidates(self, head: HeadName) -> list[Candidate]:
        """Return the candidates for a head, the plainest first."""
        has_prior = self.metric is not None
        priors = (True, False) if has_prior else (False,)
        if head in ("classifier", "whitened", "as_is"):
            return [Candidate(head, has_prior)]
        if self.goal == "new" and head == "auto":
            return [*(Candidate("whitened", x) for x in priors), Candidate("as_is", has_prior)]
        linear = [Candidate("linear", has_prior)]
        if self.has_numbers:
            linear += [Candidate("linear", *parts) for parts in _parts_with_numbers(has_prior)]
        if head == "linear":
            return linear
        return [*(Candidate("classifier", x) for x in priors), *linear]

    def used(self, candidate: Candidate, rows: Tensor) -> Tensor:
        """Return the columns of rows that a candidate's head takes."""
        return rows if candidate.head == "linear" else rows[:, : -N_NUMBERS - 1]

    def fit_head(
        self, candidate: Candidate, rows: Tensor, labels: Tensor, calibrate: bool = True
    ) -> Head | None:
        """Fit the head of a candidate; None if the descriptor is used as it is, without a prior."""
        x = self.used(candidate, rows)
        prior = self.metric if candidate.prior else None
        if candidate.head == "classifier":
            kernel = ClassifierHead(prior, names=self.names)
            return kernel.fit(x, labels, self.part_cells, calibrate=calibrate)
        if candidate.head == "linear":
            linear = LinearHead(prior, candidate.parts, N_NUMBERS, self.names)
            return linear.fit(x, labels, calibrate=calibrate)
        if candidate.head == "whitened":
            share = _PRIOR_SHARES[self.goal]
            return WhitenedHead(prior=prior, prior_share=share).fit(x, labels, self.part_cells)
        return self.metric

    def choose(
        self, rows: Tensor, labels: Tensor, candidates: Sequence[Candidate]
    ) -> tuple[Candidate, dict[Candidate, dict[str, float]]]:
        """Return the best candidate on held-out bodies, and the scores of all; a later one only by a clear gain."""
        if len(candidates) == 1:
            return candidates[0], {}
        folds_of = list(_held_out(labels, self.goal, _N_INNER_FOLDS))
        if self.goal == "new":
            folds_of = [
                out for out in folds_of if _has_pair(labels[out]) and _has_pair(labels[~out])
            ]
        scores = {}
        means = {}
        best = candidates[0]
        for candidate in candidates:
            found = self._inner_scores(candidate, rows, labels, folds_of)
            if not found:
                continue
            scores[candidate] = found
            means[candidate] = fmean(found.values())
            if best not in means or means[candidate] > means[best] + _MIN_GAIN:
                best = candidate
        return best, scores

    def _inner_scores(
        self, candidate: Candidate, rows: Tensor, labels: Tensor, folds_of: Sequence[Tensor]
    ) -> dict[str, float]:
        fts = []
        answers = _Answers(labels.unique())
        for out in folds_of:
            head = self.fit_head(candidate, rows[~out], labels[~out], False)
            x = self.used(candidate, rows)[out]
            if self.goal == "new":
                fts.append(_retrieval_means(head, x, labels[out])["ft"])
            else:
                answers.add(head, x, labels[out])
        if fts:
            return {"ft": fmean(fts)}
        scores = answers.scores()
        return {name: scores[name] for name in ("balanced_accuracy", "auc") if name in scores}

    def held_out_scores(
        self, rows: Tensor, labels: Tensor, candidates: Sequence[Candidate]
    ) -> dict[str, float]:
        """Return the means over held-out folds of the retrieval scores and, for a classifier, classification scores."""
        retrieval = []
        unknown_aucs = []
        classes = labels.unique()
        answers = _Answers(classes)
        for number, out in enumerate(_held_out(labels, self.goal, _N_FOLDS)):
            chosen, _ = self.choose(rows[~out], labels[~out], candidates)
            if chosen.head == "whitened" and not _has_pair(labels[~out]):
                continue  # a WhitenedHead is fitted to pairs of one class
            x = self.used(chosen, rows)
            head = self.fit_head(chosen, rows[~out], labels[~out])
            if _has_pair(labels[out]):
                retrieval.append(_retrieval_means(head, x[out], labels[out]))
            if isinstance(head, ClassifyingHead):
                answers.add(head, x[out], labels[out])
                is_new = torch.isin(labels, classes[number::_N_FOLDS])
                unknown_aucs += self._unknown_auc(chosen, rows, labels, out, is_new)
        means = {}
        for score in ("nn", "ft", "dcg") if retrieval else ():
            means[score] = fmean(scores[score] for scores in retrieval)
        means |= answers.scores()
        if unknown_aucs:
            means["unknown_auc"] = fmean(unknown_aucs)
        return means

    def _unknown_auc(
        self, chosen: Candidate, rows: Tensor, labels: Tensor, out: Tensor, is_new: Tensor
    ) -> list[float]:
        """Return how well a second classifier, which was not fitted to new classes, tells their held-out bodies.

        An empty list if there are too few bodies.
        """
        from sklearn.metrics import roc_auc_score

        fit_to = ~out & ~is_new
        is_unknown = is_new[out]
        is_told = bool(is_unknown.any() and not is_unknown.all())
        if not is_told or len(labels[fit_to].unique()) < 2:
            return []
        head = self.fit_head(chosen, rows[fit_to], labels[fit_to], False)
        assert isinstance(head, ClassifyingHead)
        strangeness = head.strangeness(self.used(chosen, rows)[out])
        return [float(roc_auc_score(is_unknown, strangeness))]


def _parts_with_numbers(has_prior: bool) -> list[tuple[bool, tuple[LinearPart, ...]]]:
    return [
        (False, ("numbers",)),
        (False, ("numbers", "size")),
        (has_prior, ("form", "numbers")),
        (has_prior, ("form", "numbers", "size")),
    ]


class _Answers:
    """Probabilities of held-out bodies, from all folds, and their true classes."""

    def __init__(self, classes: Tensor) -> None:
        self.classes = classes
        self.probabilities: list[Tensor] = []
        self.labels: list[Tensor] = []

    def add(self, head: Head | None, rows: Tensor, labels: Tensor) -> None:
        """Ask a classifier for the bodies of a fold; classes that it was not fitted to have probability 0."""
        assert isinstance(head, ClassifyingHead)
        probabilities = torch.zeros(len(rows), len(self.classes))
        known = torch.searchsorted(self.classes, head.classes)
        probabilities[:, known] = head.probabilities(rows)
        self.probabilities.append(probabilities)
        self.labels.append(labels)

    def scores(self) -> dict[str, float]:
        """Return the `classification_scores`; none without folds."""
        if not self.labels:
            return {}
        probabilities = torch.cat(self.probabilities)
        return classification_scores(probabilities, torch.cat(self.labels), self.classes)


def classification_scores(
    probabilities: Tensor, labels: Tensor, classes: Tensor
) -> dict[str, float]:
    """Return accuracy, balanced accuracy, area under the curve and calibration error of held-out bodies.

    Balanced accuracy is the mean over the classes of the share of their bodies that is recognised; the area under the
    curve is the mean over the classes, each against all others. Both count small classes as much as large ones.

    Args:
        probabilities: (N, C) of the classes.
        labels: (N,) numbers of the true classes.
        classes: (C,) numbers of all classes, ascending.
    """
    from sklearn.metrics import roc_auc_score

    targets = torch.searchsorted(classes, labels)
    is_right = probabilities.argmax(dim=1) == targets
    present = targets.unique().tolist()
    confidences = probabilities.amax(dim=1)
    bins = (confidences * _N_BINS).long()
    excess = confidences - is_right.to(confidences)
    gaps = confidences.new_zeros(_N_BINS + 1).index_add(0, bins, excess)
    accuracies = []
    areas = []
    for number in present:
        is_of_class = targets == number
        accuracies.append(float(is_right[is_of_class].float().mean()))
        if len(present) > 1:
            areas.append(float(roc_auc_score(is_of_class, probabilities[:, number])))
    scores = {
        "accuracy": float(is_right.float().mean()),
        "balanced_accuracy": fmean(accuracies),
        "calibration_error": float(gaps.abs().sum() / len(targets)),
    }
    if areas:
        scores["auc"] = fmean(areas)
    return scores


def check_classes(bodies: Bodies, goal: Goal) -> None:
    """Raise a ValueError if there are too few classes, or no class of two bodies."""
    counts = Counter(bodies.labels)
    min_classes = 2 if goal == "known" else 4
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
    options = {"n_workers": n_workers, "progress": progress}
    histograms, dataset = _histograms(dataset, base, failures, **options)
    probabilities = head.probabilities(histograms)
    strangeness = head.strangeness(histograms)
    is_unknown = strangeness > head.strange_from
    return Classification(dataset.bodies.names, names, probabilities, strangeness, is_unknown)


def classifier_of(model: str | Descriptor) -> tuple[Descriptor, ClassifyingHead]:
    """Return the descriptor of a model and its classifier; raise a ValueError if it has no classifier."""
    module = form_of(descriptor_of(model))
    if not isinstance(module, EmbeddedDescriptor) or not isinstance(module.head, ClassifyingHead):
        raise ValueError(
            f"model: expected a classifier, got {module.name}. Fit one with head='classifier'."
        )
    return module.descriptor, module.head


def _numbers(dataset: SignatureDataset) -> Tensor:
    """Return the `Numbers` (N, 12 + 1) of N bodies, NaN where a body has none, as in files of an earlier version."""
    describe_numbers = Numbers()
    rows = torch.full((len(dataset), N_NUMBERS + 1), torch.nan)
    for row, item in zip(rows, dataset, strict=True):
        if item.signature.measures:
            row.copy_(describe_numbers(collate([item]))[0])
    return rows


def _histograms(
    dataset: SignatureDataset, base: Descriptor, failures: list[Failure] | None, **options: Any
) -> tuple[Tensor, SignatureDataset]:
    """Return the histograms (M, cells) of the M bodies that can be described, and a dataset of these bodies."""
    n_earlier = len(failures or ())
    histograms = describe(dataset, base, failures=failures, cache_tag=cache_tag(base), **options)
    return histograms.flatten(1), dataset.usable((failures or [])[n_earlier:])


def _held_out(labels: Tensor, goal: Goal, n_folds: int) -> Iterator[Tensor]:
    """Yield masks (N,) of held-out bodies: folds for known classes, random halves of the classes for new classes."""
    classes, sizes = labels.unique(return_counts=True)
    if goal == "known":
        # At least two bodies of the largest class are held out together, as needed for retrieval
        most = int(sizes.max()) // 2
        yield from folds(labels, max(2, min(n_folds, most)))
        return
    generator = torch.Generator().manual_seed(0)
    for _ in range(n_folds):
        half = torch.randperm(len(classes), generator=generator)[: len(classes) // 2]
        yield torch.isin(labels, classes[half])


def _has_pair(labels: Tensor) -> bool:
    return len(labels.unique()) < len(labels)


def _retrieval_means(head: Head | None, histograms: Tensor, labels: Tensor) -> dict[str, float]:
    """Return the mean retrieval scores among held-out bodies; bodies alone in their class are no queries."""
    if head is None:
        distances = chi_square(histograms, histograms)
    else:
        vectors = head(histograms)
        distances = head.distances(vectors, vectors)
    return retrieval_scores(distances, labels.tolist()).mean()
