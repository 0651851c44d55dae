"""The merge tree of a function on points: how its peaks grow together as the level falls."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from igps.descriptors.pretrained._merge_loops import merge


class MergeTree(NamedTuple):
    """Branches by the elder rule, and the pieces of superlevel sets.

    peaks: (B,) the highest point of each branch, numbers of points.
    saddles: (B,) the point where it joins the branch of a higher peak; the lowest point of all where it joins none.
    pieces: (L, P) of each point the peak of the piece of the superlevel set that it belongs to; −1 where it is below.
    """

    peaks: Tensor
    saddles: Tensor
    pieces: Tensor


def merge_tree(values: Tensor, neighbours: Tensor, counts: Sequence[int] = ()) -> MergeTree:
    """The merge tree of finite values (P,) on points; two are neighbours if either names the other in (P, k).

    From the highest value down, each point joins the pieces of those of its neighbours that are higher; where it joins
    two pieces, the one with the lower peak ends. A branch is as long as its peak is above its end, which is called its
    persistence. Source: Edelsbrunner, Letscher and Zomorodian 2002; on shapes, Skraba, Ovsjanikov, Chazal and Guibas
    2010. Of equal values, that of the smaller number is the higher. Superlevel sets are told by counts (L,), how many
    points each has, 1 to P, ascending. A value that is not finite is a ValueError.
    """
    if not torch.isfinite(values).all():
        raise ValueError("values: expected finite numbers, got NaN or infinity.")
    order = torch.argsort(values.detach(), descending=True, stable=True).cpu().numpy()
    ends = np.empty((len(values), 2), np.int64)
    pieces = np.full((len(counts), len(values)), -1, np.int64)
    n = merge(order, neighbours.cpu().numpy(), np.array(counts, np.int64), ends, pieces)
    found = torch.from_numpy(ends[:n]).to(values.device)
    return MergeTree(found[:, 0], found[:, 1], torch.from_numpy(pieces).to(values.device))
