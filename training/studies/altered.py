"""Descriptions of meshes to which something was done before, on many processes."""

import contextlib
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from tqdm import tqdm

from igps._arrays import Singles
from igps._parallel import Failed, one_thread, run
from igps.data.collation import collate
from igps.data.dataset import SignatureDataset
from igps.mesh.mesh import Mesh
from igps.nn.descriptor import Descriptor
from igps.signature.signature import compute_signature

Way = Callable[[Mesh], Mesh]
"""Does something to a mesh; picklable."""

Answer = Singles | str
"""What a descriptor says of a body, or why it says nothing."""


def describe_altered(
    dataset: SignatureDataset,
    ways: Mapping[str, Way | None],
    descriptors: Sequence[Descriptor],
    *,
    n_workers: int | None = None,
) -> list[dict[str, dict[str, Answer]]]:
    """Of each mesh, by each way, what each descriptor says.

    What fails of one costs no other its answer.

    Args:
        dataset: N meshes, their signatures with all that the descriptors need.
        ways: by name; None leaves the mesh as it is and takes its signature from the cache.
        descriptors: by whose names the answers are called.
        n_workers: processes; all cores if None.

    Returns:
        N dicts: by way, by descriptor, the description or the reason why there is none.
    """
    jobs = [(dataset.subset([i]), way, descriptors) for i in range(len(dataset)) for way in ways.values()]
    places = [(i, name) for i in range(len(dataset)) for name in ways]
    found: list[dict[str, dict[str, Answer]]] = [{} for _ in range(len(dataset))]
    outcomes = run(_describe, jobs, n_workers=n_workers)
    with tqdm(total=len(jobs), desc="altered meshes") as bar, contextlib.closing(outcomes):
        for number, outcome in outcomes:
            bar.update()
            i, name = places[number]
            if isinstance(outcome, Failed):
                found[i][name] = dict.fromkeys((one.name for one in descriptors), outcome.reason)
            else:
                found[i][name] = outcome
    return found


def _describe(job: tuple[SignatureDataset, Way | None, Sequence[Descriptor]]) -> dict[str, Answer]:
    """What descriptors say of the one mesh of a dataset, after something was done to it."""
    dataset, way, descriptors = job
    if way is None:
        batch = dataset.batch([0], meshes=any(one.requirements.mesh for one in descriptors))
    else:
        mesh = way(dataset.mesh(0))
        batch = collate([compute_signature(mesh, dataset.config)], [mesh])
    answers: dict[str, Answer] = {}
    for descriptor in descriptors:
        try:
            with one_thread(), torch.inference_mode():
                description = descriptor(batch)[0].numpy()
            finite = bool(np.isfinite(description).all())
            answers[descriptor.name] = description if finite else "the description has entries that are not finite."
        except ValueError as error:
            answers[descriptor.name] = str(error)
        except Exception as error:  # of one descriptor, that must not stop the others
            answers[descriptor.name] = f"{type(error).__name__}: {error}"
    return answers
