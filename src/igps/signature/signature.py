"""From one mesh to its Signature: eigenfunctions sampled in the interior and on the surface."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, ClassVar, get_args

import numpy as np
from numpy.typing import NDArray

from igps._threads import one_thread
from igps.mesh.mesh import Mesh, MeshError
from igps.mesh.simplification import simplify
from igps.mesh.surface import face_areas
from igps.signature.attributes import AttributeName, check_attributes, interior_attributes, surface_attributes
from igps.signature.laplacian import Backend, laplacian
from igps.signature.mean_value import Extension
from igps.signature.ordering import crowding, places, shares_around
from igps.signature.sampling import surface_points
from igps.signature.voxels import interior_samples
from igps.spectra import ConvergenceError, Spectrum, eigenpairs

logger = logging.getLogger(__name__)

# Largest relative residual of an eigenpair. It is mostly far smaller; on meshes with very thin triangles rounding does
# not allow much less, and the histograms cannot tell.
_RESIDUAL = 1e-6

# The order of the samples, see `places`, depends on about so many eigenpairs. With as many or more of one body the same
# samples come in the same order, to rounding.
_ORDERED_BY = 64


@dataclass(frozen=True)
class SignatureConfig:
    """Every parameter that a Signature depends on.

    The samples of a Signature and their first eigenfunctions do not depend on how many there are, if at least 64. So
    each is the beginning of those with more, see `larger` and `Signature.beginning`; but for that their meshes must be
    the same, and one with fewer vertices than `least_vertices` is subdivided.

    Example:
        >>> SignatureConfig(n_eigenpairs=50).min_samples, SignatureConfig.paper().min_samples
        (1000, 0)

    Args:
        n_eigenpairs: eigenpairs kept, without the constant one; None for as many as the descriptor needs that the
            Signature is for (see `Requirements.completed`), 250 where there is none.
        resolution: voxels along the longest side of the bounding box.
        min_samples: the grid is refined until at least so many voxels lie inside; 0 keeps `resolution`.
        n_surface_samples: area-weighted random samples of the surface.
        backend: "cotangent" or "robust", see `laplacian`. Where the cotangent matrices have no eigenpairs to the
            tolerance, the others are used, and the Signature's notes say so.
        max_vertices: simplify larger meshes first; None keeps them.
        accuracy: relative error that 99 % of the interior distances may have, which speeds up the mean value
            coordinates; None evaluates them exactly.
        attributes: of the samples: "depth" and "electrostatic_potential" of the interior ones, "surface_direction" of
            all, see `interior_attributes` and `surface_attributes`.
        seed: of the surface samples and of the eigensolver's start.
        least_vertices: meshes with fewer are subdivided when they are read, unless they are mended never; None for the
            two more than the eigenpairs without which these cannot be computed.
    """

    # Raise it whenever the same mesh and parameters would give another Signature: it is part of every cache key.
    ALGORITHM_VERSION: ClassVar[int] = 4

    DEFAULT_EIGENPAIRS: ClassVar[int] = 250
    # What the library's descriptors ask for: known to be in caches.
    SIZES: ClassVar[tuple[int, ...]] = (64, 100, 250)

    n_eigenpairs: int | None = None
    resolution: int = 32
    min_samples: int = 1000
    n_surface_samples: int = 2000
    backend: Backend = "cotangent"
    max_vertices: int | None = None
    accuracy: float | None = 1e-3
    attributes: tuple[AttributeName, ...] = ()
    seed: int = 0
    least_vertices: int | None = None

    def __post_init__(self) -> None:
        smallest = {"n_eigenpairs": 1, "resolution": 1, "min_samples": 0, "n_surface_samples": 1, "least_vertices": 0}
        for name, least in smallest.items():
            value = getattr(self, name)
            if value is not None and value < least:
                raise ValueError(f"{name}: expected at least {least}, got {value}.")
        if self.backend not in ("cotangent", "robust"):
            raise ValueError(f"backend: expected 'cotangent' or 'robust', got {self.backend!r}.")
        if self.max_vertices is not None and self.max_vertices <= self.n_kept + 1:
            raise ValueError(
                f"max_vertices: expected more than n_eigenpairs + 1 = {self.n_kept + 1}, got {self.max_vertices}."
            )
        if self.accuracy is not None and not 0 < self.accuracy < 1:
            raise ValueError(f"accuracy: expected None or a number between 0 and 1, got {self.accuracy}.")
        check_attributes(self.attributes)

    @classmethod
    def paper(cls) -> SignatureConfig:
        """Rustamov 2010: 250 eigenpairs and a 32-voxel grid that is never refined."""
        return cls(n_eigenpairs=250, min_samples=0)

    @property
    def n_kept(self) -> int:
        """`n_eigenpairs`, or how many there are where it is None."""
        return self.DEFAULT_EIGENPAIRS if self.n_eigenpairs is None else self.n_eigenpairs

    @property
    def n_vertices_read(self) -> int:
        """`least_vertices`, or what the eigenpairs need where it is None."""
        return self.n_kept + 2 if self.least_vertices is None else self.least_vertices

    def resolved(self) -> SignatureConfig:
        """The same with a number of eigenpairs."""
        return replace(self, n_eigenpairs=self.n_kept)

    def needing(self, n_eigenpairs: int) -> SignatureConfig:
        """The same where only the first so many eigenpairs are needed, unless a number of them is given already.

        Meshes are subdivided as for the default number, so that this is the beginning of that Signature.
        """
        if self.n_eigenpairs is not None:
            return self
        n_computed = max(n_eigenpairs, _ORDERED_BY)
        if n_computed >= self.DEFAULT_EIGENPAIRS:
            return replace(self, n_eigenpairs=n_computed)
        return replace(self, n_eigenpairs=n_computed, least_vertices=self.n_vertices_read)

    def larger(self) -> Iterator[SignatureConfig]:
        """Those whose Signature of a body begins with this one's, smallest first, as far as a cache may well have them.

        For a mesh that is subdivided that holds only of those with as many `n_vertices_read`.
        """
        everything: tuple[AttributeName, ...] = get_args(AttributeName)
        sizes, n_vertices = [self.n_kept], self.n_vertices_read
        if self.n_kept >= _ORDERED_BY:
            most = math.inf if self.max_vertices is None else self.max_vertices - 2
            sizes += [size for size in self.SIZES if self.n_kept < size <= most]
            n_vertices = max(n_vertices, self.DEFAULT_EIGENPAIRS + 2)
        for n_eigenpairs in sizes:
            for attributes in dict.fromkeys((self.attributes, everything)):
                one = replace(self, n_eigenpairs=n_eigenpairs, attributes=attributes, least_vertices=n_vertices)
                if one.as_dict() != self.as_dict():
                    yield one

    def as_dict(self) -> dict[str, Any]:
        """The parameters by name and the algorithm's version; `least_vertices` only where the others do not tell."""
        found = {**asdict(self), "n_eigenpairs": self.n_kept, "algorithm_version": self.ALGORITHM_VERSION}
        if self.n_vertices_read == self.n_kept + 2:
            del found["least_vertices"]
        return found


