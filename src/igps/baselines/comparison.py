"""Systems side by side on a labelled collection: what each can describe, what that costs, and how it retrieves."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Generator, Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from igps.baselines.system import Body, System
from igps.data.dataset import Failure, SignatureDataset, n_cores, process_pool
from igps.geometry.mesh import MeshError
from igps.retrieval.scores import SCORE_NAMES, RetrievalScores, retrieval_scores

logger = logging.getLogger(__name__)

# Entries of the triples (query, gallery, entry of a description) that one block of distances may hold at once.
_BLOCK_ENTRIES = 2**26


@dataclass(frozen=True, eq=False)
class Result:
    """How one system did on a collection.

    Args:
        name: by which the system was asked for.
        system: with its parameters.
        names: the N meshes that it described, in the order of the collection.
        labels: their classes.
        distances: (N, N), row by row from a mesh as the query; None where they could not be computed.
        scores: leave-one-out among the N meshes; None without distances, and where no two meshes share a class.
        seconds_per_mesh: mean processor time of `describe`, without that of the signature; None where N is 0.
        failures: the meshes that it could not describe.
        error: why there are no scores; None if there are.
    """

    name: str
    system: System
    names: tuple[str, ...]
    labels: tuple[str, ...]
    distances: Tensor | None
    scores: RetrievalScores | None
    seconds_per_mesh: float | None
    failures: tuple[Failure, ...]
    error: str | None

    def row(self) -> dict[str, Any]:
        """The line of a table: mean scores as fractions, None where there are none, and what they cost."""
        scores: dict[str, Any] = dict.fromkeys(SCORE_NAMES) if self.scores is None else self.scores.mean()
        return {
            "descriptor": self.name,
            **{name: scores[name] for name in SCORE_NAMES},
            "seconds_per_mesh": self.seconds_per_mesh,
            "n_models": len(self.names),
            "invariant_to": list(self.system.invariant_to),
        }


def compare(
    dataset: SignatureDataset,
    systems: Mapping[str, System],
    *,
    n_workers: int | None = None,
    strict: bool = False,
    progress: bool = True,
) -> Iterator[Result]:
    """Run systems over a labelled collection, and yield the result of each as soon as it is there.

    A mesh that a system cannot describe is listed in the failures of that system, and its scores are among the other
    meshes. `describe` is timed mesh by mesh, one core each, from the cached signature on: with the reading of the mesh
    file for the systems that need it, without the signature itself. Fill the cache first (`dataset.precompute`).

    Args:
        dataset: N meshes with classes.
        systems: by name, in the order of the results.
        n_workers: processes that describe; all cores if None.
        strict: raise at the first mesh that cannot be described instead of listing it.
        progress: show a bar.

    Raises:
        ValueError: the meshes have no classes.
        MeshError: a mesh that cannot be described, if `strict`.
    """
    if dataset.files.labels is None:
        raise ValueError("dataset: expected meshes with classes, got none. Give labels, or a folder per class.")
    meshes = [dataset.subset([i]) for i in range(len(dataset))]
    jobs = [(system, mesh) for system in systems.values() for mesh in meshes]
    n_workers = min(n_workers or n_cores(), max(len(jobs), 1))
    with (
        tqdm(total=len(jobs), disable=not progress) as bar,
        contextlib.closing(_outcomes(jobs, n_workers)) as outcomes,
    ):
        for name, system in systems.items():
            bar.set_description(name)
            mine = []
            for mesh in meshes:
                outcome = next(outcomes)
                bar.update()
                if isinstance(outcome, str):
                    if strict:
                        raise MeshError(f"{name}: {outcome}")
                    logger.warning("%s: skipped: %s", name, outcome)
                mine.append((mesh, outcome))
            yield _result(name, system, mine)


@dataclass(frozen=True, eq=False)
class _Described:
    description: NDArray[np.float32]
    seconds: float


_Job = tuple[System, SignatureDataset]
_Outcome = _Described | str


def _describe(job: _Job) -> _Outcome:
    """Describe one mesh; the reason if that fails, because one mesh must not stop the others."""
    system, dataset = job
    path = dataset.files.paths[0]
    try:
        body = Body(dataset[0].signature, partial(dataset.mesh, 0))
        with _one_thread():
            start = time.process_time()
            description = np.asarray(system.describe(body), dtype=np.float32)
            seconds = time.process_time() - start
        if not np.isfinite(description).all():
            return f"{path}: the description has entries that are not finite."
    except MeshError as error:
        return str(error)
    except Exception as error:
        return f"{path}: {type(error).__name__}: {error}"
    return _Described(description, seconds)


def _outcomes(jobs: Sequence[_Job], n_workers: int) -> Generator[_Outcome, None, None]:
    """The outcome of every job, in order."""
    if n_workers == 1:
        yield from map(_describe, jobs)
        return
    done, alone = 0, False
    while done < len(jobs):
        with process_pool(1 if alone else n_workers) as pool:
            pool.submit(int).result()  # raises where no worker can start, for which no job is to blame
            try:
                # The iterator is a generator, whose end cancels what has not begun.
                results = cast("Generator[_Outcome, None, None]", pool.map(_describe, jobs[done:]))
                with contextlib.closing(results):
                    for outcome in results:
                        done += 1
                        yield outcome
            except BrokenProcessPool:
                # A worker was killed, mostly for want of memory, and the pool does not tell which job it had. One
                # worker that goes on from the first job without an outcome does: where it is killed too, that job is
                # to blame.
                if alone:
                    path = jobs[done][1].files.paths[0]
                    done += 1
                    yield f"{path}: the process that described it was killed. It may need more memory than there is."
                alone = not alone


def _result(name: str, system: System, outcomes: Sequence[tuple[SignatureDataset, _Outcome]]) -> Result:
    names, descriptions, seconds, failures = [], [], [], []
    labels: list[str] = []
    for mesh, outcome in outcomes:
        (path,), (mesh_name,) = mesh.files.paths, mesh.files.names
        if isinstance(outcome, str):
            failures.append(Failure(mesh_name, path, outcome))
            continue
        names.append(mesh_name)
        labels.extend(mesh.files.labels or ())
        descriptions.append(outcome.description)
        seconds.append(outcome.seconds)
    distances, scores, error = None, None, None
    try:
        if not descriptions:
            raise ValueError("no mesh could be described.")
        distances = _distances(system, torch.from_numpy(np.stack(descriptions)))
        scores = retrieval_scores(distances, labels)
    except Exception as reason:  # the other systems go on
        error = f"{type(reason).__name__}: {reason}"
        logger.warning("%s: no scores: %s", name, error)
    return Result(
        name=name,
        system=system,
        names=tuple(names),
        labels=tuple(labels),
        distances=distances,
        scores=scores,
        seconds_per_mesh=float(np.mean(seconds)) if seconds else None,
        failures=tuple(failures),
        error=error,
    )


def _distances(system: System, descriptions: Tensor) -> Tensor:
    """(N, N) distances, by blocks of queries, because a system may need memory for every entry of every pair."""
    rows = max(1, _BLOCK_ENTRIES // max(1, descriptions.numel()))
    with torch.inference_mode(), _one_thread():
        return torch.cat([system.distances(block, descriptions).cpu() for block in descriptions.split(rows)])


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Torch on one thread: the workers have a core each, and more threads would wait for each other."""
    n_threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(n_threads)
