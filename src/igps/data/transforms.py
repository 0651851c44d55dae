"""Transforms of Signatures, for the `transform` of a Dataset (at each access) or its `pre_transform` (before caching).

With a seed, the random numbers of a transform depend only on the seed and the name of the Signature, so they are the
same at every access. A `pre_transform` uses the cache key instead of the name, which copies of a file share. Without a
seed, they depend on PyTorch's global generator, which a DataLoader seeds differently in every worker.
"""

import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch

from igps.signature.measures import POWERS
from igps.signature.signature import Samples, Signature


@dataclass(frozen=True, kw_only=True)
class Transform(ABC):
    """Base class of transforms. Class and parameters identify a transform in cache keys."""

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
        """Return the transformed Signature, without changing the argument."""
        seed = int(torch.randint(2**31, ())) if self.seed is None else self.seed
        return self._changed(
            signature, np.random.default_rng([seed, zlib.crc32(signature.name.encode())])
        )

    @abstractmethod
    def _changed(self, signature: Signature, generator: np.random.Generator) -> Signature: ...


class Compose:
    """Composition of several transforms, which are callables from Signature to Signature."""

    def __init__(self, *transforms: Callable[[Signature], Signature]) -> None:
        self.transforms = transforms

    @property
    def cache_tag(self) -> str:
        """Tags of all transforms."""
        return "; ".join(transform.cache_tag for transform in self.transforms)  # type: ignore[attr-defined]

    def __call__(self, signature: Signature) -> Signature:
        for transform in self.transforms:
            signature = transform(signature)
        return signature


@dataclass(frozen=True, kw_only=True)
class FewerSamples(Transform):
    """Random subset of at most `n_interior` and `n_surface` samples in their order; None keeps all."""

    n_interior: int | None = None
    n_surface: int | None = None

    def _changed(self, signature: Signature, generator: np.random.Generator) -> Signature:
        def fewer(samples: Samples, n: int | None) -> Samples:
            if n is None or n >= len(samples):
                return samples
            chosen = np.sort(generator.permutation(len(samples))[:n])
            attributes = {name: values[chosen] for name, values in samples.attributes.items()}
            return Samples(samples.points[chosen], samples.eigenfunctions[chosen], attributes)

        interior = fewer(signature.interior, self.n_interior)
        surface = fewer(signature.surface, self.n_surface)
        return replace(signature, interior=interior, surface=surface)


@dataclass(frozen=True, kw_only=True)
class Scale(Transform):
    """Scale of the body by a random factor between `smallest` and `largest`, with a uniform logarithm."""

    smallest: float = 0.8
    largest: float = 1.25

    def __post_init__(self) -> None:
        if not 0 < self.smallest <= self.largest:
            raise ValueError(f"smallest, largest: expected 0 < smallest ≤ largest, got {self}.")

    def _changed(self, signature: Signature, generator: np.random.Generator) -> Signature:
        factor = float(np.exp(generator.uniform(np.log(self.smallest), np.log(self.largest))))

        def scaled(samples: Samples) -> Samples:
            values = samples.eigenfunctions / np.float32(factor)
            return replace(samples, points=samples.points * factor, eigenfunctions=values)

        area = signature.area * factor**2
        volume = signature.volume * factor**3
        rescaled = replace(
            signature,
            eigenvalues=signature.eigenvalues / factor**2,
            area=area,
            volume=volume,
            measures={
                name: value * factor ** POWERS[name] for name, value in signature.measures.items()
            },
        )
        return rescaled.map_samples(scaled)