@dataclass(frozen=True, eq=False)
class Samples:
    """Points that carry the eigenfunctions.

    Args:
        points: (P, 3) float64, length.
        eigenfunctions: (P, K) float32, 1/length, not scaled by any power of the eigenvalues.
        attributes: named scalars of the points, each (P,) float32, and directions, each (P, 3) float32.
    """

    points: NDArray[np.float64]
    eigenfunctions: NDArray[np.float32]
    attributes: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, eq=False)
class Signature:
    """What the descriptors need to know of one mesh.

    The eigenfunctions are kept unscaled, so that every spectral embedding can be chosen without computing them again.

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
        interior: P voxel centres inside the body, eigenfunctions extended by mean value coordinates.
        surface: area-weighted random points of the surface, eigenfunctions interpolated linearly. Both in an order that
            depends on the body's form alone, see `places`.
        area: of the surface, length².
        volume: of the body, length³.
        config: the parameters that made it.
        name: of the mesh.
        notes: what was done to the mesh before, and to the computation, in words.
        residual: the largest of the eigenpairs, relative to the eigenvalue; NaN where it is not known.
    """

    eigenvalues: NDArray[np.float64]
    interior: Samples
    surface: Samples
    area: float
    volume: float
    config: SignatureConfig
    name: str = "mesh"
    notes: tuple[str, ...] = ()
    residual: float = math.nan

    @property
    def barycentroid(self) -> NDArray[np.float64]:
        """(3,) interior sample of least potential Σ φₖ²/λₖ, a centre that hardly moves with pose (Rustamov 2010)."""
        potential = np.square(self.interior.eigenfunctions, dtype=np.float64) @ (1 / self.eigenvalues)
        return self.interior.points[int(np.argmin(potential))]

    def beginning(self, config: SignatureConfig) -> Signature:
        """The Signature of a configuration of which this one's is one of the larger, see `SignatureConfig.larger`."""

        def cut(samples: Samples) -> Samples:
            kept: dict[str, NDArray[np.float32]] = {
                name: values for name, values in samples.attributes.items() if name in config.attributes
            }
            return replace(
                samples,
                eigenfunctions=np.ascontiguousarray(samples.eigenfunctions[:, : config.n_kept]),
                attributes=kept,
            )

        return replace(
            self,
            eigenvalues=self.eigenvalues[: config.n_kept].copy(),
            interior=cut(self.interior),
            surface=cut(self.surface),
            config=config,
        )


