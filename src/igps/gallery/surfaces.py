"""How far apart surfaces of bodies are, but for motion, mirror image and scale; and when they are the same.

A level of detail leaves open how a surface runs between its vertices. So two surfaces may be as far apart as that
explains: about as far as the coarser of the two is from itself with every vertex in the middle of its neighbours. What
"about" means is calibrated on generated bodies, see `Calibration`. Bodies with different numbers of handles are not the
same.
"""

import contextlib
import filecmp
import math
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache, partial
from typing import Literal

import numpy as np
import torch
from scipy.linalg import orthogonal_procrustes
from torch import Tensor
from tqdm import tqdm

from igps._arrays import Floats, Integers
from igps._parallel import on_threads
from igps.data.dataset import Failure, SignatureDataset
from igps.gallery._alignment import SurfaceSamples, TriangleSurface, offset_in_place, surface_distance
from igps.gallery._moments import moments
from igps.gallery.calibration import Calibration
from igps.mesh.loading import load_mesh
from igps.mesh.mending import Step, repair_steps
from igps.mesh.mesh import Mesh, MeshError
from igps.mesh.surface import mean_of_neighbours
from igps.signature.attributes import AttributeName
from igps.signature.signature import Signature

# Samples of surfaces, and surfaces, in memory at once.
_SURFACES, _TRIANGLES = 512, 64
_NORMALS: AttributeName = "surface_direction"
# A tenth of this is much between copies.
_HOPELESS = 0.03
# Copies differ by up to 0.045 in the logarithms of their extents; what differs by more is not laid onto each other
_MOST_STRETCHED = 0.1
MOST_TOLERATED = 0.02
"""Over √area: what is farther apart is not looked at closely."""

# How far rounding of coordinates in a file moves a vertex at most, over √area.
_ROUNDED = 5e-4

# How far the farthest sample may be off, over √area, where two surfaces are one and the same: ten times as far as in 40
# copies with other triangles. A hole that is 0.5 % larger is farther, if its radius is at least 0.005.
_ONE_SURFACE = 2.5e-5

Grade = Literal["same file", "same mesh", "same surface", "same at another level of detail"]
"""What two files of one body have in common, the most first; a mesh is the same with its vertices numbered alike."""

# What is done to a mesh that leaves its handles as they are.
_KEEP_HANDLES: set[Step] = {"welded", "smoothed", "subdivided"}


def distance_if_alike(
    one: SurfaceSamples, other: SurfaceSamples, *, enough: float = 0.0, most: float = math.inf
) -> float:
    """`surface_distance`, infinite where the extents of the two tell that they are not the same."""
    if np.abs(np.log(one.extents / other.extents)).max() > _MOST_STRETCHED:
        return math.inf
    return surface_distance(one, other, enough=enough, hopeless=_HOPELESS, most=most)


