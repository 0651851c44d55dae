"""A head that tells classes with calibrated probabilities, and what is of none of them."""

import copy
import math
from collections.abc import Iterator, Sequence
from typing import Self

import torch
from torch import Tensor
from torch.nn import functional

from igps.nn.heads.base import Head, checked_labels
from igps.nn.heads.closed_form import KernelHead

_MOST_FOLDS = 5
_TEMPERATURES = torch.logspace(-2.5, 0, 60)
# Training shapes of a class that a shape's distance from it is taken to, and what share of known shapes is called so
_N_NEAREST, _KNOWN_CALLED_UNKNOWN = 2, 0.05


class ClassifierHead(KernelHead):
    """A `KernelHead` whose scores are calibrated on folds that are held out of its training shapes.

    Probabilities are the softmax of the scores over a temperature, that of the greatest likelihood on shapes that were
    held out (Guo, Pleiss, Sun and Weinberger 2017). How strange a shape is: its mean distance from the two nearest
    training shapes of the class that it is taken for, each part in units of its median, minus its score of that class.
    From the 95th percentile of held-out shapes on, it is called unknown.

    Args:
        prior, n_directions, shrinkage, ridge, prior_share, temperature: see `KernelHead`.
        names: of the classes, in the order of their numbers.
    """

    members: Tensor
    calibration: Tensor
    strange_from: Tensor

    def __init__(
        self,
        prior: Head | None = None,
        n_directions: int = 64,
        shrinkage: float = 0.3,
        ridge: float = 0.03,
        prior_share: float = 1 / 3,
        temperature: float = 0.05,
        names: Sequence[str] = (),
    ) -> None:
        super().__init__(prior, n_directions, shrinkage, ridge, prior_share, temperature)
        self.names = tuple(names)
        self.register_buffer("members", torch.zeros(0, dtype=torch.long))
        self.register_buffer("calibration", torch.tensor(0.05))
        self.register_buffer("strange_from", torch.tensor(math.inf))

    @torch.no_grad()
    def fit(
        self, descriptions: Tensor, labels: Tensor, part_cells: Sequence[int] | None = None, *, calibrate: bool = True
    ) -> Self:
        """Fit to the training shapes, and calibrate on folds of them.

        Where no class has two shapes nothing can be held out: probabilities are guesses then, and nothing is unknown.

        Args:
            descriptions, labels, part_cells: see `Head.fit`.
            calibrate: whether probabilities and what is unknown are asked for; it takes six times as long.

        Raises:
            ValueError: shapes that do not match, or fewer than two classes.
        """
        scores, strange, truth = [], [], []
        for held_out in folds(checked_labels(descriptions, labels)) if calibrate else ():
            rest = copy.deepcopy(self)
            rest.fit(descriptions[~held_out], labels[~held_out], part_cells, calibrate=False)
            scores.append(rest.scores(descriptions[held_out]))
            strange.append(rest.strangeness(descriptions[held_out]))
            truth.append(torch.searchsorted(rest.classes, labels[held_out].to(rest.classes)))
        super().fit(descriptions, labels, part_cells)
        self.members = torch.searchsorted(self.classes, labels.to(self.classes))
        if truth:
            every, members = torch.cat(scores), torch.cat(truth)
            losses = [functional.cross_entropy(every / one, members) for one in _TEMPERATURES.to(every)]
            self.calibration.copy_(_TEMPERATURES[int(torch.stack(losses).argmin())])
            self.strange_from.copy_(torch.cat(strange).quantile(1 - _KNOWN_CALLED_UNKNOWN))
        return self

    def probabilities(self, descriptions: Tensor) -> Tensor:
        """(N, ...) histograms to (N, n_classes) probabilities, in the order of `classes`."""
        return (self.scores(descriptions) / self.calibration).softmax(dim=1)

    def strangeness(self, descriptions: Tensor) -> Tensor:
        """(N, ...) histograms to (N,), larger for what is like no training class; unknown from `strange_from` on."""
        scores, taken_for = self.scores(descriptions).max(dim=1)
        of_parts = self._distances(self._vectors(descriptions)) / self.medians[:, None, None]
        distances = torch.einsum("k,kij->ij", self.shares, of_parts)
        others = self.members != taken_for[:, None]
        nearest = distances.masked_fill(others, math.inf).topk(min(_N_NEAREST, len(self.members)), largest=False).values
        real = torch.isfinite(nearest)  # a class may have fewer
        return nearest.where(real, 0).sum(dim=1) / real.sum(dim=1) - scores


def folds(labels: Tensor, n_folds: int = _MOST_FOLDS) -> Iterator[Tensor]:
    """(N,) masks of held-out folds: each shape once, at most all but one of a class, and never a class of one.

    There are fewer folds where all classes are smaller.
    """
    generator = torch.Generator().manual_seed(0)
    fold = torch.full(labels.shape, -1)
    for offset, label in enumerate(labels.unique().tolist()):
        members = torch.nonzero(labels.cpu() == label).flatten()
        if len(members) > 1:
            drawn = members[torch.randperm(len(members), generator=generator)]
            fold[drawn] = (torch.arange(len(members)) + offset) % n_folds
    for number in range(n_folds):
        if bool((fold == number).any()):
            yield (fold == number).to(labels.device)
