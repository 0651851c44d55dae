"""Retrieval scores of the Princeton Shape Benchmark and of SHREC, from distances and labels.

Every score is computed for each query from the ranked gallery, ties in gallery order, and lies in [0, 1]. An entry is
relevant if it has the label of the query. rel(k) is 1 if the entry at rank k is relevant, and R is the number of
relevant entries in the gallery. Scores of a query with R = 0 are undefined: they are NaN, and left out of all means.
"""

import numbers
import reprlib
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from igps.retrieval.ranking import rank

Labels = Tensor | Sequence[Any]
"""Class labels: an integer tensor (N,), or a sequence of N integers or strings."""

SCORE_NAMES = ("nn", "ft", "st", "e", "dcg", "adr", "adr_self", "map")

E_MEASURE_RANKS = 32
"""Number of ranks in the E-measure (Shilane et al. 2004)."""


@dataclass(frozen=True, eq=False)
class RetrievalScores:
    """Scores of every query in [0, 1]: (Q,) float64 on the CPU, NaN for a query without a relevant entry.

    The E-measure uses the first 32 entries, or the whole gallery if it is shorter, so that a perfect ranking reaches 1
    only if R = 32. `adr_self` is the average dynamic recall of SHREC'07, in which the query itself is a hit at rank 1,
    and R + 1 replaces R. It is None if query and gallery sets are separate.
    """

    nn: Tensor  # nearest neighbour, rel(1)
    ft: Tensor  # first tier, hits in the first R over R
    st: Tensor  # second tier, hits in the first 2R over R
    e: Tensor  # E-measure 2/(1/P + 1/R') of precision P and recall R'
    dcg: Tensor  # discounted cumulative gain [rel(1) + Σ_{k≥2} rel(k)/log₂k] / [1 + Σ_{k=2..R} 1/log₂k]
    adr: Tensor  # average dynamic recall (1/R) Σ_{i=1..R} (hits in the first i)/i
    adr_self: Tensor | None
    map: Tensor  # average precision, (1/R) Σ_k rel(k) · (hits in the first k)/k
    labels: tuple[Hashable, ...]  # of each query
    scored: Tensor  # (Q,) bool, False where the query has no relevant entry
    # Whether each scored query has one relevant entry, as in classes of two
    has_single_answers: bool = False

    @property
    def n_queries(self) -> int:
        """Number of scored queries, over which the means are taken."""
        return int(self.scored.sum())

    @property
    def n_excluded(self) -> int:
        """Number of queries without a relevant entry, which are left out of the means."""
        return len(self.labels) - self.n_queries

    def mean(self) -> dict[str, float]:
        """Return the mean of every score over the scored queries, without `adr_self` if it is None."""
        return self._mean_over(self.scored)

    def single_answers(self) -> dict[str, float]:
        """Return what suits queries with one relevant entry, of which E-measure and DCG tell little.

        `nn`, `first_5` and `first_10` are the shares of queries whose entry is nearest, among the first 5, and among
        the first 10; `map` is the mean of 1/rank, and `median_rank` the median of the rank.
        """
        ranks = 1 / self.map[self.scored]
        scores = {}
        for name, n_first in {"nn": 1, "first_5": 5, "first_10": 10}.items():
            is_found = ranks < n_first + 0.5
            scores[name] = float(is_found.double().mean())
        scores["map"] = float((1 / ranks).mean())
        scores["median_rank"] = float(ranks.median())
        return scores

    def per_class(self) -> dict[Hashable, dict[str, float]]:
        """Return the means over the scored queries of each class that has any, classes in order of appearance."""
        queries: dict[Hashable, list[int]] = {}
        for query in self.scored.nonzero().flatten().tolist():
            queries.setdefault(self.labels[query], []).append(query)
        return {
            label: self._mean_over(torch.tensor(members, device="cpu"))
            for label, members in queries.items()
        }

    def _mean_over(self, queries: Tensor) -> dict[str, float]:
        means = {}
        for name in SCORE_NAMES:
            values = getattr(self, name)
            if values is not None:
                means[name] = float(values[queries].mean())
        return means