class Surfaces:
    """The samples of surfaces of a dataset, the last used of them in memory.

    Args:
        dataset: of meshes, whose Signatures give the samples; a mesh itself is read where another is near.
        tolerance: up to which two that are not the same are nearly so, over √area.

    Attributes:
        failures: of meshes that could not be read, by index.
        nearly: how far apart those are that `distance` found to be nearly the same, by their indices.

    Raises:
        ValueError: a tolerance within which nothing is looked for.
    """

    def __init__(self, dataset: SignatureDataset, tolerance: float = 0.0) -> None:
        if not 0 <= tolerance <= MOST_TOLERATED:
            raise ValueError(f"tolerance: expected 0 to {MOST_TOLERATED} of the root of the area, got {tolerance}.")
        self.failures: dict[int, Failure] = {}
        self.nearly: dict[tuple[int, int], float] = {}
        self._tolerance = tolerance
        self._dataset = dataset
        self._cached_samples = lru_cache(_SURFACES)(self.samples)
        self._cached_mesh = lru_cache(_TRIANGLES)(self._mesh)
        self._cached_triangles = lru_cache(_TRIANGLES)(self._triangles)
        self._cached_vertices = lru_cache(_TRIANGLES)(self._vertices_and_faces)
        self._cached_coarseness = lru_cache(None)(self._coarseness_and_handles)

    def samples(self, i: int) -> SurfaceSamples:
        """Those of one body; a MeshError if it cannot be used, a ValueError if its samples have no directions."""
        signature = self._signature(i)
        found = SurfaceSamples.of(signature.surface.points, signature.surface.attributes[_NORMALS], signature.area)
        return replace(found, surface=partial(self._cached_triangles, i))

    def coarseness(self, i: int) -> float:
        """How far one is from itself with each vertex in the middle of its neighbours, over √area.

        That is what its level of detail leaves open: how far chords cut round parts off, and other triangles sharp
        edges. On thin triangles, near neighbours count, see `mean_of_neighbours`. A MeshError if it cannot be used.
        """
        return self._cached_coarseness(i)[0]

    def distance(self, i: int, j: int, calibration: Calibration) -> float:
        """That of two, over √area; infinite where they are not the same, or one cannot be read."""
        try:
            one, other = self._cached_samples(i), self._cached_samples(j)
            most, limit = max(calibration.same.distance, self._tolerance), 0.0
            apart = distance_if_alike(one, other, enough=calibration.same.distance, most=most)
            if apart <= calibration.same.distance:
                limit = self.limit(i, j, calibration)
                if apart > limit > 0:
                    # The search has ended at what was near enough: the nearest may be within the limit.
                    apart = distance_if_alike(one, other, enough=limit, most=max(limit, self._tolerance))
            if apart <= limit:
                return apart
            if apart <= self._tolerance:
                self.nearly[min(i, j), max(i, j)] = apart
            return math.inf
        except MeshError:
            return math.inf

    def grade(self, i: int, j: int) -> tuple[Grade, float]:
        """What two have in common that are the same at their level of detail; how far the farthest sample is off.

        The latter over √area, for the same mesh the farthest vertex. A MeshError if one cannot be read.
        """
        one, other = self._dataset.bodies[i], self._dataset.bodies[j]
        with contextlib.suppress(OSError):
            if one.part == other.part and filecmp.cmp(one.path, other.path, shallow=False):
                return "same file", 0.0
        if (apart := self._farthest_vertex(i, j)) <= _ONE_SURFACE:
            return "same mesh", apart
        samples = map(self._cached_samples, (i, j))
        apart = surface_distance(*samples, enough=_ONE_SURFACE, hopeless=_HOPELESS, patch=1)
        return ("same surface" if apart <= _ONE_SURFACE else "same at another level of detail"), apart

    def length(self, i: int) -> tuple[float, str | None]:
        """√area of one, and its unit, if it is known."""
        signature = self._signature(i)
        return math.sqrt(signature.area), signature.unit

    def limit(self, i: int, j: int, calibration: Calibration) -> float:
        """How far two may be apart and the same, see `Calibration.limit`; raises as `coarseness` does.

        Not at all if one has more handles than the other, or if their vertices are numbered alike and lie elsewhere.
        """
        (coarseness, handles), (of_other, handles_of_other) = self._cached_coarseness(i), self._cached_coarseness(j)
        differ = None not in (handles, handles_of_other) and handles != handles_of_other
        if differ or _ROUNDED < self._farthest_vertex(i, j) < math.inf:
            return 0.0
        return calibration.limit(max(coarseness, of_other))

    def moments(
        self, most: float, n_workers: int | None = None, progress: bool = False
    ) -> tuple[Tensor, list[Failure]]:
        """(M, 7, 6) `moments` of all that can be read, in order, and failures of the others.

        A MeshError if none can be read.
        """

        def moments_of(i: int) -> Floats | None:
            with contextlib.suppress(MeshError):  # which is among the failures
                mesh = self._mesh(i)
                return moments(self._placed(i, mesh), mesh.faces, most)
            return None

        found = on_threads(moments_of, range(len(self._dataset)), n_workers)
        bar = tqdm(found, desc="surfaces", total=len(self._dataset), disable=not progress)
        some = [one for one in bar if one is not None]
        if not some:
            raise MeshError(self.failures[0].error)
        return torch.from_numpy(np.stack(some)), [self.failures[i] for i in sorted(self.failures)]

    def _coarseness_and_handles(self, i: int) -> tuple[float, int | None]:
        """Handles are None where the mesh is open, and where mending may have made some or closed holes."""
        mesh = self._cached_mesh(i)
        blurred = TriangleSurface(mean_of_neighbours(self._placed(i, mesh), mesh.faces), mesh.faces)
        handles = None
        if not set(repair_steps(mesh.notes)) - _KEEP_HANDLES:
            with contextlib.suppress(MeshError):
                handles = mesh.genus
        return offset_in_place(self._cached_samples(i), blurred), handles

    def _farthest_vertex(self, i: int, j: int) -> float:
        """How far the vertices of two lie apart that are numbered alike; infinite if they are not.

        Where faces join the same vertices, no level of detail explains a vertex that has moved.
        """
        (one, faces), (other, faces_of_other) = self._cached_vertices(i), self._cached_vertices(j)
        if not np.array_equal(faces, faces_of_other):
            return math.inf
        rotation, _ = orthogonal_procrustes(one, other)
        return float(np.linalg.norm(one @ rotation - other, axis=1).max())

    def _vertices_and_faces(self, i: int) -> tuple[Floats, Integers]:
        """The vertices about their mean, over √area, as they are in the file; and the faces, turned or not."""
        mesh = self._cached_mesh(i)
        if "subdivided" in repair_steps(mesh.notes):  # by more or less, as the configuration asks for eigenpairs
            body = self._dataset.bodies[i]
            mesh = load_mesh(body.path, self._dataset.pipeline.reading, part=body.part)
        return (mesh.vertices - mesh.vertices.mean(axis=0)) / math.sqrt(mesh.area), np.sort(mesh.faces, axis=1)

    def _triangles(self, i: int) -> TriangleSurface:
        mesh = self._cached_mesh(i)
        return TriangleSurface(self._placed(i, mesh), mesh.faces)

    def _placed(self, i: int, mesh: Mesh) -> Floats:
        """The vertices of one about the origin and in the unit of its samples."""
        signature = self._signature(i)
        return (mesh.vertices - signature.surface.points.mean(axis=0)) / math.sqrt(signature.area)

    def _mesh(self, i: int) -> Mesh:
        with self._kept_failure(i):
            return self._dataset.mesh(i)

    def _signature(self, i: int) -> Signature:
        with self._kept_failure(i):
            signature = self._dataset[i].signature
        if _NORMALS not in signature.surface.attributes:
            raise ValueError(
                f"attributes: expected {_NORMALS!r} among those of the surface samples, got "
                f"{sorted(signature.surface.attributes)}. Name it in SignatureConfig(attributes=...)."
            )
        return signature

    @contextlib.contextmanager
    def _kept_failure(self, i: int) -> Iterator[None]:
        try:
            yield
        except MeshError as error:
            self.failures[i] = Failure.of(self._dataset.bodies, i, str(error))
            raise
