"""Distances of the surfaces of bodies up to motion, reflection and scale, and the decision whether bodies are the same.

A coarse mesh leaves open how the surface runs between its vertices. So copies of a body may be some distance apart. The
limit is proportional to the coarseness of the coarser mesh: its distance from the mesh in which every vertex is moved
to the mean of its neighbours. The factor is calibrated on generated bodies, see `Calibration`. Bodies with different
numbers of handles are not the same.
"""

from __future__ import annotations

import contextlib
import filecmp
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import Literal

import numpy as np
import torch
from scipy.linalg import orthogonal_procrustes
from torch import Tensor

from igps._arrays import Floats, Integers
from igps._parallel import on_threads
from igps._progress import Progress
from igps.data.dataset import Failure, SignatureDataset
from igps.duplicates._alignment import (
    SurfaceSamples,
    TriangleSurface,
    changed_share,
    offset_in_place,
    surface_distance,
)
from igps.duplicates._moments import moments
from igps.duplicates.calibration import Calibration
from igps.mesh.errors import MeshError
from igps.mesh.loading import load_mesh
from igps.mesh.mending import Step, repair_steps
from igps.mesh.mesh import Mesh
from igps.mesh.surface import lengths, mean_of_neighbours
from igps.signature.attributes import AttributeName
from igps.signature.signature import Signature

_N_CACHED_SAMPLES = 512
_N_CACHED_MESHES = 64
_NORMALS: AttributeName = "surface_direction"
# Lengths are over √area.
# Distance at which an alignment is given up; a tenth of it is large between copies
_HOPELESS = 0.03
_MAX_STRETCH = 0.1  # difference of log extents above which bodies are not aligned; copies differ by up to 0.045
_ROUNDING = 5e-4  # largest displacement of a vertex by rounding of the coordinates in a file
# Largest deviation of a sample between triangulations of one surface: ten times that of 40 such copies. A hole that is
# 0.5 % larger deviates more, if its radius is at least 0.005.
_SAME_SURFACE = 2.5e-5

Grade = Literal["same file", "same mesh", "same surface", "same at another level of detail"]
"""Agreement of two files of one body, from the closest to the loosest. The same mesh has the same order of vertices."""

# A body is chiral if its mirror image is this many times as far from it as from its copy.
_CHIRAL = 2.0
# Smallest share of the flat places that tells a changed body, see `changed_share`
_MIN_CHANGED = 0.01

_HANDLE_PRESERVING: set[Step] = {"welded", "smoothed", "subdivided"}  # steps of mending


def distance_if_alike(
    one: SurfaceSamples,
    other: SurfaceSamples,
    *,
    stop_at: float = 0.0,
    max_distance: float = math.inf,
) -> float:
    """`surface_distance`, or infinity if the extents of the two surfaces differ too much."""
    if np.abs(np.log(one.extents / other.extents)).max() > _MAX_STRETCH:
        return math.inf
    return surface_distance(
        one, other, stop_at=stop_at, hopeless=_HOPELESS, max_distance=max_distance
    )


def _is_changed(one: SurfaceSamples, other: SurfaceSamples, distance: float) -> bool:
    """Return whether surfaces at this distance differ in a way that no level of detail explains."""
    return distance > _SAME_SURFACE and changed_share(one, other, _ROUNDING) >= _MIN_CHANGED


@dataclass(frozen=True, eq=False)
class _PlacedMesh:
    """A mesh and its vertices (V, 3) in the coordinates of its `SurfaceSamples`."""

    mesh: Mesh
    vertices: Floats

    @cached_property
    def triangles(self) -> TriangleSurface:
        """The surface, for searches of nearest points."""
        return TriangleSurface(self.vertices, self.mesh.faces)


