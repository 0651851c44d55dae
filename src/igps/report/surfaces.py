"""Small surfaces of meshes for the page of results: few vertices, quantised, with the barycentroid potential."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from tqdm import tqdm

from igps._parallel import Failed, run
from igps.data.dataset import SignatureDataset
from igps.data.pipeline import SignaturePipeline
from igps.mesh.loading import BodyRef
from igps.mesh.mesh import Mesh, MeshError
from igps.mesh.simplification import simplify
from igps.mesh.surface import compact, longest_side
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
class Surface:
    """What is shown of a body.

    Args:
        vertices: (V, 3) uint16 in a cube around the body, the longest principal axis along y, the next along x.
        faces: (F, 3) uint16 vertex indices, counter-clockwise seen from outside.
        potential: (V,) uint8 barycentroid potential, from its least value on the surface to the largest.
        potential_range: these values, no unit.
        n_vertices: of the mesh that was described.
        n_faces: of that mesh.
        area: of that mesh, length².
        volume: of that mesh, length³.
        key: of the Signature in the cache, which tells whether the mesh file has changed since.
        unit: of length, such as "mm"; None where it is not known.
    """

    vertices: NDArray[np.uint16]
    faces: NDArray[np.uint16]
    potential: NDArray[np.uint8]
    potential_range: tuple[float, float]
    n_vertices: int
    n_faces: int
    area: float
    volume: float
    key: str
    unit: str | None = None

    def packed(self) -> bytes:
        """Vertices, faces and potential behind each other, little-endian."""
        parts = (self.vertices.astype("<u2"), self.faces.astype("<u2"), self.potential)
        return b"".join(part.tobytes() for part in parts)


def fitting_vertices(n_shapes: int) -> int:
    """How many vertices each of so many surfaces may have for their page to stay below 30 MB."""
    return int(np.clip(_MOST_BYTES / _BYTES_A_VERTEX / max(n_shapes, 1), _LEAST_VERTICES, _MOST_VERTICES))


def keep_surfaces(path: Path, dataset: SignatureDataset, *, n_workers: int | None = None) -> dict[str, Surface]:
    """The surfaces of meshes by name: read from `path` those that are there, computed and written the others.

    A mesh file that has changed since is read again; of one that is gone, what was kept serves.

    Args:
        path: an .npz file; see `write_surfaces`.
        dataset: the meshes, their signatures cached.
        n_workers: processes that compute; all cores if None.

    Returns:
        By name; a mesh that cannot be read, and was not kept, is left out and logged.
    """
    kept = read_surfaces(path)
    names, bodies = dataset.bodies.names, dataset.bodies
    missing = [i for i, name in enumerate(names) if not _is_current(dataset.pipeline, bodies[i], kept.get(name))]
    if missing:
        make = partial(surface_of_body, dataset.pipeline, n_vertices=fitting_vertices(len(names)))
        outcomes = run(make, [bodies[i] for i in missing], n_workers=n_workers)
        for number, outcome in tqdm(outcomes, total=len(missing), desc="pictures"):
            if isinstance(outcome, Failed):
                logger.warning("%s: no picture: %s", names[missing[number]], outcome.reason)
            else:
                kept[names[missing[number]]] = outcome
    found = {name: kept[name] for name in names if name in kept}
    if missing:
        write_surfaces(path, found)
    return found


def surface_of_body(pipeline: SignaturePipeline, body: BodyRef, n_vertices: int) -> Surface:
    """The surface of a body in a file.

    Raises:
        MeshError: it cannot be used.
    """
    return surface_of(pipeline.mesh(body), pipeline.signature(body), n_vertices, pipeline.key(body))


def surface_of(mesh: Mesh, signature: Signature, n_vertices: int, key: str = "") -> Surface:
    """The surface of a mesh with at most `n_vertices` vertices.

    Args:
        mesh: V vertices.
        signature: of the mesh; the potential is taken from its surface samples.
        n_vertices: at least 4.
        key: kept in the surface.
    """
    vertices, faces = _reduced(mesh, n_vertices)
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
    return Surface(
        vertices=np.rint(STEPS * in_cube).astype(np.uint16),
        faces=faces.astype(np.uint16),
        potential=np.rint(255 * (values - low) / ((high - low) or 1)).astype(np.uint8),
        potential_range=(low, high),
        n_vertices=len(mesh.vertices),
        n_faces=len(mesh.faces),
        area=mesh.area,
        volume=mesh.volume,
        key=key,
        unit=mesh.unit,
    )


def write_surfaces(path: Path, surfaces: Mapping[str, Surface]) -> None:
    """Write surfaces as a NumPy archive.

    The arrays of all N surfaces lie behind each other: `vertices` (ΣV, 3), `faces` (ΣF, 3) with indices that begin at 0
    in each surface, `potential` (ΣV,). Beside them (N,) `names`, `keys`, `units`, `counts` (N, 2) of vertices and of
    faces, `mesh_counts` (N, 2) of the mesh, and `measures` (N, 4): least and largest potential, area, volume.
    """
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


def read_surfaces(path: Path) -> dict[str, Surface]:
    """What `write_surfaces` wrote, by name; nothing where there is no file.

    Raises:
        ValueError: another kind of file.
    """
    return dict(_read(path)) if path.is_file() else {}


def _read(path: Path) -> Iterator[tuple[str, Surface]]:
    with np.load(path) as archive:
        if "format" not in archive or str(archive["format"]) != _FORMAT:
            raise ValueError(f"{path}: expected an archive of the format {_FORMAT}. Remove it to have it made again.")
        arrays = {name: archive[name] for name in archive}
    start_v, start_f = 0, 0
    for i, (n_vertices, n_faces) in enumerate(arrays["counts"].tolist()):
        low, high, area, volume = arrays["measures"][i].tolist()
        mesh_vertices, mesh_faces = arrays["mesh_counts"][i].tolist()
        yield (
            str(arrays["names"][i]),
            Surface(
                vertices=arrays["vertices"][start_v : start_v + n_vertices],
                faces=arrays["faces"][start_f : start_f + n_faces],
                potential=arrays["potential"][start_v : start_v + n_vertices],
                potential_range=(low, high),
                n_vertices=mesh_vertices,
                n_faces=mesh_faces,
                area=area,
                volume=volume,
                key=str(arrays["keys"][i]),
                unit=str(arrays["units"][i]) or None,
            ),
        )
        start_v, start_f = start_v + n_vertices, start_f + n_faces


def _is_current(pipeline: SignaturePipeline, body: BodyRef, kept: Surface | None) -> bool:
    """Whether the file is gone, or the one that the surface was made from."""
    if kept is None:
        return False
    try:
        return pipeline.key(body) == kept.key
    except MeshError:
        return True


def _reduced(mesh: Mesh, n_vertices: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    try:
        small = simplify(mesh, n_vertices)
    except MeshError:  # only to look at: what is between the handles may close
        return clustered(mesh.vertices, mesh.faces, n_vertices)
    return small.vertices, small.faces


def clustered(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], n_vertices: int
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
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


def axes_of(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) columns x, y, z of a right-handed frame: y along the longest principal axis, x along the next.

    The slender end is down and the wider side left, so that poses of one body are seen alike.
    """
    centred = points - points.mean(axis=0)
    axes: NDArray[np.float64] = np.linalg.svd(centred, full_matrices=False)[2][:2]
    slender = np.where(((centred @ axes.T) ** 3).mean(axis=0) < 0, -1, 1)
    up, right = -slender[0] * axes[0], slender[1] * axes[1]
    return np.stack([right, up, np.cross(right, up)], axis=1)