@dataclass(frozen=True, eq=False)
class PrecisionRecallCurve:
    """Interpolated precision at levels of recall, averaged over the scored queries."""

    recall: Tensor  # (20,) float64: 0.05, 0.10, …, 1
    precision: Tensor  # (20,) float64, non-increasing
    n_queries: int  # number of queries in the mean


def retrieval_scores(
    distances: Tensor | NDArray[Any], query_labels: Labels, gallery_labels: Labels | None = None
) -> RetrievalScores:
    """Compute NN, FT, ST, E-measure, DCG, ADR and mAP of every query, see `RetrievalScores`.

    Without gallery labels, the queries are the gallery: every shape is a query against all others (leave-one-out), and
    is removed from its own ranking by its index, so that R is the class size minus 1. Give gallery labels only for a
    gallery that does not contain the queries, because a query that finds itself would count as a hit.

    Sources: Shilane, Min, Kazhdan, Funkhouser 2004 (Princeton Shape Benchmark); Typke, Veltkamp, Wiering 2006 (ADR).

    Example:
        >>> import torch
        >>> places = torch.tensor([0.0, 1.0, 3.0, 3.5])  # of four shapes on a line
        >>> scores = retrieval_scores((places[:, None] - places).abs(), ["cup", "cup", "cup", "ant"])
        >>> scores.nn.tolist()
        [1.0, 1.0, 0.0, nan]
        >>> scores.mean()["nn"]
        0.6666666666666666

    Args:
        distances: (Q, G), ≥ 0, smaller is closer, a tensor or a NumPy array; infinity is allowed.
        query_labels: Q class labels.
        gallery_labels: G class labels of a separate gallery; None for leave-one-out.

    Raises:
        ValueError: the distances are not a matrix (Q, G) of entries ≥ 0 (square for leave-one-out), the labels do not
            match its sizes, or no query has a relevant entry.
    """
    relevant, labels = _ranked_relevance(distances, query_labels, gallery_labels)
    length = relevant.shape[1]
    ranks = torch.arange(1, length + 1, dtype=torch.float64, device="cpu")
    hits = relevant.cumsum(1)
    n_relevant = hits[:, -1]
    scored = n_relevant > 0
    precision = hits / ranks
    discount = ranks.log2().reciprocal()
    discount[0] = 1.0
    gain = (relevant * discount).sum(1)
    ideal_gain = discount.cumsum(0)[n_relevant.long().clamp_min(1) - 1]
    e_ranks = min(E_MEASURE_RANKS, length)

    def at_rank(cumulated: Tensor, last: Tensor) -> Tensor:
        ends = last.long().clamp(1, cumulated.shape[1]) - 1
        return cumulated.gather(1, ends[:, None])[:, 0]

    def defined(values: Tensor) -> Tensor:
        return values.masked_fill(~scored, torch.nan)

    adr_self = None
    if gallery_labels is None:
        own_hit = torch.ones_like(hits[:, :1])
        precision_self = torch.cat([own_hit, (hits + 1) / (ranks + 1)], dim=1)
        n_self = n_relevant + 1
        adr_self = defined(at_rank(precision_self.cumsum(1), n_self) / n_self)
    return RetrievalScores(
        nn=defined(relevant[:, 0]),
        ft=defined(at_rank(hits, n_relevant) / n_relevant),
        st=defined(at_rank(hits, 2 * n_relevant) / n_relevant),
        # 2/(1/P + 1/R') with P = h/32, R' = h/R
        e=defined(2 * hits[:, e_ranks - 1] / (e_ranks + n_relevant)),
        dcg=defined(gain / ideal_gain),
        adr=defined(at_rank(precision.cumsum(1), n_relevant) / n_relevant),
        adr_self=adr_self,
        map=defined((relevant * hits / ranks).sum(1) / n_relevant),
        labels=labels,
        scored=scored,
        has_single_answers=bool((n_relevant[scored] == 1).all()),
    )


def scores_of_queries(
    distances: Tensor, labels: Sequence[Any], is_query: Sequence[bool] | None = None
) -> RetrievalScores:
    """Compute the scores of N bodies: of each against all others, or of some against those that are no queries.

    Args:
        distances: (N, N), see `retrieval_scores`.
        labels: classes of the N bodies.
        is_query: which bodies are queries; each against all others if None.
    """
    if is_query is None:
        return retrieval_scores(distances, labels)
    asks = torch.tensor(is_query, device=distances.device)
    queries: list[Any] = []
    gallery: list[Any] = []
    for label, asked in zip(labels, is_query, strict=True):
        (queries if asked else gallery).append(label)
    return retrieval_scores(distances[asks][:, ~asks], queries, gallery)


