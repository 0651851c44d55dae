"""A classifier of histograms and plain numbers together, by logistic regression."""

import math
from collections.abc import Iterable, Sequence
from typing import Literal, Self, get_args

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from igps._parameters import check_one_of
from igps.nn.heads.base import Head, check_cells, check_labels, principal_directions, square_roots
from igps.nn.heads.classifier import FALSE_UNKNOWN_RATE, ClassifyingHead, folds

LinearPart = Literal["form", "numbers", "size"]

_STRENGTHS = (0.01, 0.1, 1.0)  # candidates of the inverse regularisation
_STRENGTH = 0.1  # where no body can be held out
_N_FOLDS = 3
_N_DIRECTIONS = 64  # of the form
# Least standard deviation of a number, in its spread among generated bodies. Otherwise, in classes of nearly equal
# bodies, rounding of a constant number would count as much as form.
_MIN_SPREAD = 0.05


class LinearHead(ClassifyingHead):
    """Multinomial logistic regression (Cox 1958) on up to three parts of a description.

    The parts are form, the embedding of the histograms by a prior, or their square roots; plain numbers without size;
    and size. The form is reduced to its first 64 principal directions. Numbers have variance 1, and the form has the
    variance of all numbers together. Classes have equal weights, however many bodies they have. The strength of the
    regularisation is that of the largest likelihood of held-out bodies.

    The strangeness of a body is its distance from the mean of its predicted class, over the root of the number of
    columns. An embedding is the vector of the scores of the classes, normalised.

    Args:
        prior: a fitted head, which is not changed; None for the square roots of histograms.
        parts: what is used.
        n_numbers: number of columns of plain numbers; descriptions are histograms, these columns, and size.
        names: of the classes, in the order of their numbers.

    Raises:
        ValueError: an unknown part, or none.
    """

    mean: Tensor
    projection: Tensor
    weights: Tensor
    bias: Tensor
    centres: Tensor

    def __init__(
        self,
        prior: Head | None = None,
        parts: Sequence[LinearPart] = ("form", "numbers", "size"),
        n_numbers: int = 12,
        names: Sequence[str] = (),
    ) -> None:
        super().__init__(names)
        for part in parts:
            check_one_of(get_args(LinearPart), parts=part)
        if not parts:
            raise ValueError("parts: expected at least one of form, numbers and size, got none.")
        self.prior = prior
        self.parts = tuple(parts)
        self.n_numbers = n_numbers
        self.register_buffer("mean", torch.zeros(0))
        self.register_buffer("projection", torch.zeros(0, 0))
        self.register_buffer("weights", torch.zeros(0, 0))
        self.register_buffer("bias", torch.zeros(0))
        self.register_buffer("centres", torch.zeros(0, 0))

    @torch.no_grad()
    def fit(
        self,
        descriptions: Tensor,
        labels: Tensor,
        part_cells: Sequence[int] | None = None,
        *,
        calibrate: bool = True,
    ) -> Self:
        """Fit to the training shapes, see `Head.fit`.

        With `calibrate`, held-out folds give the strength of the regularisation and the limit of strangeness.
        """
        labels = check_labels(descriptions, labels)
        columns = self._columns(descriptions)
        held_out = list(folds(labels, _N_FOLDS)) if calibrate else []
        strength = self._best_strength(columns, labels, held_out)
        strangeness = []
        for out in held_out:
            self._fit(columns[~out], labels[~out], strength)
            strangeness.append(self.strangeness(descriptions[out]))
        if strangeness:
            self.strange_from.copy_(torch.cat(strangeness).quantile(1 - FALSE_UNKNOWN_RATE))
        return self._fit(columns, labels, strength)

    def _best_strength(self, columns: Tensor, labels: Tensor, held_out: Iterable[Tensor]) -> float:
        losses = dict.fromkeys(_STRENGTHS, 0.0)
        for out in held_out:
            for strength in _STRENGTHS:
                self._fit(columns[~out], labels[~out], strength)
                members = torch.searchsorted(self.classes, labels[out].to(self.classes))
                logarithms = self._scores(columns[out]).log_softmax(dim=1)
                likelihood = logarithms.gather(1, members[:, None]).sum()
                losses[strength] -= float(likelihood)
        if not any(losses.values()):
            return _STRENGTH
        return min(losses, key=losses.__getitem__)

    def _fit(self, columns: Tensor, labels: Tensor, strength: float) -> Self:
        from sklearn.linear_model import LogisticRegression

        self.classes = labels.unique()
        self.mean = columns.mean(dim=0)
        self.projection = self._directions(columns - self.mean)
        rows = (columns - self.mean) @ self.projection
        model = LogisticRegression(C=strength, class_weight="balanced", max_iter=2000)
        model.fit(rows.double().numpy(), labels.numpy())
        weights = model.coef_
        bias = model.intercept_
        if len(self.classes) == 2:  # one score, of the second class against the first
            weights = np.concatenate([-weights, weights]) / 2
            bias = np.concatenate([-bias, bias]) / 2
        self.weights = torch.from_numpy(weights).to(rows).contiguous()
        self.bias = torch.from_numpy(bias).to(rows)
        centres = [rows[labels == label].mean(dim=0) for label in self.classes]
        self.centres = torch.stack(centres)
        return self

    def _directions(self, centred: Tensor) -> Tensor:
        """Return the matrix (D, ≤ 64 + numbers) from centred columns to those of the regression."""
        n_numbers = self._n_columns()
        n_form = centred.shape[1] - n_numbers
        spread = centred[:, n_form:].square().mean(dim=0).sqrt()
        scales = 1 / spread.clamp(min=_MIN_SPREAD)
        if not n_form:
            return scales.diag()
        form = centred[:, :n_form]
        directions, _ = principal_directions(form.double(), _N_DIRECTIONS)
        squares = form.square().sum(dim=1)
        total = float(squares.mean().sqrt())
        gain = math.sqrt(self.n_numbers) / max(total, 1e-6)
        return torch.block_diag(gain * directions.T.to(centred), scales.diag())

    def _n_columns(self) -> int:
        """Return the number of columns that are numbers or size."""
        return self.n_numbers * ("numbers" in self.parts) + ("size" in self.parts)

    def _columns(self, descriptions: Tensor) -> Tensor:
        """Return the columns (N, D) of the parts of descriptions (N, cells + numbers + 1)."""
        rows = descriptions.flatten(1)
        n_cells = rows.shape[1] - self.n_numbers - 1
        columns = []
        if "form" in self.parts:
            cells = rows[:, :n_cells]
            roots = self.prior(cells) if self.prior is not None else square_roots(cells)
            columns.append(roots)
        if "numbers" in self.parts:
            columns.append(rows[:, n_cells:-1])
        if "size" in self.parts:
            columns.append(rows[:, -1:])
        return torch.cat(columns, dim=1)

    def _rows(self, columns: Tensor) -> Tensor:
        if not len(self.mean):
            raise self._not_fitted()
        check_cells(columns, len(self.mean))
        return (columns - self.mean) @ self.projection

    def _scores(self, columns: Tensor) -> Tensor:
        return self._rows(columns) @ self.weights.T + self.bias

    def forward(self, descriptions: Tensor) -> Tensor:
        """Map descriptions (N, cells + numbers + 1) to the normalised scores (N, n_classes) of the classes."""
        return normalize(self._scores(self._columns(descriptions)), dim=1)

    def probabilities(self, descriptions: Tensor) -> Tensor:
        """Return probabilities (N, n_classes), in the order of `classes`, as if all classes were equally frequent."""
        return self._scores(self._columns(descriptions)).softmax(dim=1)

    def strangeness(self, descriptions: Tensor) -> Tensor:
        """Return the strangeness (N,) of descriptions; classes are unknown from `strange_from` on."""
        columns = self._columns(descriptions)
        predicted = self._scores(columns).argmax(dim=1)
        rows = self._rows(columns)
        offsets = rows - self.centres[predicted]
        return offsets.norm(dim=1) / math.sqrt(rows.shape[1])
