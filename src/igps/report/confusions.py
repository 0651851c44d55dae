"""The shapes whose rankings are most wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

N_WORST = 20
"""How many the page of results shows at most."""
_N_WRONG = 3


@dataclass(frozen=True)
class Confusion:
    """A query, and the wrong shapes that come too early in its ranking; ranks count from 1, without the query."""

    query: int  # its number
    rank: int  # of the first shape of its class
    wrong: tuple[int, ...]  # ranks of the nearest, at most three, of other classes before it; or in the first tier


def worst_confusions(
    order: NDArray[np.int64], labels: Sequence[str], names: Sequence[str], first_tier: NDArray[np.float64]
) -> list[Confusion]:
    """The queries whose rankings are most wrong, at most twenty, the worst first.

    The later the first shape of the query's class comes, the worse; then the lower the first tier; then by name. So a
    query whose nearest is right comes after all others, and one whose whole first tier is right is no confusion.

    Args:
        order: (N, N − 1) the ranking of each shape, see `System.ranked`.
        labels, names: of the N shapes.
        first_tier: (N,) shares; NaN for a shape without another of its class.
    """
    _, codes = np.unique(np.asarray(labels), return_inverse=True)
    queries = np.flatnonzero(first_tier < 1).tolist()
    right = codes[order[queries]] == codes[queries][:, None]
    ranks = (right.argmax(axis=1) + 1).tolist()
    worst = sorted(range(len(queries)), key=lambda i: (-ranks[i], first_tier[queries[i]], names[queries[i]]))
    found = []
    for i in worst[:N_WORST]:
        end = ranks[i] - 1 or int(right[i].sum())
        wrong = np.flatnonzero(~right[i, :end])[:_N_WRONG] + 1
        found.append(Confusion(queries[i], ranks[i], tuple(wrong.tolist())))
    return found
