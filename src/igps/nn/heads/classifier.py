"""A head that classifies shapes with calibrated probabilities, and detects shapes of unknown classes."""

import copy
import math
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from typing import Self

import torch
from torch import Tensor
from torch.nn import functional

from igps.nn.heads.base import Head, check_labels
from igps.nn.heads.closed_form import KernelHead

_MAX_FOLDS = 5
_TEMPERATURES = torch.logspace(-2.5, 0, 60)  # candidates of the calibration
_N_NEAREST = 2  # training shapes of the predicted class that strangeness is computed from
# Share of held-out shapes of known classes that are classified as unknown
FALSE_UNKNOWN_RATE = 0.05


class ClassifyingHead(Head):
    """A head with probabilities of classes, which also tells bodies of other classes.

    Attributes:
        classes: (n_classes,) numbers of the classes, ascending.
        names: of the classes.
        strange_from: the strangeness from which on a body is of none of them.
    """

    classes: Tensor
    strange_from: Tensor

    def __init__(self, names: Sequence[str] = ()) -> None:
        super().__init__()
        self.names = tuple(names)
        self.register_buffer("classes", torch.zeros(0, dtype=torch.long))
        self.register_buffer("strange_from", torch.tensor(math.inf))

    @abstractmethod
    def fit(
        self,
        descriptions: Tensor,
        labels: Tensor,
        part_cells: Sequence[int] | None = None,
        *,
        calibrate: bool = True,
    ) -> Self:
        """Fit to the training shapes, see `Head.fit`; `calibrate` sets `strange_from`, which takes longer."""

    @abstractmethod
    def probabilities(self, descriptions: Tensor) -> Tensor:
        """Return probabilities (N, n_classes) of descriptions (N, ...), in the order of `classes`."""

    @abstractmethod
    def strangeness(self, descriptions: Tensor) -> Tensor:
        """Return the strangeness (N,) of descriptions; classes are unknown from `strange_from` on."""


class ClassifierHead(KernelHead, ClassifyingHead):
    """A `KernelHead` whose scores are calibrated on held-out folds of its training shapes.

    Probabilities are the softmax of the scores divided by a temperature, which maximises the likelihood of held-out
    shapes (Guo, Pleiss, Sun and Weinberger 2017). The strangeness of a shape is its mean distance to the two nearest
    training shapes of its predicted class, with each part in units of its median, minus its score for this class. The
    class of a shape is unknown if its strangeness is at least the 95th percentile of held-out shapes.

    Args:
        prior: see `KernelHead`; all its other parameters have their defaults.
        names: of the classes, in the order of their numbers.
    """

    members: Tensor
    calibration: Tensor

    def __init__(self, prior: Head | None = None, names: Sequence[str] = ()) -> None:
        super().__init__(prior)
        self.names = tuple(names)
        self.register_buffer("members", torch.zeros(0, dtype=torch.long))
        self.register_buffer("calibration", torch.tensor(0.05))

    @torch.no_grad()
    def fit(
        self,
        descriptions: Tensor,
        labels: Tensor,
        part_cells: Sequence[int] | None = None,
        *,
        calibrate: bool = True,
    ) -> Self:
        """Fit to the training shapes, and calibrate on folds of them.

        If no class has two shapes, nothing can be held out: probabilities are uncalibrated, and no shape is unknown.

        Args:
            descriptions, labels, part_cells: see `Head.fit`.
            calibrate: whether to calibrate probabilities and strangeness; this takes six times as long.

        Raises:
            ValueError: the shapes of tensors do not match, or there are fewer than two classes.
        """
        scores = []
        strangeness = []
        classes = []
        for held_out in folds(check_labels(descriptions, labels)) if calibrate else ():
            head = copy.deepcopy(self)
            head.fit(descriptions[~held_out], labels[~held_out], part_cells, calibrate=False)
            scores.append(head.scores(descriptions[held_out]))
            strangeness.append(head.strangeness(descriptions[held_out]))
            own = labels[held_out].to(head.classes)
            classes.append(torch.searchsorted(head.classes, own))
        super().fit(descriptions, labels, part_cells)
        self.members = torch.searchsorted(self.classes, labels.to(self.classes))
        if classes:
            logits = torch.cat(scores)
            targets = torch.cat(classes)
            losses = [
                functional.cross_entropy(logits / t, targets) for t in _TEMPERATURES.to(logits)
            ]
            best = int(torch.stack(losses).argmin())
            self.calibration.copy_(_TEMPERATURES[best])
            self.strange_from.copy_(torch.cat(strangeness).quantile(1 - FALSE_UNKNOWN_RATE))
        return self

    def probabilities(self, descriptions: Tensor) -> Tensor:
        """Return probabilities (N, n_classes) of histograms (N, ...), in the order of `classes`."""
        return (self.scores(descriptions) / self.calibration).softmax(dim=1)

    def strangeness(self, descriptions: Tensor) -> Tensor:
        """Return the strangeness (N,) of histograms (N, ...); classes are unknown from `strange_from` on."""
        scores, predicted = self.scores(descriptions).max(dim=1)
        part_distances = self._distances(self._vectors(descriptions))
        part_distances = part_distances / self.medians[:, None, None]
        distances = torch.einsum("k,kij->ij", self.shares, part_distances)
        is_other = self.members != predicted[:, None]
        to_class = distances.masked_fill(is_other, math.inf)
        n_nearest = min(_N_NEAREST, len(self.members))
        nearest = to_class.topk(n_nearest, largest=False).values
        is_real = torch.isfinite(nearest)  # a class may have fewer shapes
        mean = nearest.where(is_real, 0).sum(dim=1) / is_real.sum(dim=1)
        return mean - scores


def folds(labels: Tensor, n_folds: int = _MAX_FOLDS) -> Iterator[Tensor]:
    """Yield masks (N,) of held-out folds, which never contain all shapes of a class.

    Each shape of a class with two or more shapes is held out once. There may be fewer folds if all classes are smaller.
    """
    generator = torch.Generator().manual_seed(0)
    fold = torch.full(labels.shape, -1)
    for offset, label in enumerate(labels.unique().tolist()):
        members = torch.nonzero(labels.cpu() == label).flatten()
        if len(members) > 1:
            order = torch.randperm(len(members), generator=generator)
            fold[members[order]] = (torch.arange(len(members)) + offset) % n_folds
    for number in range(n_folds):
        is_held_out = fold == number
        if bool(is_held_out.any()):
            yield is_held_out.to(labels.device)
