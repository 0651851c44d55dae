"""Computation of the Signature of a mesh: eigenfunctions sampled in the interior and on the surface."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike

from igps._arrays import Floats, Singles
from igps._threads import one_thread
from igps.mesh.errors import MeshError
from igps.mesh.mesh import Mesh
from igps.mesh.objects import as_mesh
from igps.mesh.simplification import simplify
from igps.mesh.surface import face_areas
from igps.signature.attributes import interior_attributes, surface_attributes
from igps.signature.config import SignatureConfig
from igps.signature.laplacian import laplacian
from igps.signature.mean_value import Extension
from igps.signature.measures import measures
from igps.signature.ordering import (
    nearest_spacing,
    ordering_keys,
    spatial_ordering_keys,
    vertex_area_shares,
)
from igps.signature.sampling import surface_points
from igps.signature.voxels import interior_samples

if TYPE_CHECKING:
    import trimesh

    from igps.spectra import Spectrum

__all__ = [
    "SAMPLE_KINDS",
    "SampleKind",
    "Samples",
    "Signature",
    "SignatureConfig",
    "compute_signature",
]

logger = logging.getLogger(__name__)

SampleKind = Literal["interior", "surface"]
SAMPLE_KINDS: tuple[SampleKind, ...] = ("interior", "surface")

# Largest relative residual of an eigenpair. It is mostly far smaller; meshes with very thin triangles do not allow much
# less because of rounding, and a smaller one does not change the histograms.
_MAX_RESIDUAL = 1e-6


@dataclass(frozen=True, eq=False)
class Samples:
    """Points that carry the eigenfunctions."""

    points: Floats  # (P, 3) length
    eigenfunctions: Singles  # (P, K) 1/length, not scaled by any power of the eigenvalues
    # by name, each (P,) or (P, C); a direction has C = 3
    attributes: Mapping[str, Singles] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.points)

    def with_attributes(self, values: Mapping[str, ArrayLike]) -> Samples:
        """Return the samples with more attributes, such as a field or an image at their points; no spectrum is needed.

        Values at the vertices of a mesh can be extended to the points by `igps.signature.mean_value.extend`.

        Example:
            >>> samples = Samples(np.array([[0.0, 0, 1], [0, 0, 3]]), np.ones((2, 5), np.float32))
            >>> samples.with_attributes({"height": samples.points[:, 2]}).attributes["height"]
            array([1., 3.], dtype=float32)

        Args:
            values: by name, (P,) or (P, C): a number for each of the P points, or C numbers, such as a direction. An
                existing attribute of the same name is replaced.

        Raises:
            ValueError: values have another shape, or are not finite.
        """
        attributes = dict(self.attributes)
        for name, value in values.items():
            array = np.asarray(value, dtype=np.float32)
            fits = array.ndim in (1, 2) and len(array) == len(self)
            n_not_finite = int((~np.isfinite(array)).sum())
            if not fits or n_not_finite:
                raise ValueError(
                    f"{name}: expected a finite number, or several, for each of {len(self)} "
                    f"points, got an array of shape {array.shape} with {n_not_finite} values "
                    "that are not finite."
                )
            attributes[name] = array
        return replace(self, attributes=attributes)


@dataclass(frozen=True, eq=False)
class Signature:
    """Eigenvalues of one mesh, and its eigenfunctions at samples: the input of all descriptors.

    The eigenfunctions are stored unscaled, so that every spectral embedding can be derived from them.

    Example:
        >>> import trimesh
        >>> ball = trimesh.creation.icosphere(subdivisions=3)
        >>> signature = compute_signature(ball, SignatureConfig(n_eigenpairs=20))
        >>> signature.interior.eigenfunctions.shape[1], signature.surface.points.shape
        (20, (2000, 3))
        >>> bool(np.linalg.norm(signature.barycentroid) < 0.1)  # of the ball's radius
        True

    Args:
        eigenvalues: (K,) float64 ascending, 1/length², without the zero of the constant eigenfunction.
        interior: P voxel centres inside the body; eigenfunctions are extended to them by mean value coordinates.
        surface: area-weighted random points of the surface; eigenfunctions are interpolated linearly. The order of both
            kinds of samples depends only on the shape of the body, see `ordering_keys`.
        area: of the surface, length².
        volume: of the body, length³.
        config: the parameters of the computation.
        name: of the mesh.
        notes: changes made to the mesh, and fallbacks of the computation, in words.
        residual: largest residual of the eigenpairs, relative to the eigenvalue; NaN if unknown.
        unit: of length, such as "mm"; None if unknown.
        measures: plain numbers by name, see `igps.measures`; none if the configuration does not ask for them.
    """

    eigenvalues: Floats
    interior: Samples
    surface: Samples
    area: float
    volume: float
    config: SignatureConfig
    name: str = "mesh"
    notes: tuple[str, ...] = ()
    residual: float = math.nan
    unit: str | None = None
    measures: Mapping[str, float] = field(default_factory=dict)

    @property
    def barycentroid(self) -> Floats:
        """Interior sample (3,) of smallest potential Σ φₖ²/λₖ, a centre that hardly moves with pose (Rustamov 2010)."""
        squares = np.square(self.interior.eigenfunctions, dtype=np.float64)
        potential = squares @ (1 / self.eigenvalues)
        return self.interior.points[int(np.argmin(potential))]


@one_thread()
def compute_signature(
    mesh: Mesh | trimesh.Trimesh, config: SignatureConfig | None = None
) -> Signature:
    """Sample the eigenfunctions of a mesh in its interior and on its surface (Rustamov 2010, section 3).

    The eigenfunctions of a body with cavities are those of its outer surface. Mean value coordinates of the outer
    surface extend them to the wall and to the surfaces of the cavities. A cavity is thus a missing part of the
    interior: as it shrinks, the Signature tends to that of the full body, and the two sides of a thin wall lie side by
    side. With eigenfunctions of their own, the surfaces would be orthogonal, at an infinite commute time.

    Example:
        The first eigenvalues of the unit sphere are l (l + 1), each 2 l + 1 times.

        >>> import trimesh
        >>> ball = trimesh.creation.icosphere(subdivisions=3)
        >>> signature = compute_signature(ball, SignatureConfig(n_eigenpairs=8))
        >>> signature.eigenvalues.round(1).tolist()
        [2.0, 2.0, 2.0, 6.0, 6.0, 6.0, 6.0, 6.0]

    Args:
        mesh: the body, or an object that `as_mesh` accepts.
        config: `SignatureConfig()` if None.

    Raises:
        TypeError: `as_mesh` does not accept the mesh.
        MeshError: the mesh has too few vertices for the eigenpairs, or no interior sample.
        ConvergenceError: the eigensolver failed.
    """
    config = (config or SignatureConfig()).resolved()
    mesh = as_mesh(mesh).numbered_by_faces()  # rounding depends on the numbering
    whole = mesh
    if config.max_vertices is not None:
        mesh = simplify(mesh, config.max_vertices)
    outer, is_outer = mesh.outer()
    if len(outer.vertices) < config.n_kept + 2:
        raise MeshError(
            f"{mesh.name}: expected at least {config.n_kept + 2} vertices for {config.n_kept} eigenpairs, got "
            f"{len(outer.vertices)}. Subdivide the mesh or lower n_eigenpairs."
        )
    points = interior_samples(mesh, config.resolution, config.min_samples)
    usual_points = points if config.has_usual_samples else None
    numbers = measures(whole, usual_points) if config.measures else {}
    if config.n_kept == 0:
        return _without_eigenpairs(mesh, points, config, numbers)
    spectrum, notes = _spectrum(outer, config)
    eigenvalues = spectrum.eigenvalues
    functions = spectrum.eigenfunctions
    residual = spectrum.residual
    roots = np.sqrt(eigenvalues)
    # The accuracy is that of interior distances, which are distances between rows of eigenfunctions over √λ.
    extend = Extension(
        outer.vertices, outer.faces, functions, divisors=roots, accuracy=config.accuracy
    )
    if not is_outer.all():
        functions = np.empty((len(mesh.vertices), len(eigenvalues)))
        functions[is_outer] = spectrum.eigenfunctions
        functions[~is_outer] = extend(mesh.vertices[~is_outer]) * roots
    surface = _surface(mesh, functions, eigenvalues, config)
    del spectrum, functions  # on a large mesh they take more memory than all else
    interior = _interior(mesh, extend, eigenvalues, points, config)
    for where, samples in (("interior", interior), ("surface", surface)):
        if not np.isfinite(samples.eigenfunctions).all():
            raise MeshError(
                f"{mesh.name}: expected finite eigenfunctions, got NaN or infinity at some {where} samples. The "
                "triangles are too ill-shaped: pass backend='robust', or remesh."
            )
    return Signature(
        eigenvalues,
        interior,
        surface,
        mesh.area,
        mesh.volume,
        config,
        mesh.name,
        notes=(*mesh.notes, *notes),
        residual=residual,
        unit=mesh.unit,
        measures=numbers,
    )


def _without_eigenpairs(
    mesh: Mesh, points: Floats, config: SignatureConfig, numbers: Mapping[str, float]
) -> Signature:
    """Return samples, attributes and plain numbers alone."""
    keys = spatial_ordering_keys(mesh)
    surface = surface_points(mesh, config.n_surface_samples, config.seed, keys)

    def samples(positions: Floats, attributes: Mapping[str, Singles]) -> Samples:
        return Samples(positions, np.zeros((len(positions), 0), dtype=np.float32), attributes)

    return Signature(
        np.zeros(0),
        samples(points, interior_attributes(mesh, points, config.attributes)),
        samples(surface.positions, surface_attributes(mesh, surface.face, config.attributes)),
        mesh.area,
        mesh.volume,
        config,
        mesh.name,
        notes=mesh.notes,
        unit=mesh.unit,
        measures=numbers,
    )


def _spectrum(mesh: Mesh, config: SignatureConfig) -> tuple[Spectrum, tuple[str, ...]]:
    """Compute the eigenpairs; if the cotangent matrices fail, use the intrinsic-Delaunay ones and return a note."""
    # Loads torch, which plain numbers do without
    from igps.spectra import ConvergenceError, eigenpairs

    def solve(config: SignatureConfig) -> Spectrum:
        matrices = laplacian(mesh, config.backend)
        return eigenpairs(
            *matrices,
            config.n_kept,
            positions=mesh.vertices,
            tolerance=_MAX_RESIDUAL,
            seed=config.seed,
        )

    try:
        return solve(config), ()
    except (ConvergenceError, ValueError) as failure:  # ValueError: matrix entries of slivers
        if config.backend == "robust":
            raise
        try:
            spectrum = solve(replace(config, backend="robust"))
        except ImportError as import_error:
            raise ConvergenceError(
                f"{mesh.name}: {failure}. Remesh the body; or else: {import_error}"
            ) from failure
        except (ConvergenceError, ValueError) as second_failure:
            raise ConvergenceError(
                f"{mesh.name}: the eigenpairs fail with the cotangent matrices ({failure}) and with the "
                f"intrinsic-Delaunay ones ({second_failure}). The triangles are too ill-shaped: remesh."
            ) from second_failure
        note = f"intrinsic-Delaunay matrices were used: the cotangent ones failed ({failure})"
        logger.warning("%s: %s", mesh.name, note)
        return spectrum, (note,)


def _interior(
    mesh: Mesh, extend: Extension, eigenvalues: Floats, points: Floats, config: SignatureConfig
) -> Samples:
    """Return the samples at interior points (P, 3), by the extension of the eigenfunctions over √λ."""
    values = extend(points)
    values *= np.sqrt(eigenvalues)
    keys = ordering_keys(values, eigenvalues, mesh.area, nearest_spacing(points))
    order = np.argsort(keys, kind="stable")
    points = points[order]
    functions = np.asarray(values[order], dtype=np.float32)
    attributes = interior_attributes(mesh, points, config.attributes)
    return Samples(points, functions, attributes)


def _surface(
    mesh: Mesh, functions: Floats, eigenvalues: Floats, config: SignatureConfig
) -> Samples:
    tie_breakers = vertex_area_shares(mesh.faces, face_areas(mesh.vertices, mesh.faces))
    keys = ordering_keys(functions, eigenvalues, mesh.area, tie_breakers)
    points = surface_points(mesh, config.n_surface_samples, config.seed, keys)
    values = points.interpolate(functions).astype(np.float32)
    attributes = surface_attributes(mesh, points.face, config.attributes)
    return Samples(points.positions, values, attributes)
