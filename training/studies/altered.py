"""Descriptions of altered meshes, on many processes."""

import contextlib
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from tqdm import tqdm

from igps._arrays import Singles
from igps._parallel import Failed, run
from igps._threads import one_thread
from igps.data.collation import collate
from igps.data.dataset import SignatureDataset
from igps.mesh.mesh import Mesh
from igps.nn.descriptor import Descriptor
from igps.signature.signature import compute_signature

Alteration = Callable[[Mesh], Mesh]
"""A picklable function that alters a mesh."""

Answer = Singles | str
"""The description of a body, or the reason why there is none."""


def describe_altered(
    dataset: SignatureDataset,
    alterations: Mapping[str, Alteration | None],
    descriptors: Sequence[Descriptor],
    *,
    n_workers: int | None = None,
) -> list[dict[str, dict[str, Answer]]]:
    """Describe each mesh after each alteration by each descriptor; failures do not affect other descriptions.

    Args:
        dataset: N meshes, with signatures that meet the requirements of the descriptors.
        alterations: alterations by name; None leaves the mesh unchanged and takes its signature from the cache.
        descriptors: descriptors with distinct names.
        n_workers: number of processes; all cores if None.

    Returns:
        N dicts: by alteration and by name of the descriptor, the description or the reason why there is none.
    """
    keys = [(i, name) for i in range(len(dataset)) for name in alterations]
    jobs = [(dataset.subset([i]), alterations[name], descriptors) for i, name in keys]
    answers: list[dict[str, dict[str, Answer]]] = [{} for _ in range(len(dataset))]
    outcomes = run(_describe, jobs, n_workers=n_workers)
    with tqdm(total=len(jobs), desc="altered meshes") as bar, contextlib.closing(outcomes):
        for number, outcome in outcomes:
            bar.update()
            i, name = keys[number]
            if isinstance(outcome, Failed):
                answers[i][name] = dict.fromkeys((x.name for x in descriptors), outcome.reason)
            else:
                answers[i][name] = outcome
    return answers


def _describe(
    job: tuple[SignatureDataset, Alteration | None, Sequence[Descriptor]],
) -> dict[str, Answer]:
    """Describe the only mesh of a dataset after an alteration."""
    dataset, alteration, descriptors = job
    if alteration is None:
        batch = dataset.batch([0], meshes=any(x.requirements.mesh for x in descriptors))
    else:
        mesh = alteration(dataset.mesh(0))
        batch = collate([compute_signature(mesh, dataset.config)], [mesh])
    answers: dict[str, Answer] = {}
    for descriptor in descriptors:
        try:
            with one_thread(), torch.inference_mode():
                description = descriptor(batch)[0].numpy()
            is_finite = bool(np.isfinite(description).all())
            answers[descriptor.name] = (
                description if is_finite else "the description has entries that are not finite."
            )
        except ValueError as error:
            answers[descriptor.name] = str(error)
        except Exception as error:  # one descriptor must not stop the others
            answers[descriptor.name] = f"{type(error).__name__}: {error}"
    return answers
