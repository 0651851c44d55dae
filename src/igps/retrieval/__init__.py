"""Distances between descriptors, rankings, re-ranking and retrieval scores: functions of tensors alone."""

from igps.retrieval.distances import Distance, chi_square, cosine, euclidean
from igps.retrieval.ranking import SearchResult, rank, search
from igps.retrieval.reranking import N_RERANKED, rerank, rerank_candidates
from igps.retrieval.scores import (
    Labels,
    PrecisionRecallCurve,
    RetrievalScores,
    precision_recall_curve,
    retrieval_scores,
    scores_of_queries,
)

__all__ = [
    "N_RERANKED",
    "Distance",
    "Labels",
    "PrecisionRecallCurve",
    "RetrievalScores",
    "SearchResult",
    "chi_square",
    "cosine",
    "euclidean",
    "precision_recall_curve",
    "rank",
    "rerank",
    "rerank_candidates",
    "retrieval_scores",
    "scores_of_queries",
    "search",
]
