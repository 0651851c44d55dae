"""Explanations for the page of results: where each body differs from its nearest."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from igps._threads import one_thread
from igps.analysis.explanation import Shares, explain_bodies, share_density
from igps.analysis.superposition import movement
from igps.data.dataset import SignatureDataset
from igps.mesh.mesh import Mesh
from igps.nn.descriptor import Descriptor
from igps.report.results import System
from igps.report.surfaces import STEPS, PageSurface, page_axes, run_jobs
from igps.signature.signature import SAMPLE_KINDS, Signature


@dataclass(frozen=True, eq=False)
class SurfaceExplanation:
    """Explanation of the distance between a body and its nearest, on the vertices of both surfaces."""

    other: str  # name of the nearest body
    summary: str  # the largest shares of the distance, as text
    # (V,) of both surfaces: 128 for no share, larger for a share
    values: tuple[NDArray[np.uint8], NDArray[np.uint8]]


def keep_explanations(
    path: Path,
    system: System,
    dataset: SignatureDataset,
    descriptor: Descriptor,
    surfaces: Mapping[str, PageSurface],
    *,
    n_workers: int | None = None,
) -> dict[str, SurfaceExplanation]:
    """Explain the distance of each body to its nearest, and write the explanations to a NumPy archive.

    The descriptor, of histograms, is the one of the system's distances. Bodies without a surface are left out.
    """
    indices = {name: i for i, name in enumerate(dataset.bodies.names)}
    nearest = [system.names[row[0]] for row in system.ranked()] if len(system.names) > 1 else []
    pairs = [
        pair
        for pair in zip(system.names, nearest, strict=False)
        if set(pair) <= surfaces.keys() & indices.keys()
    ]
    jobs = {
        pair[0]: (
            descriptor,
            dataset.subset([indices[name] for name in pair]),
            [surfaces[name] for name in pair],
        )
        for pair in pairs
    }
    results = run_jobs(_explain_pair, jobs, "explanation", n_workers)
    results = {name: results[name] for name in system.names if name in results}
    values = [np.concatenate(painted.values) for painted in results.values()]
    np.savez_compressed(
        path,
        names=np.array(list(results), dtype=str),
        others=np.array([painted.other for painted in results.values()], dtype=str),
        told=np.array([painted.summary for painted in results.values()], dtype=str),
        counts=np.array([len(painted.values[0]) for painted in results.values()], dtype=np.int64),
        ends=np.cumsum([len(both) for both in values], dtype=np.int64),
        values=np.concatenate([np.empty(0, np.uint8), *values]),
    )
    return results


def read_explanations(
    path: Path, surfaces: Mapping[str, PageSurface]
) -> dict[str, SurfaceExplanation]:
    """Read explanations from an archive, by name, if their surfaces have not changed; none if there is no file."""
    if not path.is_file():
        return {}
    with np.load(path) as archive:
        arrays = {name: archive[name] for name in archive}
    results = {}
    columns = (arrays[name].tolist() for name in ("names", "others", "told", "counts"))
    split_values = np.split(arrays["values"], arrays["ends"])[:-1]
    for name, other, summary, count, values in zip(*columns, split_values, strict=True):
        sizes = [len(surfaces[body].vertices) if body in surfaces else -1 for body in (name, other)]
        if sizes == [count, len(values) - count]:
            results[name] = SurfaceExplanation(other, summary, (values[:count], values[count:]))
    return results


def _explain_pair(
    job: tuple[Descriptor, SignatureDataset, list[PageSurface]],
) -> SurfaceExplanation:
    descriptor, dataset, surfaces = job
    with one_thread():
        explanation = explain_bodies(descriptor, dataset, movement(*dataset.bodies))
    shares = explanation.places or explanation.samples
    first, second = (
        _vertex_values(dataset.mesh(i), dataset[i].signature, shares[i], surfaces[i])
        for i in (0, 1)
    )
    return SurfaceExplanation(dataset.bodies.names[1], explanation.summary(), (first, second))


def _vertex_values(
    mesh: Mesh, signature: Signature, shares: Shares, surface: PageSurface
) -> NDArray[np.uint8]:
    """Return the values (V,) of `SurfaceExplanation` at the vertices of a page surface."""
    axes = page_axes(mesh, signature.surface.points)
    samples = {kind: getattr(signature, kind).points @ axes for kind in SAMPLE_KINDS}
    vertices = mesh.vertices @ axes
    low = vertices.min(axis=0)
    high = vertices.max(axis=0)
    points = surface.vertices / STEPS - 0.5
    values = share_density(shares, samples, points * (high - low).max() + (low + high) / 2)
    largest = float(np.quantile(np.abs(values), 0.98)) or 1.0
    return np.rint(128 + 127 * np.clip(values / largest, -1, 1)).astype(np.uint8)
