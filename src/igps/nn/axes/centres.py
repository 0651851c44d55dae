"""Centres of bins and classes."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from igps._parameters import check_at_least, check_positive
from igps.nn.specification import Specified

# Lower bound of a learned gap between centres, as a share of its start value, so that no interval closes.
_MIN_GAP = 1e-3


def interval_centres(n: int, reach: float, name: str) -> Tensor:
    """Return the centres (n,) of n ≥ 1 equal intervals of [0, reach]; error messages call n `name`."""
    check_at_least(1, **{name: n})
    check_positive(reach=reach)
    return (torch.arange(n) + 0.5) * (reach / n)


class OrderedCentres(Specified):
    """Ascending centres of bins or classes, fixed or learned.

    Learned centres are cumulative sums of positive gaps, so that they ascend for all parameters. Each gap is its start
    value times softplus(θ)/log 2, where the parameter θ starts at 0. Centres that start positive stay positive.

    Args:
        start: (B,) ascending.
        learnable: whether the centres are parameters.

    Raises:
        ValueError: values that are not finite or do not ascend.
    """

    start: Tensor

    def __init__(self, start: Tensor | Sequence[float], learnable: bool = False) -> None:
        super().__init__()
        values = torch.as_tensor(start, dtype=torch.float32)
        is_row = values.ndim == 1 and len(values) > 0
        ascends = is_row and bool((values.diff() > 0).all())
        if not ascends or not torch.isfinite(values).all():
            raise ValueError(
                f"start: expected finite values in ascending order, got {values.tolist()}."
            )
        # A copy, as safetensors refuses tensors that share memory.
        self.register_buffer("start", values.clone())
        self.log_gap = nn.Parameter(torch.zeros(len(values))) if learnable else None

    def forward(self) -> Tensor:
        """Return the centres (B,)."""
        if self.log_gap is None:
            return self.start
        first = self.start[:1]
        origin = first.clamp(max=0)
        if len(self.start) > 1:
            origin = torch.where(first > 0, 0, first - self.start.diff()[:1])
        gaps = torch.cat([origin, self.start]).diff()
        # What is added to each gap, so that centres at the start are exact.
        gain = softplus(self.log_gap) - softplus(torch.zeros_like(self.log_gap))
        added = gaps * gain * ((1 - _MIN_GAP) / math.log(2))
        return self.start + added.cumsum(0)
