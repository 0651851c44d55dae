"""Changes of a Signature: as a Dataset's `transform` at each reading, as its `pre_transform` once, before it is cached.

Each takes a seed. With one, a Signature is changed alike at every reading, by seed and name alone (before it is cached,
by its key in place of the name, which copies of a file share); without, by numbers that PyTorch's global generator
draws, which a DataLoader seeds anew in every worker.
"""

import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch

from igps.signature.signature import Samples, Signature


@dataclass(frozen=True, kw_only=True)
class Transform(ABC):
    """A change of a Signature; written down, and so named in a cache, by its class and parameters."""

    seed: int | None = None

    @property
    def cache_tag(self) -> str:
        """The transform in words; a ValueError without a seed, as no two Signatures would be alike."""
        if self.seed is None:
            raise ValueError(f"pre_transform: expected a seed, got {self!r}. What is kept must come out alike again.")
        return repr(self)

    def __call__(self, signature: Signature) -> Signature:
        """The changed Signature; the given one stays as it is."""
        seed = int(torch.randint(2**31, ())) if self.seed is None else self.seed
        return self._changed(signature, np.random.default_rng([seed, zlib.crc32(signature.name.encode())]))

    @abstractmethod
    def _changed(self, signature: Signature, generator: np.random.Generator) -> Signature: ...


class Compose:
    """Several changes, one after the other: callables from Signature to Signature."""

    def __init__(self, *transforms: Callable[[Signature], Signature]) -> None:
        self.transforms = transforms

    @property
    def cache_tag(self) -> str:
        """The tags of all changes."""
        return "; ".join(one.cache_tag for one in self.transforms)  # type: ignore[attr-defined]

    def __call__(self, signature: Signature) -> Signature:
        """The changed Signature; the given one stays as it is."""
        for one in self.transforms:
            signature = one(signature)
        return signature


@dataclass(frozen=True, kw_only=True)
class FewerSamples(Transform):
    """A random subset of the samples, in their order, at most so many interior and surface ones; None keeps all."""

    n_interior: int | None = None
    n_surface: int | None = None

    def _changed(self, signature: Signature, generator: np.random.Generator) -> Signature:
        def fewer(samples: Samples, n: int | None) -> Samples:
            if n is None or n >= len(samples):
                return samples
            kept = np.sort(generator.permutation(len(samples))[:n])
            attributes = {name: values[kept] for name, values in samples.attributes.items()}
            return Samples(samples.points[kept], samples.eigenfunctions[kept], attributes)

        interior, surface = fewer(signature.interior, self.n_interior), fewer(signature.surface, self.n_surface)
        return replace(signature, interior=interior, surface=surface)


@dataclass(frozen=True, kw_only=True)
class FewerEigenpairs(Transform):
    """A random subset of the eigenpairs, ascending. A descriptor that needs more of them refuses the Signature."""

    n_eigenpairs: int = 50

    def _changed(self, signature: Signature, generator: np.random.Generator) -> Signature:
        kept = np.sort(generator.permutation(len(signature.eigenvalues))[: self.n_eigenpairs])
        fewer = signature.map_samples(lambda one: replace(one, eigenfunctions=one.eigenfunctions[:, kept]))
        return replace(fewer, eigenvalues=signature.eigenvalues[kept])


@dataclass(frozen=True, kw_only=True)
class Noise(Transform):
    """Gaussian noise on positions and on eigenfunctions."""

    points: float = 0.0  # its standard deviation over √area
    eigenfunctions: float = 0.0  # its standard deviation times √area; an eigenfunction's mean square is 1/area

    def _changed(self, signature: Signature, generator: np.random.Generator) -> Signature:
        length = np.sqrt(signature.area)

        def noisy(samples: Samples) -> Samples:
            points, values = samples.points, samples.eigenfunctions
            if self.points:
                points = points + self.points * length * generator.standard_normal(points.shape)
            if self.eigenfunctions:
                noise = generator.standard_normal(values.shape, dtype=np.float32)
                values = values + np.float32(self.eigenfunctions / length) * noise
            return replace(samples, points=points, eigenfunctions=values)

        return signature.map_samples(noisy)


@dataclass(frozen=True, kw_only=True)
class Scale(Transform):
    """The Signature of the body scaled by a random factor between two, whose logarithm is uniform."""

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

        area, volume = signature.area * factor**2, signature.volume * factor**3
        whole = replace(signature, eigenvalues=signature.eigenvalues / factor**2, area=area, volume=volume)
        return whole.map_samples(scaled)


@dataclass(frozen=True, kw_only=True)
class FlipSigns(Transform):
    """Every eigenfunction times −1 or 1: what no description may depend on, and a network has to learn."""

    def _changed(self, signature: Signature, generator: np.random.Generator) -> Signature:
        signs = generator.choice(np.array([-1, 1], np.float32), len(signature.eigenvalues))
        return signature.map_samples(lambda one: replace(one, eigenfunctions=one.eigenfunctions * signs))
