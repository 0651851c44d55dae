"""Every parameter that a Signature depends on."""

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar, Self, get_args

from igps._parameters import check_at_least, check_one_of, check_share
from igps.signature.attributes import AttributeName
from igps.signature.laplacian import Backend

# The order of the samples, see `ordering_keys`, depends on about so many eigenpairs. With as many or more of one body
# the same samples come in the same order, to rounding.
_ORDERED_BY = 64


@dataclass(frozen=True)
class SignatureConfig:
    """Every parameter that a Signature depends on.

    The samples of a Signature and their first eigenfunctions do not depend on how many there are, if at least 64. So
    each is the beginning of those with more, see `larger` and `Signature.truncated`; but for that their meshes must be
    the same, and one with fewer vertices than `least_vertices` is subdivided.

    Example:
        >>> SignatureConfig(n_eigenpairs=50).min_samples, SignatureConfig.paper().min_samples
        (1000, 0)

    Args:
        n_eigenpairs: eigenpairs kept, without the constant one; None for as many as the descriptor requires (see
            `Requirements.apply_to`), 250 without a descriptor.
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
        least_vertices: meshes with fewer are subdivided when they are read, unless `mend` is "never"; None for two more
            than the eigenpairs, the fewest that these can be computed from.
    """

    # Raise it whenever the same mesh and parameters would give another Signature: it is part of every cache key.
    ALGORITHM_VERSION: ClassVar[int] = 5

    DEFAULT_EIGENPAIRS: ClassVar[int] = 250
    # As many as descriptors of the library ask for, so that caches may hold them.
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
        counts = {"resolution": self.resolution, "n_surface_samples": self.n_surface_samples}
        check_at_least(1, n_eigenpairs=self.n_eigenpairs, **counts)
        check_at_least(0, min_samples=self.min_samples, least_vertices=self.least_vertices, seed=self.seed)
        check_one_of(get_args(Backend), backend=self.backend)
        if self.max_vertices is not None and self.max_vertices <= self.n_kept + 1:
            raise ValueError(
                f"max_vertices: expected more than n_eigenpairs + 1 = {self.n_kept + 1}, got {self.max_vertices}."
            )
        check_share(accuracy=self.accuracy)
        names, known = tuple(self.attributes), get_args(AttributeName)  # JSON and YAML have lists
        object.__setattr__(self, "attributes", names)
        if not set(names) <= set(known) or len(set(names)) < len(names):
            raise ValueError(f"attributes: expected different ones of {', '.join(known)}, got {', '.join(names)}.")

    @classmethod
    def paper(cls) -> Self:
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

    def resolved(self) -> Self:
        """The same with a number of eigenpairs."""
        return replace(self, n_eigenpairs=self.n_kept)

    def with_eigenpairs(self, n_eigenpairs: int) -> Self:
        """The same where only the first so many eigenpairs are needed, unless a number of them is given already.

        Meshes are subdivided as for the default number, so that this is the beginning of that Signature.
        """
        if self.n_eigenpairs is not None:
            return self
        n_computed = max(n_eigenpairs, _ORDERED_BY)
        if n_computed >= self.DEFAULT_EIGENPAIRS:
            return replace(self, n_eigenpairs=n_computed)
        return replace(self, n_eigenpairs=n_computed, least_vertices=self.n_vertices_read)

    def larger(self) -> Iterator[Self]:
        """Configurations whose Signatures begin with this one's, the smallest first, among those that caches may hold.

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
