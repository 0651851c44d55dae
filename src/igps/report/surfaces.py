"""Small surfaces of meshes for the page of results: few vertices, quantised, with the barycentroid potential."""

import contextlib
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from tqdm import tqdm

from igps._arrays import Floats, Integers
from igps._parallel import Failed, Job, Result, run
from igps.data.dataset import SignatureDataset
from igps.data.pipeline import SignaturePipeline
from igps.mesh.loading import BodyRef
from igps.mesh.mesh import Mesh, MeshError
from igps.mesh.simplification import simplify
from igps.mesh.surface import compact, longest_side
from igps.report.drawing import axes_of
from igps.signature.signature import Signature

logger = logging.getLogger(__name__)

_FORMAT = "igps-surfaces-2"
_MOST_VERTICES, _LEAST_VERTICES = 1200, 150
# What the surfaces of a page may take in all, and what a vertex takes: 19 bytes, in letters of six bits.
_MOST_BYTES, _BYTES_A_VERTEX = 20e6, 19 * 4 / 3
STEPS = 2**16 - 1
"""Into which the cube around a surface is divided along each axis."""
_NEIGHBOURS = 4  # samples that a vertex takes its potential from


@dataclass(frozen=True, eq=False)
class PageSurface:
    """The small surface of a body, for the page."""

    vertices: NDArray[np.uint16]  # (V, 3) in a cube around it, the longest principal axis along y, the next along x
    faces: NDArray[np.uint16]  # (F, 3), counter-clockwise seen from outside
    potential: NDArray[np.uint8]  # (V,) barycentroid potential, from its least value on the surface to the largest
    potential_range: tuple[float, float]  # these values, no unit
    n_vertices: int  # of the mesh that was described, as all that follows
    n_faces: int
    area: float  # length²
    volume: float  # length³
    key: str  # of the Signature in the cache, which tells whether the mesh file has changed since
    unit: str | None = None  # of length, such as "mm"; None where it is not known

    def packed(self) -> bytes:
        """Vertices, faces and potential behind each other, little-endian."""
        parts = (self.vertices.astype("<u2"), self.faces.astype("<u2"), self.potential)
        return b"".join(part.tobytes() for part in parts)


def fitting_vertices(n_shapes: int) -> int:
    """How many vertices each of so many surfaces may have for their page to stay below 30 MB."""
    return int(np.clip(_MOST_BYTES / _BYTES_A_VERTEX / max(n_shapes, 1), _LEAST_VERTICES, _MOST_VERTICES))


def keep_surfaces(path: Path, dataset: SignatureDataset, *, n_workers: int | None = None) -> dict[str, PageSurface]:
    """The surfaces of meshes by name: read from an archive those that are there, computed and written the others.

    A mesh file that has changed since is read again; of one that is gone, what was kept serves. A mesh that cannot be
    read, and was not kept, is left out and logged.
    """
    kept = read_surfaces(path)
    names, bodies = dataset.bodies.names, dataset.bodies
    missing = [i for i, name in enumerate(names) if not _is_current(dataset.pipeline, bodies[i], kept.get(name))]
    if missing:
        make = partial(_surface_of_body, dataset.pipeline, fitting_vertices(len(names)))
        jobs = {names[i]: bodies[i] for i in missing}
        kept |= run_jobs(make, jobs, "picture", n_workers)
    found = {name: kept[name] for name in names if name in kept}
    if missing:
        write_surfaces(path, found)
    return found


def run_jobs(
    work: Callable[[Job], Result], jobs: Mapping[str, Job], what: str, n_workers: int | None
) -> dict[str, Result]:
    """The results of jobs by name; a job that fails is logged as lacking `what`, and left out."""
    names, found = list(jobs), dict[str, Result]()
    with contextlib.closing(run(work, list(jobs.values()), n_workers=n_workers)) as outcomes:
        for number, outcome in tqdm(outcomes, total=len(jobs), desc=f"{what}s"):
            if isinstance(outcome, Failed):
                logger.warning("%s: no %s: %s", names[number], what, outcome.reason)
            else:
                found[names[number]] = outcome
    return found


def _surface_of_body(pipeline: SignaturePipeline, n_vertices: int, body: BodyRef) -> PageSurface:
    return surface_of(pipeline.mesh(body), pipeline.signature(body), n_vertices, pipeline.key(body))


