"""Simplified surfaces for the page of results: few vertices, quantised, with the barycentroid potential."""

import contextlib
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from igps._arrays import Floats, Integers
from igps._parallel import run
from igps._progress import Progress
from igps.data.dataset import SignatureDataset
from igps.data.pipeline import SignaturePipeline
from igps.failures import Failed
from igps.mesh._collapse_loops import collapse_edges
from igps.mesh.errors import MeshError
from igps.mesh.loading import BodyRef
from igps.mesh.mesh import Frame, Mesh
from igps.mesh.surface import compact, longest_side
from igps.report.drawing import axes_of
from igps.report.views import patient_views
from igps.signature.signature import Signature

logger = logging.getLogger(__name__)

_FORMAT = "igps-surfaces-3"
_MAX_VERTICES, _MIN_VERTICES = 1200, 150  # of one surface
# Size of all surfaces of a page, and of one vertex, which has 19 bytes as text in base 64
_MAX_BYTES = 20e6
_BYTES_PER_VERTEX = 19 * 4 / 3
_STEPS = 2**16 - 1  # along each axis of the cube in which vertices are quantised
_N_NEIGHBOURS = 4  # samples whose mean is the potential of a vertex


@dataclass(frozen=True, eq=False)
class PageSurface:
    """The simplified surface of a body on the page."""

    vertices: NDArray[np.uint16]  # (V, 3) in the bounding cube, with axes by `page_axes`
    faces: NDArray[np.uint16]  # (F, 3), counter-clockwise seen from outside
    # (V,) barycentroid potential, 0 at its minimum on the surface, 255 at its maximum
    potential: NDArray[np.uint8]
    potential_range: tuple[float, float]  # minimum and maximum of the potential, no unit
    n_vertices: int  # of the original mesh, as the following fields
    n_faces: int
    area: float  # length²
    volume: float  # length³
    key: str  # cache key of the Signature, which changes with the mesh file
    unit: str | None = None  # of length, such as "mm"; None if unknown
    frame: Frame = None  # "RAS" if x points to the patient's left, y up and z to the front

    def packed(self) -> bytes:
        """Return the bytes of vertices, faces and potential, in this order and little-endian."""
        parts = (self.vertices.astype("<u2"), self.faces.astype("<u2"), self.potential)
        return b"".join(part.tobytes() for part in parts)


def fitting_vertices(n_shapes: int) -> int:
    """Return the largest number of vertices of each surface that keeps a page of n shapes below 30 MB."""
    return int(
        np.clip(_MAX_BYTES / _BYTES_PER_VERTEX / max(n_shapes, 1), _MIN_VERTICES, _MAX_VERTICES)
    )


def keep_surfaces(
    path: Path, dataset: SignatureDataset, *, n_workers: int | None = None
) -> dict[str, PageSurface]:
    """Return the surfaces of meshes by name, from an archive where possible; compute and store the others.

    The surface of a mesh file that has changed is computed again; that of a deleted file is used from the archive. A
    mesh that cannot be read and is not in the archive is logged and left out.
    """
    stored = read_surfaces(path)
    names = dataset.bodies.names
    bodies = dataset.bodies
    missing = [
        i
        for i, name in enumerate(names)
        if not _is_current(dataset.pipeline, bodies[i], stored.get(name))
    ]
    if missing:
        make = partial(_surface_of_body, dataset.pipeline, fitting_vertices(len(names)))
        stored |= _made(make, {names[i]: bodies[i] for i in missing}, n_workers)
    surfaces = {name: stored[name] for name in names if name in stored}
    if missing:
        write_surfaces(path, surfaces)
    return surfaces


def _made(
    make: Callable[[BodyRef], PageSurface], bodies: Mapping[str, BodyRef], n_workers: int | None
) -> dict[str, PageSurface]:
    """Return the surfaces of bodies by name, made in parallel; a body that fails is logged and left out."""
    names = list(bodies)
    surfaces: dict[str, PageSurface] = {}
    with contextlib.closing(run(make, list(bodies.values()), n_workers=n_workers)) as outcomes:
        for number, outcome in Progress(outcomes, total=len(names), desc="pictures"):
            if isinstance(outcome, Failed):
                logger.warning("%s: no picture: %s", names[number], outcome.reason)
            else:
                surfaces[names[number]] = outcome
    return surfaces


def _surface_of_body(pipeline: SignaturePipeline, n_vertices: int, body: BodyRef) -> PageSurface:
    return surface_of(pipeline.mesh(body), pipeline.signature(body), n_vertices, pipeline.key(body))


