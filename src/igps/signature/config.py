"""Configuration of a Signature."""

from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar, Literal, Self, get_args

from igps._parameters import check_at_least, check_fraction, check_one_of

AttributeName = Literal["depth", "electrostatic_potential", "surface_direction"]
Backend = Literal["cotangent", "robust"]

# Number of eigenpairs on which the order of the samples depends, see `ordering_keys`. All configurations with at least
# as many give the samples of a body the same order, up to rounding.
_N_ORDERING_EIGENPAIRS = 64


@dataclass(frozen=True)
class SignatureConfig:
    """Every parameter that a Signature depends on.

    With 64 eigenpairs or more, the samples of a Signature and their first eigenfunctions do not depend on the number of
    eigenpairs. This requires the same mesh: a mesh with fewer vertices than `least_vertices` is subdivided.

    Example:
        >>> SignatureConfig(n_eigenpairs=50).min_samples, SignatureConfig.paper().min_samples
        (1000, 0)

    Args:
        n_eigenpairs: number of eigenpairs, without the constant one; None for the number that the descriptor requires
            (see `Requirements.apply_to`), or 250 without a descriptor; 0 for samples and plain numbers alone.
        resolution: voxels along the longest side of the bounding box.
        min_samples: the grid is refined until at least this many voxels lie inside; 0 keeps `resolution`.
        n_surface_samples: number of area-weighted random samples of the surface.
        backend: "cotangent" or "robust", see `laplacian`. If the eigenpairs of the cotangent matrices do not reach the
            tolerance, the robust matrices are used, and a note of the Signature says so.
        max_vertices: meshes with more vertices are simplified first; None keeps them.
        accuracy: largest relative error of 99 % of the interior distances; mean value coordinates are approximated
            within this bound to save time. None evaluates them exactly.
        attributes: attributes of the samples: "depth" and "electrostatic_potential" (interior only; of a uniform charge
            on the surface, so of the form alone) and "surface_direction", see `interior_attributes`.
        seed: seed of the surface samples and of the eigensolver's start vectors.
        measures: whether the plain numbers of `igps.measures` are computed, too; samples do not depend on them.
        least_vertices: meshes with fewer vertices are subdivided when they are read, unless `mend` is "never"; None for
            two more than the number of eigenpairs, the fewest from which these can be computed.
    """

    # Part of every cache key: raise it whenever the same mesh and parameters would give another Signature.
    ALGORITHM_VERSION: ClassVar[int] = 5

    DEFAULT_EIGENPAIRS: ClassVar[int] = 250

    n_eigenpairs: int | None = None
    resolution: int = 32
    min_samples: int = 1000
    n_surface_samples: int = 2000
    backend: Backend = "cotangent"
    max_vertices: int | None = None
    accuracy: float | None = 1e-3
    attributes: tuple[AttributeName, ...] = ()
    seed: int = 0
    measures: bool = False
    least_vertices: int | None = None

    def __post_init__(self) -> None:
        check_at_least(1, resolution=self.resolution, n_surface_samples=self.n_surface_samples)
        check_at_least(0, n_eigenpairs=self.n_eigenpairs, min_samples=self.min_samples)
        check_at_least(0, least_vertices=self.least_vertices, seed=self.seed)
        check_one_of(get_args(Backend), backend=self.backend)
        if self.max_vertices is not None and self.max_vertices <= self.n_kept + 1:
            raise ValueError(
                f"max_vertices: expected more than n_eigenpairs + 1 = {self.n_kept + 1}, got {self.max_vertices}."
            )
        check_fraction(accuracy=self.accuracy)
        names = tuple(self.attributes)
        object.__setattr__(self, "attributes", names)  # JSON and YAML have lists
        known = get_args(AttributeName)
        is_known = set(names) <= set(known)
        is_distinct = len(set(names)) == len(names)
        if not (is_known and is_distinct):
            raise ValueError(
                f"attributes: expected distinct names among {', '.join(known)}, "
                f"got {', '.join(names)}."
            )

    @classmethod
    def paper(cls) -> Self:
        """Return the configuration of Rustamov 2010: 250 eigenpairs and a 32-voxel grid that is never refined."""
        return cls(n_eigenpairs=250, min_samples=0)

    @property
    def n_kept(self) -> int:
        """`n_eigenpairs`, or its default if None."""
        return self.DEFAULT_EIGENPAIRS if self.n_eigenpairs is None else self.n_eigenpairs

    @property
    def has_usual_samples(self) -> bool:
        """Whether the samples inside a body are those of the default configuration."""
        usual = SignatureConfig()
        grid = (self.resolution, self.min_samples, self.max_vertices)
        return grid == (usual.resolution, usual.min_samples, usual.max_vertices)

    @property
    def n_vertices_read(self) -> int:
        """`least_vertices`, or the fewest that the eigenpairs require if None."""
        return self.n_kept + 2 if self.least_vertices is None else self.least_vertices

    def resolved(self) -> Self:
        """Return the configuration with `n_eigenpairs` as a number."""
        return replace(self, n_eigenpairs=self.n_kept)

    def with_eigenpairs(self, n_eigenpairs: int) -> Self:
        """Return a configuration with at least `n_eigenpairs`, or this one if its own number is set.

        It has at least 64, and meshes are subdivided as for the default number, so that its samples are those of the
        default one.
        """
        if self.n_eigenpairs is not None:
            return self
        n_computed = max(n_eigenpairs, _N_ORDERING_EIGENPAIRS)
        if n_computed >= self.DEFAULT_EIGENPAIRS:
            return replace(self, n_eigenpairs=n_computed)
        return replace(self, n_eigenpairs=n_computed, least_vertices=self.n_vertices_read)

    def as_dict(self) -> dict[str, Any]:
        """Return what samples and eigenpairs depend on: the parameters and the algorithm's version, by name.

        `measures` is left out, and so is `least_vertices` if it has its default.
        """
        parameters = {
            **asdict(self),
            "n_eigenpairs": self.n_kept,
            "algorithm_version": self.ALGORITHM_VERSION,
        }
        del parameters["measures"]
        if self.n_vertices_read == self.n_kept + 2:
            del parameters["least_vertices"]
        return parameters
