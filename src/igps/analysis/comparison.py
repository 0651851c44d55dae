"""Descriptors side by side on a labelled collection: what each can describe, what that costs, and how it retrieves."""

import contextlib
import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from igps._arrays import Singles
from igps._parallel import Failed, one_thread, run
from igps.data.dataset import Failure, SignatureDataset
from igps.mesh.mesh import MeshError
from igps.nn.description import describe_timed
from igps.nn.descriptor import Descriptor
from igps.retrieval.scores import SCORE_NAMES, RetrievalScores, retrieval_scores

logger = logging.getLogger(__name__)

# A description (1, ...), and the seconds that it took
_Description = tuple[Singles, float]
# Entries of the triples (query, gallery, entry of a description) that one block of distances may hold at once.
_BLOCK_ENTRIES = 2**26


@dataclass(frozen=True, eq=False)
class Result:
    """How one descriptor did on a collection."""

    descriptor: Descriptor
    names: tuple[str, ...]  # the N meshes that it described, in the order of the collection
    labels: tuple[str, ...]  # their classes
    distances: Tensor | None  # (N, N), row by row from a mesh as the query; None where they could not be computed
    scores: RetrievalScores | None  # leave-one-out; None without distances, and where no two meshes share a class
    seconds_per_mesh: float | None  # mean processor time, without that of the signature; None where N is 0
    failures: tuple[Failure, ...]  # the meshes that it could not describe
    error: str | None  # why there are no scores; None if there are

    def row(self) -> dict[str, Any]:
        """The line of a table: mean scores as fractions, None where there are none, and what they cost."""
        scores: dict[str, Any] = dict.fromkeys(SCORE_NAMES) if self.scores is None else self.scores.mean()
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
    """Run descriptors over a labelled collection, and yield the result of each as soon as it is there.

    A mesh that a descriptor cannot describe is listed in its failures, and its scores are among the other meshes.
    Descriptions are timed mesh by mesh, one core each, from the cached signature on: with the reading of the mesh file
    for those that need it, without the signature itself. Fill the cache first (`dataset.precompute`).

    Args:
        dataset: N meshes with classes, their signatures with all that the descriptors need.
        n_workers: processes that describe; all cores if None.
        strict: raise at the first mesh that cannot be described instead of listing it.

    Raises:
        ValueError: the meshes have no classes, two descriptors one name, or the signatures lack what one needs.
        MeshError: a mesh that cannot be described, if `strict`.
    """
    if dataset.bodies.labels is None:
        raise ValueError("dataset: expected meshes with classes, got none. Give labels, or a folder per class.")
    check_descriptors(descriptors, dataset)
    n = len(dataset)
    cpu = torch.device("cpu")
    jobs = [(descriptor, dataset.subset([i]), cpu) for descriptor in descriptors for i in range(n)]
    found: dict[int, _Description | Failure] = {}
    n_done = 0
    with (
        tqdm(total=len(jobs), desc="descriptions", disable=not progress) as bar,
        contextlib.closing(run(describe_timed, jobs, n_workers=n_workers)) as outcomes,
    ):
        for number, outcome in outcomes:
            bar.update()
            if isinstance(outcome, Failed):
                found[number] = failure = Failure.of(dataset.bodies, number % n, outcome.reason)
                named = f"{descriptors[number // n].name}: {failure.error}"
                if strict:
                    raise MeshError(named)
                logger.warning("skipped: %s", named)
            else:
                found[number] = outcome
            while n_done < len(descriptors) and all(n_done * n + i in found for i in range(n)):
                mine = [found.pop(n_done * n + i) for i in range(n)]
                yield _result(descriptors[n_done], dataset, mine, progress)
                n_done += 1


def check_descriptors(descriptors: Sequence[Descriptor], dataset: SignatureDataset) -> None:
    """Raise a ValueError where two have one name, which identifies results, or the signatures lack something."""
    check_names([one.name for one in descriptors])
    for descriptor in descriptors:
        descriptor.requirements.check_config(dataset.config)


def check_names(names: Sequence[str]) -> None:
    """Raise a ValueError where two descriptors have one name."""
    if repeated := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(
            f"descriptors: expected one of each name, got several of {', '.join(repeated)}. Name each once, and "
            "give those of your own another `name`."
        )


def _result(
    descriptor: Descriptor, dataset: SignatureDataset, outcomes: Sequence[_Description | Failure], progress: bool
) -> Result:
    failures = tuple(outcome for outcome in outcomes if isinstance(outcome, Failure))
    bodies = dataset.usable(failures).bodies
    labels = bodies.labels or ()
    found = [outcome for outcome in outcomes if not isinstance(outcome, Failure)]
    distances, scores, error = None, None, None
    try:
        if not found:
            raise ValueError("no mesh could be described.")
        values = torch.from_numpy(np.stack([one[0] for one, _ in found]))
        distances = pair_distances(descriptor, values, progress=progress)
        scores = retrieval_scores(distances, labels)
    except Exception as reason:  # the other descriptors go on
        error = f"{type(reason).__name__}: {reason}"
        logger.warning("%s: no scores: %s", descriptor.name, error)
    seconds = fmean(one for _, one in found) if found else None
    return Result(descriptor, bodies.names, labels, distances, scores, seconds, failures, error)


def pair_distances(descriptor: Descriptor, descriptions: Tensor, *, progress: bool = False) -> Tensor:
    """(N, N) distances of (N, ...) descriptions, by blocks of queries: some need memory for every entry of a pair."""
    rows = max(1, _BLOCK_ENTRIES // max(1, descriptions.numel()))
    blocks = []
    bar = tqdm(total=len(descriptions), desc=f"distances by {descriptor.name}", disable=not progress)
    with torch.inference_mode(), one_thread(), bar:
        for block in descriptions.split(rows):
            blocks.append(descriptor.distances(block, descriptions).cpu())
            bar.update(len(block))
    return torch.cat(blocks)
