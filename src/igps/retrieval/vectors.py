"""Short vectors of descriptions, for search engines that support Euclidean distances alone."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, Self

import numpy as np

from igps._arrays import Singles

SearchDistance = Literal["cosine", "chi_square"]
"""Distances of descriptions that Euclidean distances of short vectors approximate."""

MAX_SHORT_WIDTH = 256
"""The largest width of a short vector."""

# With two steps, squared Euclidean distances of features are a fifth to a third below 2 χ², in nearly the same order.
_SAMPLE_STEPS = 2
_BLOCK_ROWS = 512


@dataclass(frozen=True, eq=False)
class VectorMap:
    """A map of descriptions (N, F) to vectors (N, D ≤ 256) whose Euclidean distances give nearly the same ranking.

    Unit vectors, compared by the cosine, are kept if they are short, and else reduced to their principal components.
    Histograms, compared by χ², are first mapped to features whose squared Euclidean distance is nearly proportional to
    χ² (Vedaldi and Zisserman 2012), and then reduced.
    """

    searched_by: SearchDistance  # the distance of the descriptions
    # (F,) factors of the descriptions, see `Descriptor.search_weights`
    weights: Singles | None = None
    # (F,) of the descriptions or their features; None if descriptions stay as they are
    mean: Singles | None = None
    components: Singles | None = None  # (D, F) principal directions, orthonormal

    @classmethod
    def fit(
        cls,
        descriptions: Singles,
        searched_by: SearchDistance,
        weights: Sequence[float] | None = None,
        seed: int = 0,
    ) -> Self:
        """Fit a map to example descriptions (N, F); a few thousand are enough."""
        factors = None if weights is None else np.asarray(weights, np.float32)
        plain = cls(searched_by, factors)
        if searched_by == "cosine" and descriptions.shape[1] <= MAX_SHORT_WIDTH:
            return plain
        from sklearn.decomposition import PCA

        features = plain._features(descriptions)
        n_components = min(MAX_SHORT_WIDTH, *features.shape)
        solver = "randomized" if n_components < min(features.shape) else "full"
        pca = PCA(n_components, svd_solver=solver, random_state=seed).fit(features)
        mean = pca.mean_.astype(np.float32)
        return cls(searched_by, factors, mean, pca.components_.astype(np.float32))

    def __call__(self, descriptions: Singles) -> Singles:
        """(N, F) descriptions to (N, D) vectors."""
        if self.components is None or self.mean is None:
            return np.ascontiguousarray(self._features(descriptions), dtype=np.float32)
        vectors = np.empty((len(descriptions), len(self.components)), dtype=np.float32)
        for first in range(0, len(descriptions), _BLOCK_ROWS):
            block = slice(first, first + _BLOCK_ROWS)
            centred = self._features(descriptions[block]) - self.mean
            vectors[block] = centred @ self.components.T
        return vectors

    def arrays(self) -> dict[str, Any]:
        """Return the fields that are not None by name, for `numpy.savez`."""
        return {name: value for name, value in vars(self).items() if value is not None}

    @classmethod
    def of_arrays(cls, arrays: Any) -> Self:
        """Restore a map from its `arrays`."""
        names = ("weights", "mean", "components")
        fields = {name: arrays[name] for name in names if name in arrays}
        return cls(str(arrays["searched_by"]), **fields)  # type: ignore[arg-type]

    def _features(self, descriptions: Singles) -> Singles:
        weighted = descriptions if self.weights is None else descriptions * self.weights
        if self.searched_by == "cosine":
            return weighted
        from sklearn.kernel_approximation import AdditiveChi2Sampler

        return AdditiveChi2Sampler(sample_steps=_SAMPLE_STEPS).fit_transform(weighted)
