"""Short vectors of descriptions, for engines that find nearest neighbours by Euclidean distances alone."""

from dataclasses import dataclass
from typing import Any, Literal, Self

import numpy as np

from igps._arrays import Singles

SearchDistance = Literal["cosine", "chi_square"]
"""A distance of descriptions that Euclidean distances of short vectors follow."""

MOST_NUMBERS = 256
"""The largest width of a short vector."""

# The squared Euclidean distance of the features is then a fifth to a third below 2 χ², in nearly the same order.
_SAMPLE_STEPS = 2
_ROWS_AT_ONCE = 512


@dataclass(frozen=True, eq=False)
class VectorMap:
    """Descriptions (N, F) to vectors (N, D ≤ 256) whose Euclidean distances order them nearly as their own do.

    Unit vectors, compared by the cosine, are such vectors if they are short, and else are reduced to their principal
    components. Histograms, compared by χ², become their features first, whose squared Euclidean distance is nearly in
    proportion to χ² (Vedaldi and Zisserman 2012).
    """

    searched_by: SearchDistance  # the distance of the descriptions
    mean: Singles | None = None  # (F,) of the descriptions, or of their features; None where they are taken as they are
    components: Singles | None = None  # (D, F) orthonormal directions

    @classmethod
    def fit(cls, descriptions: Singles, searched_by: SearchDistance, seed: int = 0) -> Self:
        """The map of descriptions (N, F) such as these; a few thousand are enough."""
        if searched_by == "cosine" and descriptions.shape[1] <= MOST_NUMBERS:
            return cls(searched_by)
        from sklearn.decomposition import PCA

        features = _features(descriptions, searched_by)
        n_kept = min(MOST_NUMBERS, *features.shape)
        found = PCA(n_kept, svd_solver="randomized" if n_kept < min(features.shape) else "full", random_state=seed)
        found.fit(features)
        return cls(searched_by, found.mean_.astype(np.float32), found.components_.astype(np.float32))

    def __call__(self, descriptions: Singles) -> Singles:
        """(N, F) descriptions to (N, D) vectors."""
        if self.components is None or self.mean is None:
            return np.ascontiguousarray(descriptions, dtype=np.float32)
        parts = [
            (_features(descriptions[i : i + _ROWS_AT_ONCE], self.searched_by) - self.mean) @ self.components.T
            for i in range(0, len(descriptions), _ROWS_AT_ONCE)
        ]
        return np.concatenate([*parts, np.zeros((0, len(self.components)), dtype=np.float32)])

    def arrays(self) -> dict[str, Any]:
        """Its arrays by name, for `numpy.savez`."""
        return {name: value for name, value in vars(self).items() if value is not None}

    @classmethod
    def of_arrays(cls, arrays: Any) -> Self:
        """The map of such arrays."""
        names = [name for name in ("mean", "components") if name in arrays]
        return cls(str(arrays["searched_by"]), **{name: arrays[name] for name in names})  # type: ignore[arg-type]


def _features(descriptions: Singles, searched_by: SearchDistance) -> Singles:
    if searched_by == "cosine":
        return descriptions
    from sklearn.kernel_approximation import AdditiveChi2Sampler

    features: Singles = AdditiveChi2Sampler(sample_steps=_SAMPLE_STEPS).fit_transform(descriptions)
    return features
