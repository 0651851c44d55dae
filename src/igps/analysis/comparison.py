"""Comparison of descriptors on a labelled collection: bodies described, computing time, and retrieval scores."""

import contextlib
import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

import numpy as np
import torch
from torch import Tensor

from igps._arrays import Singles
from igps._parallel import run
from igps._progress import Progress
from igps._threads import one_thread
from igps.data.dataset import Failure, SignatureDataset
from igps.failures import Failed
from igps.mesh.errors import MeshError
from igps.nn.description import describe_timed
from igps.nn.descriptor import Descriptor
from igps.retrieval.scores import SCORE_NAMES, RetrievalScores, retrieval_scores

logger = logging.getLogger(__name__)

_Description = tuple[Singles, float]  # a description (1, ...), and the seconds that it took
# Queries × bodies × entries of a description, which some descriptors hold in memory at once
_BLOCK_ENTRIES = 2**26


@dataclass(frozen=True, eq=False)
class Result:
    """Results of one descriptor on a collection."""

    descriptor: Descriptor
    # The N meshes that the descriptor could describe, in the order of the collection
    names: tuple[str, ...]
    labels: tuple[str, ...]  # classes of these meshes
    distances: Tensor | None  # (N, N), rows are queries; None if they could not be computed
    # Leave-one-out; None without distances, or if no two meshes share a class
    scores: RetrievalScores | None
    # Mean processor time without that of the signature; None if N is 0
    seconds_per_mesh: float | None
    failures: tuple[Failure, ...]  # meshes that the descriptor could not describe
    error: str | None  # reason for missing scores

    def row(self) -> dict[str, Any]:
        """Return a row of the comparison table: mean scores as fractions, None if missing, time, and counts."""
        scores: dict[str, Any] = (
            dict.fromkeys(SCORE_NAMES) if self.scores is None else self.scores.mean()
        )
        return {
            "descriptor": self.descriptor.name,
            **{name: scores[name] for name in SCORE_NAMES},
            "seconds_per_mesh": self.seconds_per_mesh,
            "n_models": len(self.names),
            "invariant_to": list(self.descriptor.invariant_to),
        }


def compare(
    dataset: SignatureDataset,
    descriptors: Sequence[Descriptor],
    *,
    n_workers: int | None = None,
    strict: bool = False,
    progress: bool = True,
) -> Iterator[Result]:
    """Run descriptors on a labelled collection, and yield the result of each descriptor as soon as it is complete.

    A mesh that a descriptor cannot describe is listed in the failures of the result, whose scores are computed among
    the other meshes. The time of a description is measured mesh by mesh on one core. It excludes the computation of the
    signature and includes reading the mesh file, if the descriptor needs the mesh. Fill the cache first
    (`dataset.precompute`).

    Args:
        dataset: N meshes with classes, whose signatures meet the requirements of all descriptors.
        descriptors: the descriptors, each with a different name.
        n_workers: number of worker processes; all cores if None.
        strict: raise for the first mesh that cannot be described instead of listing it.

    Raises:
        ValueError: the meshes have no classes, two descriptors have the same name, or the signatures do not meet the
            requirements of a descriptor.
        MeshError: a mesh cannot be described, if `strict`.
    """
    if dataset.bodies.labels is None:
        raise ValueError(
            "dataset: expected meshes with classes, got none. Give labels, or a folder per class."
        )
    check_descriptors(descriptors, dataset)
    n = len(dataset)
    cpu = torch.device("cpu")
    bodies = [dataset.subset([i]) for i in range(n)]
    jobs = [(descriptor, body, cpu) for descriptor in descriptors for body in bodies]
    # Outcomes of descriptors that are not complete, by job
    pending: dict[int, _Description | Failure] = {}
    n_done = 0
    with (
        Progress(total=len(jobs), desc="descriptions", disable=not progress) as bar,
        contextlib.closing(run(describe_timed, jobs, n_workers=n_workers)) as outcomes,
    ):
        for number, outcome in outcomes:
            bar.update()
            if isinstance(outcome, Failed):
                failure = Failure.of(dataset.bodies, number % n, outcome.reason)
                pending[number] = failure
                message = f"{descriptors[number // n].name}: {failure.error}"
                if strict:
                    raise MeshError(message)
                logger.warning("skipped: %s", message)
            else:
                pending[number] = outcome
            while n_done < len(descriptors) and all(n_done * n + i in pending for i in range(n)):
                complete = [pending.pop(n_done * n + i) for i in range(n)]
                yield _result(descriptors[n_done], dataset, complete, progress)
                n_done += 1


def check_descriptors(descriptors: Sequence[Descriptor], dataset: SignatureDataset) -> None:
    """Raise a ValueError if names repeat, or the signatures do not meet the requirements of a descriptor."""
    check_names([descriptor.name for descriptor in descriptors])
    for descriptor in descriptors:
        descriptor.requirements.check_config(dataset.config)


def check_names(names: Sequence[str]) -> None:
    """Raise a ValueError if two descriptors have the same name, because results are identified by names."""
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise ValueError(
            f"descriptors: expected different names, got {', '.join(repeated)} more than once. List each descriptor "
            "once, and give your own descriptors another `name`."
        )


def _result(
    descriptor: Descriptor,
    dataset: SignatureDataset,
    outcomes: Sequence[_Description | Failure],
    progress: bool,
) -> Result:
    failures = tuple(outcome for outcome in outcomes if isinstance(outcome, Failure))
    bodies = dataset.usable(failures).bodies
    labels = bodies.labels or ()
    described = [outcome for outcome in outcomes if not isinstance(outcome, Failure)]
    distances = None
    scores = None
    error = None
    try:
        if not described:
            raise ValueError("no mesh could be described.")
        rows = np.stack([description[0] for description, _ in described])
        descriptions = torch.from_numpy(rows)
        distances = pair_distances(descriptor, descriptions, progress=progress)
        scores = retrieval_scores(distances, labels)
    except Exception as reason:  # must not stop the comparison of the other descriptors
        error = f"{type(reason).__name__}: {reason}"
        logger.warning("%s: no scores: %s", descriptor.name, error)
    seconds = fmean(seconds for _, seconds in described) if described else None
    return Result(descriptor, bodies.names, labels, distances, scores, seconds, failures, error)


def pair_distances(
    descriptor: Descriptor, descriptions: Tensor, *, progress: bool = False
) -> Tensor:
    """Return the distances (N, N) of descriptions (N, ...), computed in blocks of queries to limit memory."""
    n_queries = max(1, _BLOCK_ENTRIES // max(1, descriptions.numel()))
    blocks = []
    bar = Progress(
        total=len(descriptions), desc=f"distances by {descriptor.name}", disable=not progress
    )
    with torch.inference_mode(), one_thread(), bar:
        for block in descriptions.split(n_queries):
            blocks.append(descriptor.distances(block, descriptions).cpu())
            bar.update(len(block))
    return torch.cat(blocks)
