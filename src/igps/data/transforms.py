"""A random subset of samples, for the `transform` of a Dataset (at each access) or its `pre_transform` (cached)."""

import zlib
from dataclasses import dataclass, replace

import numpy as np
import torch

from igps.signature.signature import Samples, Signature


@dataclass(frozen=True, kw_only=True)
class FewerSamples:
    """Random subset of at most `n_interior` and `n_surface` samples in their order; None keeps all.

    With a seed, the subset depends only on the seed and the name of the Signature, so it is the same at every access. A
    `pre_transform` uses the cache key instead of the name, which copies of a file share. Without a seed, it depends on
    PyTorch's global generator, which a DataLoader seeds differently in every worker.
    """

    n_interior: int | None = None
    n_surface: int | None = None
    seed: int | None = None

    @property
    def cache_tag(self) -> str:
        """Class and parameters as text; raises a ValueError without a seed."""
        if self.seed is None:
            raise ValueError(
                f"pre_transform: expected a seed, got {self!r}. Cached results must be reproducible."
            )
        return repr(self)

    def __call__(self, signature: Signature) -> Signature:
        """Return a Signature with fewer samples, without changing the argument."""
        seed = int(torch.randint(2**31, ())) if self.seed is None else self.seed
        generator = np.random.default_rng([seed, zlib.crc32(signature.name.encode())])

        def fewer(samples: Samples, n: int | None) -> Samples:
            if n is None or n >= len(samples):
                return samples
            chosen = np.sort(generator.permutation(len(samples))[:n])
            attributes = {name: values[chosen] for name, values in samples.attributes.items()}
            return Samples(samples.points[chosen], samples.eigenfunctions[chosen], attributes)

        interior = fewer(signature.interior, self.n_interior)
        surface = fewer(signature.surface, self.n_surface)
        return replace(signature, interior=interior, surface=surface)