class Surfaces:
    """Comparison of the surfaces of a dataset. The most recently used samples and meshes stay in memory.

    Args:
        dataset: the bodies. Their Signatures give samples; a mesh itself is read only if another body is near.

    Attributes:
        failures: bodies that could not be read, by index.
    """

    def __init__(self, dataset: SignatureDataset) -> None:
        self.failures: dict[int, Failure] = {}
        self._dataset = dataset
        self._cached_samples = lru_cache(_N_CACHED_SAMPLES)(self.samples)
        self._cached_mesh = lru_cache(_N_CACHED_MESHES)(self._placed_mesh)
        self._cached_coarseness = lru_cache(None)(self._coarseness_and_handles)

    def samples(self, i: int) -> SurfaceSamples:
        """Return the surface samples of a body; raise a MeshError if it is unusable, a ValueError without normals."""
        signature = self._signature(i)
        surface = signature.surface
        samples = SurfaceSamples.of(surface.points, surface.attributes[_NORMALS], signature.area)
        return replace(samples, surface=lambda: self._cached_mesh(i).triangles)

    def coarseness(self, i: int) -> float:
        """Return the distance, over √area, between a mesh and the mesh with vertices at the means of their neighbours.

        The distance measures the loss of detail, such as round parts and sharp edges that triangles cut off. Near
        neighbours weigh more, see `mean_of_neighbours`. Raises a MeshError if the body cannot be used.
        """
        return self._cached_coarseness(i)[0]

    def distance(self, i: int, j: int, calibration: Calibration) -> float:
        """Return the distance of two bodies over √area, or infinity if they differ or one of them cannot be read."""
        with contextlib.suppress(MeshError):  # recorded in `failures`
            one = self._cached_samples(i)
            other = self._cached_samples(j)
            limit = 0.0
            same = calibration.same.distance
            distance = distance_if_alike(one, other, stop_at=same, max_distance=same)
            if distance <= same:
                limit = self.limit(i, j, calibration)
                if distance > limit > 0:
                    # The search stopped below `same`. A longer search may get below the limit
                    distance = distance_if_alike(one, other, stop_at=limit, max_distance=limit)
            if distance <= limit and not _is_changed(one, other, distance):
                return distance
        return math.inf

    def grade(self, i: int, j: int) -> tuple[Grade, float]:
        """Return the grade of two copies and their largest deviation, over √area.

        The deviation is that of vertices for the same mesh, and that of samples otherwise. Raises a MeshError if a body
        cannot be read.
        """
        one = self._dataset.bodies[i]
        other = self._dataset.bodies[j]
        with contextlib.suppress(OSError):
            if one.part == other.part and filecmp.cmp(one.path, other.path, shallow=False):
                return "same file", 0.0
        deviation = self._vertex_deviation(i, j)
        if deviation <= _SAME_SURFACE:
            return "same mesh", deviation
        deviation = surface_distance(
            self._cached_samples(i),
            self._cached_samples(j),
            stop_at=_SAME_SURFACE,
            hopeless=_HOPELESS,
            patch_size=1,
        )
        if deviation <= _SAME_SURFACE:
            return "same surface", deviation
        return "same at another level of detail", deviation

    def is_mirrored(self, i: int, j: int) -> bool:
        """Return whether one of two copies is the mirror image of the other, and not also the other itself."""
        one = self._cached_samples(i)
        other = self._cached_samples(j)
        distance = partial(surface_distance, one, other, stop_at=_SAME_SURFACE, hopeless=_HOPELESS)
        largest = max(_CHIRAL * distance(side="mirrored"), _ROUNDING)
        return distance(side="same") > largest

    def length(self, i: int) -> tuple[float, str | None]:
        """Return √area of a body, and its unit of length if known."""
        signature = self._signature(i)
        return math.sqrt(signature.area), signature.unit

    def limit(self, i: int, j: int, calibration: Calibration) -> float:
        """Return the largest distance of two bodies that are the same, see `Calibration.limit`.

        The limit is 0 if the bodies have different numbers of handles, or if their meshes have the same faces, but
        vertices at other places. Raises a MeshError if a body cannot be used.
        """
        coarseness_i, handles_i = self._cached_coarseness(i)
        coarseness_j, handles_j = self._cached_coarseness(j)
        if None not in (handles_i, handles_j) and handles_i != handles_j:
            return 0.0
        if _ROUNDING < self._vertex_deviation(i, j) < math.inf:
            return 0.0
        return calibration.limit(max(coarseness_i, coarseness_j))

    def moments(
        self, max_move: float, n_workers: int | None = None, progress: bool = False
    ) -> tuple[Tensor, list[Failure]]:
        """Return the `moments` (M, 7, 6) of the bodies that can be read, in order, and the failures of the others.

        Raises a MeshError if no body can be read.
        """

        def moments_of(i: int) -> Floats | None:
            with contextlib.suppress(MeshError):  # recorded in `failures`
                body = self._placed_mesh(i)
                return moments(body.vertices, body.mesh.faces, max_move)
            return None

        results = on_threads(moments_of, range(len(self._dataset)), n_workers)
        bar = Progress(results, desc="surfaces", total=len(self._dataset), disable=not progress)
        usable = [result for result in bar if result is not None]
        if not usable:
            raise MeshError(self.failures[0].error)
        return torch.from_numpy(np.stack(usable)), [self.failures[i] for i in sorted(self.failures)]

    def _coarseness_and_handles(self, i: int) -> tuple[float, int | None]:
        """Return coarseness and number of handles: None for an open mesh, or if mending may have changed it."""
        body = self._cached_mesh(i)
        mesh = body.mesh
        smoothed = mean_of_neighbours(body.vertices, mesh.faces)
        surface = TriangleSurface(smoothed, mesh.faces)
        coarseness = offset_in_place(self._cached_samples(i), surface)
        handles = None
        if set(repair_steps(mesh.notes)) <= _HANDLE_PRESERVING:
            with contextlib.suppress(MeshError):
                handles = mesh.genus
        return coarseness, handles

    def _vertex_deviation(self, i: int, j: int) -> float:
        """Return the largest distance of vertices of the same index, or infinity if the faces of the meshes differ.

        Meshes with the same faces have the same level of detail, which therefore cannot explain a moved vertex.
        """
        one, faces_i = self._vertices_and_faces(i)
        other, faces_j = self._vertices_and_faces(j)
        if not np.array_equal(faces_i, faces_j):
            return math.inf
        rotation, _ = orthogonal_procrustes(one, other)
        return float(lengths(one @ rotation - other).max())

    def _vertices_and_faces(self, i: int) -> tuple[Floats, Integers]:
        """Return the vertices of the file, centred and over √area, and the faces with sorted corners."""
        mesh = self._cached_mesh(i).mesh
        if "subdivided" in repair_steps(mesh.notes):  # how finely depends on the eigenpairs
            body = self._dataset.bodies[i]
            mesh = load_mesh(body.path, self._dataset.pipeline.reading, part=body.part)
        centred = mesh.vertices - mesh.vertices.mean(axis=0)
        return centred / math.sqrt(mesh.area), np.sort(mesh.faces, axis=1)

    def _placed_mesh(self, i: int) -> _PlacedMesh:
        with self._record_failure(i):
            mesh = self._dataset.mesh(i)
        signature = self._signature(i)
        centred = mesh.vertices - signature.surface.points.mean(axis=0)
        return _PlacedMesh(mesh, centred / math.sqrt(signature.area))

    def _signature(self, i: int) -> Signature:
        with self._record_failure(i):
            signature = self._dataset[i].signature
        if _NORMALS not in signature.surface.attributes:
            names = sorted(signature.surface.attributes)
            raise ValueError(
                f"attributes: expected {_NORMALS!r}, got {names}. Name it in SignatureConfig(attributes=...)."
            )
        return signature

    @contextlib.contextmanager
    def _record_failure(self, i: int) -> Iterator[None]:
        try:
            yield
        except MeshError as error:
            self.failures[i] = Failure.of(self._dataset.bodies, i, str(error))
            raise