@one_thread()
def compute_signature(mesh: Mesh | trimesh.Trimesh, config: SignatureConfig | None = None) -> Signature:
    """Sample the eigenfunctions of a mesh in its interior and on its surface (Rustamov 2010, section 3).

    Example:
        The first eigenvalues of the unit sphere are l (l + 1), each 2 l + 1 times.

        >>> import trimesh
        >>> ball = trimesh.creation.icosphere(subdivisions=3)
        >>> signature = compute_signature(ball, SignatureConfig(n_eigenpairs=8))
        >>> signature.eigenvalues.round(1).tolist()
        [2.0, 2.0, 2.0, 6.0, 6.0, 6.0, 6.0, 6.0]

    Args:
        mesh: the body, or what `Mesh.of` makes one of.
        config: `SignatureConfig()` if None.

    Raises:
        TypeError: the body is neither.
        MeshError: too few vertices for the eigenpairs asked, or no interior sample.
        ConvergenceError: the eigensolver failed.
    """
    config = (config or SignatureConfig()).resolved()
    mesh = Mesh.of(mesh).numbered_by_faces()  # to rounding, results depend on the numbers
    if config.max_vertices is not None:
        mesh = simplify(mesh, config.max_vertices)
    if len(mesh.vertices) < config.n_kept + 2:
        raise MeshError(
            f"{mesh.name}: {len(mesh.vertices)} vertices are too few for {config.n_kept} eigenpairs; at least "
            f"{config.n_kept + 2} are needed. Subdivide the mesh or lower n_eigenpairs."
        )
    points = interior_samples(mesh, config.resolution, config.min_samples)
    spectrum, notes = _spectrum(mesh, config)
    surface = _surface(mesh, spectrum, config)
    # The accuracy is that of interior distances, which are those between rows of eigenfunctions so weighted.
    extension = Extension(
        mesh.vertices,
        mesh.faces,
        spectrum.eigenfunctions,
        divisors=np.sqrt(spectrum.eigenvalues),
        accuracy=config.accuracy,
    )
    eigenvalues, residual = spectrum.eigenvalues, spectrum.residual
    del spectrum  # of a large mesh the eigenfunctions fill more memory than all else
    interior = _interior(mesh, extension, eigenvalues, points, config)
    for where, samples in (("interior", interior), ("surface", surface)):
        if not np.isfinite(samples.eigenfunctions).all():
            raise MeshError(
                f"{mesh.name}: the eigenfunctions are not finite at some {where} samples. The triangles are too "
                "ill-shaped: pass backend='robust', or remesh."
            )
    return Signature(
        eigenvalues=eigenvalues,
        interior=interior,
        surface=surface,
        area=mesh.area,
        volume=mesh.volume,
        config=config,
        name=mesh.name,
        notes=(*mesh.notes, *notes),
        residual=residual,
    )


def _spectrum(mesh: Mesh, config: SignatureConfig) -> tuple[Spectrum, tuple[str, ...]]:
    """The eigenpairs, of the intrinsic-Delaunay matrices where the cotangent ones fail, and a note if they were."""

    def solve(config: SignatureConfig) -> Spectrum:
        stiffness, mass = laplacian(mesh, config.backend)
        return eigenpairs(
            stiffness, mass, config.n_kept, positions=mesh.vertices, tolerance=_RESIDUAL, seed=config.seed
        )

    try:
        return solve(config), ()
    except (ConvergenceError, ValueError) as failure:  # a ValueError: slivers make entries that no solver can use
        if config.backend == "robust":
            raise
        try:
            spectrum = solve(replace(config, backend="robust"))
        except ImportError as missing:
            raise ConvergenceError(f"{mesh.name}: {failure}. Remesh the body; or else: {missing}") from failure
        except (ConvergenceError, ValueError) as second:
            raise ConvergenceError(
                f"{mesh.name}: the eigenpairs fail with the cotangent matrices ({failure}) and with the "
                f"intrinsic-Delaunay ones ({second}). The triangles are too ill-shaped: remesh."
            ) from second
        note = f"intrinsic-Delaunay matrices were used: the cotangent ones failed ({failure})"
        logger.warning("%s: %s", mesh.name, note)
        return spectrum, (note,)


def _interior(
    mesh: Mesh,
    extension: Extension,
    eigenvalues: NDArray[np.float64],
    points: NDArray[np.float64],
    config: SignatureConfig,
) -> Samples:
    """Those at the points, by the extension of eigenfunctions over the roots of their eigenvalues."""
    values = extension(points)
    values *= np.sqrt(eigenvalues)
    order = np.argsort(places(values, eigenvalues, mesh.area, crowding(points)), kind="stable")
    points, values = points[order], values[order]
    return Samples(points, np.asarray(values, dtype=np.float32), interior_attributes(mesh, points, config.attributes))


def _surface(mesh: Mesh, spectrum: Spectrum, config: SignatureConfig) -> Samples:
    marks = shares_around(mesh.faces, face_areas(mesh.vertices, mesh.faces))
    order = places(spectrum.eigenfunctions, spectrum.eigenvalues, mesh.area, marks)
    points = surface_points(mesh, config.n_surface_samples, config.seed, order)
    values = points.interpolate(spectrum.eigenfunctions).astype(np.float32)
    return Samples(points.positions, values, surface_attributes(mesh, points.face, config.attributes))