def surface_of(mesh: Mesh, signature: Signature, n_vertices: int, key: str = "") -> PageSurface:
    """The surface of a mesh with at most `n_vertices` vertices; its potential is from samples of the Signature."""
    try:
        small = simplify(mesh, n_vertices)
        vertices, faces = small.vertices, small.faces
    except MeshError:  # only to look at: what is between the handles may close
        vertices, faces = clustered(mesh.vertices, mesh.faces, n_vertices)
    samples = signature.surface.points
    potential = np.sqrt(np.square(signature.surface.eigenfunctions, dtype=np.float64) @ (1 / signature.eigenvalues))
    distances, nearest = cKDTree(samples).query(vertices, min(_NEIGHBOURS, len(samples)))
    distances, nearest = distances.reshape(len(vertices), -1), nearest.reshape(len(vertices), -1)
    weights = 1 / (distances + 1e-6 * mesh.diagonal)
    values = (weights * potential[nearest]).sum(axis=1) / weights.sum(axis=1)
    low, high = float(values.min()), float(values.max())
    turned = vertices @ axes_of(samples)
    lowest, highest = turned.min(axis=0), turned.max(axis=0)
    in_cube = (turned - (lowest + highest) / 2) / (highest - lowest).max() + 0.5
    return PageSurface(
        np.rint(STEPS * in_cube).astype(np.uint16), faces.astype(np.uint16),
        np.rint(255 * (values - low) / ((high - low) or 1)).astype(np.uint8), (low, high),
        len(mesh.vertices), len(mesh.faces), mesh.area, mesh.volume, key, mesh.unit,
    )  # fmt: skip


def write_surfaces(path: Path, surfaces: Mapping[str, PageSurface]) -> None:
    """Write surfaces as a NumPy archive: the arrays of all behind each other, with the numbers that tell them apart."""
    many = list(surfaces.values())
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(
        path,
        format=np.array(_FORMAT),
        names=np.array(list(surfaces), dtype=str),
        keys=np.array([one.key for one in many], dtype=str),
        units=np.array([one.unit or "" for one in many], dtype=str),
        vertices=np.concatenate([np.empty((0, 3), np.uint16), *(one.vertices for one in many)]),
        faces=np.concatenate([np.empty((0, 3), np.uint16), *(one.faces for one in many)]),
        potential=np.concatenate([np.empty(0, np.uint8), *(one.potential for one in many)]),
        counts=np.array([(len(one.vertices), len(one.faces)) for one in many]).reshape(-1, 2),
        mesh_counts=np.array([(one.n_vertices, one.n_faces) for one in many]).reshape(-1, 2),
        measures=np.array([(*one.potential_range, one.area, one.volume) for one in many]).reshape(-1, 4),
    )


def read_surfaces(path: Path) -> dict[str, PageSurface]:
    """What `write_surfaces` wrote, by name; nothing where there is no file; a ValueError of another kind of file."""
    if not path.is_file():
        return {}
    with np.load(path) as archive:
        if "format" not in archive or str(archive["format"]) != _FORMAT:
            raise ValueError(f"{path}: expected an archive of the format {_FORMAT}. Remove it to have it made again.")
        arrays = {name: archive[name] for name in archive}
    ends = np.cumsum(arrays["counts"], axis=0)
    columns = [
        np.split(arrays[name], ends[:, of])[:-1] for name, of in (("vertices", 0), ("faces", 1), ("potential", 0))
    ]
    columns += [arrays[name].tolist() for name in ("names", "measures", "mesh_counts", "keys", "units")]
    return {
        name: PageSurface(vertices, faces, potential, (low, high), n_v, n_f, area, volume, key, unit or None)
        for vertices, faces, potential, name, (low, high, area, volume), (n_v, n_f), key, unit in zip(
            *columns, strict=True
        )
    }


def _is_current(pipeline: SignaturePipeline, body: BodyRef, kept: PageSurface | None) -> bool:
    """Whether the file is gone, or unchanged since the surface was made."""
    if kept is None:
        return False
    try:
        return pipeline.key(body) == kept.key
    except MeshError:
        return True


def clustered(vertices: Floats, faces: Integers, n_vertices: int) -> tuple[Floats, Integers]:
    """At most `n_vertices` vertices, each the mean of those in a cell of a grid (Rossignac and Borrel 1993).

    Handles and gaps may close, so that the result is good to look at and for nothing else.
    """
    low, extent = vertices.min(axis=0), longest_side(vertices)
    resolution = max(2, int(np.sqrt(n_vertices)))
    while True:
        cells = np.minimum((vertices - low) * (resolution / extent), resolution - 1).astype(np.int64)
        codes = cells @ np.array([resolution**2, resolution, 1])
        present, cell_of = np.unique(codes, return_inverse=True)
        if len(present) <= n_vertices or resolution == 1:
            break
        resolution = max(1, int(0.93 * resolution))
    counts = np.bincount(cell_of)
    means = np.stack([np.bincount(cell_of, vertices[:, axis]) / counts for axis in range(3)], axis=1)
    moved = cell_of[faces]
    whole = (moved != np.roll(moved, 1, axis=1)).all(axis=1)
    _, first = np.unique(np.sort(moved[whole], axis=1), axis=0, return_index=True)
    return compact(means, moved[whole][np.sort(first)])
