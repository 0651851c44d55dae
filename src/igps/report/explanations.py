"""Where each body of a folder of results differs from its nearest, for the page."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from igps._parallel import one_thread
from igps.analysis.explanation import Shares, explain, on_surface
from igps.data.dataset import SignatureDataset
from igps.mesh.mesh import Mesh
from igps.nn.descriptor import Descriptor
from igps.report.drawing import axes_of
from igps.report.results import System
from igps.report.surfaces import STEPS, PageSurface, run_jobs
from igps.signature.signature import SAMPLE_KINDS, Signature


@dataclass(frozen=True, eq=False)
class Painted:
    """A body and its nearest."""

    other: str  # the name of the nearest
    told: str  # the largest shares of their distance, in words
    values: tuple[NDArray[np.uint8], NDArray[np.uint8]]  # (V,) of both surfaces: 128 where they are alike, or more


def keep_explanations(
    path: Path,
    system: System,
    dataset: SignatureDataset,
    descriptor: Descriptor,
    surfaces: Mapping[str, PageSurface],
    *,
    n_workers: int | None = None,
) -> dict[str, Painted]:
    """Explain the distance of each body to its nearest by a system, and write that as a NumPy archive.

    The descriptor is the one of histograms that the system's distances are by; bodies without a surface are left out.
    """
    place = {name: i for i, name in enumerate(dataset.bodies.names)}
    nearest = [system.names[row[0]] for row in system.ranked()] if len(system.names) > 1 else []
    pairs = [pair for pair in zip(system.names, nearest, strict=False) if set(pair) <= surfaces.keys() & place.keys()]
    jobs = {
        p[0]: (descriptor, dataset.subset([place[name] for name in p]), [surfaces[name] for name in p]) for p in pairs
    }
    found = run_jobs(_painted, jobs, "explanation", n_workers)
    found = {name: found[name] for name in system.names if name in found}
    both = [np.concatenate(one.values) for one in found.values()]
    np.savez_compressed(
        path,
        names=np.array(list(found), dtype=str),
        others=np.array([one.other for one in found.values()], dtype=str),
        told=np.array([one.told for one in found.values()], dtype=str),
        counts=np.array([len(one.values[0]) for one in found.values()], dtype=np.int64),
        ends=np.cumsum([len(one) for one in both], dtype=np.int64),
        values=np.concatenate([np.empty(0, np.uint8), *both]),
    )
    return found


def read_explanations(path: Path, surfaces: Mapping[str, PageSurface]) -> dict[str, Painted]:
    """What `keep_explanations` wrote, by name, where the surfaces are unchanged; nothing without a file."""
    if not path.is_file():
        return {}
    with np.load(path) as archive:
        kept = {name: archive[name] for name in archive}
    found = {}
    columns = (kept[name].tolist() for name in ("names", "others", "told", "counts"))
    for name, other, told, count, values in zip(*columns, np.split(kept["values"], kept["ends"])[:-1], strict=True):
        sizes = [len(surfaces[one].vertices) if one in surfaces else -1 for one in (name, other)]
        if sizes == [count, len(values) - count]:
            found[name] = Painted(other, told, (values[:count], values[count:]))
    return found


def _painted(job: tuple[Descriptor, SignatureDataset, list[PageSurface]]) -> Painted:
    descriptor, dataset, surfaces = job
    with one_thread():
        found = explain(descriptor, dataset.batch([0]), dataset.batch([1]))
    shares = found.places or found.samples
    one, other = (_values(dataset.mesh(i), dataset[i].signature, shares[i], surfaces[i]) for i in (0, 1))
    return Painted(dataset.bodies.names[1], found.summary(), (one, other))


def _values(mesh: Mesh, signature: Signature, shares: Shares, surface: PageSurface) -> NDArray[np.uint8]:
    """At the vertices of a surface, which lies in its cube as the mesh does in its own."""
    axes = axes_of(signature.surface.points)
    turned = {kind: getattr(signature, kind).points @ axes for kind in SAMPLE_KINDS}
    corners = mesh.vertices @ axes
    low, high = corners.min(axis=0), corners.max(axis=0)
    points = surface.vertices / STEPS - 0.5
    values = on_surface(shares, turned, points * (high - low).max() + (low + high) / 2)
    largest = float(np.quantile(np.abs(values), 0.98)) or 1.0
    return np.rint(128 + 127 * np.clip(values / largest, -1, 1)).astype(np.uint8)