def surface_of(mesh: Mesh, signature: Signature, n_vertices: int, key: str = "") -> PageSurface:
    """Return a surface of at most `n_vertices` vertices, with the potential interpolated from surface samples."""
    vertices = mesh.vertices
    faces = mesh.faces
    if len(vertices) > n_vertices:
        scale = longest_side(vertices)
        vertices, faces = collapse_edges(vertices / scale, faces, n_vertices)
        vertices = vertices * scale
    if len(vertices) > n_vertices:  # fewer would close handles, which is good enough for display
        vertices, faces = clustered(vertices, faces, n_vertices)
    samples = signature.surface.points
    potential = np.sqrt(
        np.square(signature.surface.eigenfunctions, dtype=np.float64) @ (1 / signature.eigenvalues)
    )
    distances, nearest = cKDTree(samples).query(vertices, min(_N_NEIGHBOURS, len(samples)))
    distances = distances.reshape(len(vertices), -1)
    nearest = nearest.reshape(len(vertices), -1)
    weights = 1 / (distances + 1e-6 * mesh.diagonal)
    values = (weights * potential[nearest]).sum(axis=1) / weights.sum(axis=1)
    low = float(values.min())
    high = float(values.max())
    rotated = vertices @ page_axes(mesh, samples)
    lowest = rotated.min(axis=0)
    highest = rotated.max(axis=0)
    in_cube = (rotated - (lowest + highest) / 2) / (highest - lowest).max() + 0.5
    return PageSurface(
        np.rint(_STEPS * in_cube).astype(np.uint16),
        faces.astype(np.uint16),
        np.rint(255 * (values - low) / ((high - low) or 1)).astype(np.uint8),
        (low, high),
        len(mesh.vertices),
        len(mesh.faces),
        mesh.area,
        mesh.volume,
        key,
        mesh.unit,
        mesh.frame,
    )


def page_axes(mesh: Mesh, samples: Floats) -> Floats:
    """Return the axes (3, 3) of a body on the page: the view from the front of a patient, or its principal axes."""
    if mesh.frame == "RAS":
        return patient_views()[0].axes
    return axes_of(samples)


def write_surfaces(path: Path, surfaces: Mapping[str, PageSurface]) -> None:
    """Write surfaces to a NumPy archive, as concatenated arrays with the sizes of each surface."""
    values = list(surfaces.values())
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(
        path,
        format=np.array(_FORMAT),
        names=np.array(list(surfaces), dtype=str),
        keys=np.array([s.key for s in values], dtype=str),
        units=np.array([s.unit or "" for s in values], dtype=str),
        frames=np.array([s.frame or "" for s in values], dtype=str),
        vertices=np.concatenate([np.empty((0, 3), np.uint16), *(s.vertices for s in values)]),
        faces=np.concatenate([np.empty((0, 3), np.uint16), *(s.faces for s in values)]),
        potential=np.concatenate([np.empty(0, np.uint8), *(s.potential for s in values)]),
        counts=np.array([(len(s.vertices), len(s.faces)) for s in values]).reshape(-1, 2),
        mesh_counts=np.array([(s.n_vertices, s.n_faces) for s in values]).reshape(-1, 2),
        measures=np.array([(*s.potential_range, s.area, s.volume) for s in values]).reshape(-1, 4),
    )


def read_surfaces(path: Path) -> dict[str, PageSurface]:
    """Read an archive of `write_surfaces`, by name; return an empty dictionary if there is no file.

    Raises:
        ValueError: the file has another format.
    """
    if not path.is_file():
        return {}
    with np.load(path) as archive:
        if "format" not in archive or str(archive["format"]) != _FORMAT:
            raise ValueError(
                f"{path}: expected an archive of the format {_FORMAT}. Delete it and run again."
            )
        arrays = {name: archive[name] for name in archive}
    ends = np.cumsum(arrays["counts"], axis=0)
    columns = [
        np.split(arrays[name], ends[:, i])[:-1]
        for name, i in (("vertices", 0), ("faces", 1), ("potential", 0))
    ]
    columns += [
        arrays[name].tolist()
        for name in ("names", "measures", "mesh_counts", "keys", "units", "frames")
    ]
    return {
        name: PageSurface(
            vertices,
            faces,
            potential,
            (low, high),
            n_v,
            n_f,
            area,
            volume,
            key,
            unit or None,
            frame or None,
        )
        for vertices, faces, potential, name, (low, high, area, volume), (
            n_v,
            n_f,
        ), key, unit, frame in zip(*columns, strict=True)
    }


def _is_current(pipeline: SignaturePipeline, body: BodyRef, stored: PageSurface | None) -> bool:
    """Return whether a stored surface can be used: the file is unchanged, or it was deleted."""
    if stored is None:
        return False
    try:
        return pipeline.key(body) == stored.key
    except MeshError:
        return True


def clustered(vertices: Floats, faces: Integers, n_vertices: int) -> tuple[Floats, Integers]:
    """Simplify a surface to at most `n_vertices` vertices by clustering in a grid (Rossignac and Borrel 1993).

    Handles and gaps may close, so the result is suitable only for display.
    """
    low = vertices.min(axis=0)
    extent = longest_side(vertices)
    resolution = max(2, int(np.sqrt(n_vertices)))
    while True:
        cells = np.minimum((vertices - low) * (resolution / extent), resolution - 1).astype(
            np.int64
        )
        codes = cells @ np.array([resolution**2, resolution, 1])
        present, cell_of = np.unique(codes, return_inverse=True)
        if len(present) <= n_vertices or resolution == 1:
            break
        resolution = max(1, int(0.93 * resolution))
    counts = np.bincount(cell_of)
    means = np.stack(
        [np.bincount(cell_of, vertices[:, axis]) / counts for axis in range(3)], axis=1
    )
    clusters = cell_of[faces]
    # Without collapsed faces
    clusters = clusters[(clusters != np.roll(clusters, 1, axis=1)).all(axis=1)]
    _, first = np.unique(np.sort(clusters, axis=1), axis=0, return_index=True)
    return compact(means, clusters[np.sort(first)])