def precision_recall_curve(
    distances: Tensor | NDArray[Any], query_labels: Labels, gallery_labels: Labels | None = None
) -> PrecisionRecallCurve:
    """Compute the interpolated precision at 20 recall levels, averaged over the queries with a relevant entry.

    The levels are 0.05, 0.10, …, 1. The precision at level r is the highest precision at a recall of r or more
    (Princeton Shape Benchmark, Shilane et al. 2004). For arguments and errors see `retrieval_scores`.
    """
    recall = torch.arange(1, 21, dtype=torch.float64, device="cpu") / 20
    relevant, _ = _ranked_relevance(distances, query_labels, gallery_labels)
    hits = relevant[relevant.any(1)].cumsum(1)
    n_relevant = hits[:, -1:]
    ranks = torch.arange(1, hits.shape[1] + 1, dtype=torch.float64, device="cpu")
    precision = hits / ranks
    interpolated = precision.flip(1).cummax(1).values.flip(1)
    # The tolerance undoes rounding: a recall of 0.55 with 100 relevant entries needs 55 hits, not 56.
    hits_needed = (recall * n_relevant - 1e-6).ceil()
    first_rank = torch.searchsorted(hits, hits_needed)
    mean_precision = interpolated.gather(1, first_rank).mean(0)
    return PrecisionRecallCurve(recall, mean_precision, n_queries=len(hits))


def _ranked_relevance(
    distances: Tensor | NDArray[Any], query_labels: Labels, gallery_labels: Labels | None
) -> tuple[Tensor, tuple[Hashable, ...]]:
    """rel(k) of every query, float64 on the CPU: (Q, G), or (Q, Q−1) without the query itself; and the query labels."""
    if not isinstance(distances, Tensor):
        distances = torch.as_tensor(distances, device="cpu")
    order = rank(distances).cpu()
    n_queries, n_gallery = order.shape
    queries = _label_tuple("query_labels", query_labels, n_queries)
    if gallery_labels is None:
        if n_queries != n_gallery:
            raise ValueError(
                f"distances: expected square for leave-one-out, got ({n_queries}, {n_gallery}); give gallery_labels "
                "for a separate gallery"
            )
        gallery = queries
        others = order != torch.arange(n_queries, device="cpu")[:, None]
        order = order[others].view(n_queries, max(0, n_queries - 1))
    else:
        gallery = _label_tuple("gallery_labels", gallery_labels, n_gallery)
    codes = {label: code for code, label in enumerate({*queries, *gallery})}
    query_codes = torch.tensor([codes[label] for label in queries], device="cpu")
    gallery_codes = torch.tensor([codes[label] for label in gallery], device="cpu")
    relevant = gallery_codes[order] == query_codes[:, None]
    if not relevant.any():
        raise ValueError(
            f"query_labels: expected a query with a relevant entry, none of {n_queries} shares its label with "
            f"{'another query' if gallery_labels is None else 'an entry of the gallery'}; there is nothing to score"
        )
    return relevant.double(), queries


def _label_tuple(name: str, labels: Labels, n_expected: int) -> tuple[Hashable, ...]:
    if isinstance(labels, Tensor):
        if labels.ndim != 1:
            raise ValueError(f"{name}: expected shape (N,), got {tuple(labels.shape)}")
        labels = labels.tolist()
    is_list = not isinstance(labels, str)
    if not is_list or not all(isinstance(label, str | numbers.Integral) for label in labels):
        shown = reprlib.repr(labels)
        raise ValueError(
            f"{name}: expected an integer tensor or a sequence of integers or strings, got {shown}"
        )
    if -1 in labels:
        raise ValueError(
            f"{name}: expected known classes, got −1, which means unknown. Leave such shapes out."
        )
    if len(labels) != n_expected:
        raise ValueError(
            f"{name}: expected {n_expected} labels, one per row or column of distances, got {len(labels)}"
        )
    return tuple(labels)
