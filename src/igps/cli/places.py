"""Pictures of the places in which two groups of bodies differ, for `igps groups` and `igps explain`."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from igps._arrays import Floats
from igps.analysis.groups import squared_distances
from igps.analysis.local_difference import (
    local_difference,
    misfit,
    offsets_of_bodies,
)
from igps.data.dataset import SignatureDataset
from igps.mesh.surface import vertex_areas
from igps.report.figures import Painted

_MAX_MISFIT = 0.03  # over √area; the smallest differences that are found reliably are a third of it


@dataclass(frozen=True, eq=False)
class Places:
    """Where two groups differ, on the body nearest to their mean."""

    painted: Painted
    legend: str
    words: str


def places_of_groups(
    dataset: SignatureDataset,
    members: Sequence[int],
    vectors: Floats,
    groups: Sequence[str],
    *,
    keep_size: bool,
    n_workers: int | None = None,
    **test: Any,
) -> Places:
    """Find where two groups differ.

    Args:
        dataset: bodies with their meshes.
        members: the indices of N bodies.
        vectors: (N, D) their descriptions.
        groups: the group of each of them.
        keep_size: whether bodies differ also by their size.
        n_workers: see `run`.
        test: options of `local_difference`.

    Raises:
        MeshError: the mesh of the painted body cannot be read again.
    """
    nearest = int(squared_distances(vectors).sum(axis=1).argmin())
    index = int(members[nearest])
    reference = dataset.mesh(index)
    rows = offsets_of_bodies(dataset, members, reference, keep_size=keep_size, n_workers=n_workers)
    is_read = np.isfinite(rows).all(axis=1)
    rows = rows[is_read]
    for name in ("strata", "covariates"):
        if test.get(name) is not None:
            test[name] = np.asarray(test[name])[is_read]
    found = local_difference(rows, np.asarray(groups)[is_read].tolist(), **test)
    first, second = found.groups
    unit = reference.unit or "no unit"
    size = "" if keep_size else ", at equal volume"
    name = dataset.bodies.names[index]
    painted = Painted(name, reference, found.offset, found.is_significant)
    areas = vertex_areas(reference.vertices, reference.faces)
    held = areas[found.is_significant].sum() / areas.sum()
    words = (
        f"{second} lies outside {first} by up to {found.offset.max():.2g} {unit}, inside by up to "
    )
    words += f"{-found.offset.min():.2g}{size}; {held:.1%} of the surface differs significantly; painted on {name}"
    lies = misfit(rows, reference)
    if lies > _MAX_MISFIT:
        words += f"\nthe bodies lie {lies:.1%} of √area apart: if their poses differ, do not trust the picture"
    legend = f"{second} outside {first} ({unit}{size}); pale: not significant"
    return Places(painted, legend, words)
