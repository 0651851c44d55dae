"""Signatures of several bodies as padded tensors, and one body of them without the padding."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, overload

import numpy as np
import torch
from torch import Tensor

from igps._arrays import Floats, Singles
from igps.data.indices import Indices, resolve_indices, scalar_index
from igps.mesh.mesh import Mesh
from igps.signature.signature import Samples, Signature


@dataclass(frozen=True, eq=False)
class LabelledSignature:
    """An item of a `SignatureDataset`: a Signature, the number of its class (−1 if unknown), and its name."""

    signature: Signature
    label: int
    id: str


@dataclass(frozen=True, eq=False)
class SampleBatch:
    """Samples of N shapes, padded to the longest."""

    points: Tensor  # (N, P, 3) float32, length, measured from the centre of each shape's own samples
    eigenfunctions: Tensor  # (N, P, K) float32, 1/length; zero where padded
    mask: Tensor  # (N, P) true where a sample is real
    attributes: Mapping[str, Tensor]  # by name, each (N, P) or (N, P, C) float32; a direction has C = 3

    def map(self, function: Callable[[Tensor], Tensor]) -> SampleBatch:
        """The batch with a function applied to each of its tensors."""
        attributes = {name: function(values) for name, values in self.attributes.items()}
        return SampleBatch(function(self.points), function(self.eigenfunctions), function(self.mask), attributes)

    def to(self, device: torch.device | str | torch.dtype, non_blocking: bool = False) -> SampleBatch:
        """The same batch on another device, or with numbers of another type; see `torch.Tensor.to`."""
        if isinstance(device, torch.dtype):
            return self.map(lambda values: values.to(device) if values.is_floating_point() else values)
        return self.map(lambda values: values.to(device, non_blocking=non_blocking))

    def subset(self, n_samples: int, seed: int | None = None) -> SampleBatch:
        """At most `n_samples` samples of each shape.

        A seed takes them at equal steps along the order they come in, from a start that it draws. In a Signature that
        order is by what the body looks like, and so is the choice: it depends neither on its batch nor on how grid and
        mesh are numbered. Without one, the global generator of their device draws them at random.
        """
        n_shapes, longest = self.mask.shape
        n_kept = min(n_samples, longest)
        n_present = self.mask.sum(dim=1, keepdim=True)
        numbers = torch.arange(n_kept, dtype=torch.float64, device=self.mask.device)
        kept = numbers < n_present
        if seed is None:
            drawn = torch.rand(self.mask.shape, device=self.mask.device).masked_fill(~self.mask, -1)
            index = drawn.topk(n_kept).indices
        else:
            start = _START_OF_ZERO if seed == 0 else _start(seed)
            steps = (n_present.double() / n_samples).clamp(min=1) * (numbers + start)
            index = torch.searchsorted(self.mask.cumsum(dim=1), steps.long().clamp(max=n_present - 1) + 1)
        index = index.masked_fill(~kept, 0)

        rows = (index + longest * torch.arange(n_shapes, device=index.device)[:, None]).flatten()
        missing = None if not torch.compiler.is_compiling() and bool(kept.all()) else ~kept

        def take(values: Tensor) -> Tensor:
            taken = values.flatten(0, 1).index_select(0, rows).unflatten(0, (n_shapes, n_kept))
            return taken if missing is None else taken.masked_fill_(missing[(..., *[None] * (values.ndim - 2))], 0)

        attributes = {name: take(values) for name, values in self.attributes.items()}
        return SampleBatch(take(self.points), take(self.eigenfunctions), kept, attributes)


def _start(seed: int) -> float:
    """A number from 0 to 1 that follows from the seed."""
    generator = torch.Generator("cpu").manual_seed(seed)
    return torch.rand(1, generator=generator, dtype=torch.float64, device="cpu").item()


# Of the seed that all descriptors take: `torch.compile` cannot trace a generator.
_START_OF_ZERO = _start(0)


@dataclass(frozen=True, eq=False)
class Body:
    """One shape of a batch, without padding, as arrays."""

    eigenvalues: Floats  # (K,) ascending, 1/length²
    interior: Samples  # their points measured from their centre
    surface: Samples  # likewise
    area: float  # of the surface, length²
    volume: float  # of the body, length³
    id: str  # its name
    surface_mesh: Mesh | None  # its surface; None where the batch has no meshes

    @property
    def mesh(self) -> Mesh:
        """The surface, for a descriptor that says it needs it; a ValueError where the batch has no meshes."""
        if self.surface_mesh is None:
            raise ValueError(f"{self.id}: expected a batch with meshes, got one without. See SignatureDataset.batch.")
        return self.surface_mesh


@dataclass(frozen=True, eq=False)
class SignatureBatch:
    """N Signatures, padded; padding changes no description.

    Example:
        >>> import trimesh
        >>> from igps import SignatureConfig, collate, compute_signature
        >>> bodies = [trimesh.creation.icosphere(subdivisions=2), trimesh.creation.capsule(height=2.0, radius=0.5)]
        >>> batch = collate([compute_signature(body, SignatureConfig(n_eigenpairs=20)) for body in bodies])
        >>> len(batch), [body.area for body in batch.bodies()] == batch.area.tolist()
        (2, True)

    Args:
        eigenvalues: (N, K) float64, 1/length²; infinite where padded, so that every spectral weight is zero there.
        interior: interior samples.
        surface: surface samples.
        area: (N,) float64, length².
        volume: (N,) float64, length³.
        labels: (N,) int64, −1 where unknown.
        ids: N names.
        meshes: the N surfaces, for descriptors that need more than the Signatures; None if they were not asked for.
        units: the N units of length, None where one is not known; None if none is.
    """

    eigenvalues: Tensor
    interior: SampleBatch
    surface: SampleBatch
    area: Tensor
    volume: Tensor
    labels: Tensor
    ids: tuple[str, ...]
    meshes: tuple[Mesh, ...] | None = None
    units: tuple[str | None, ...] | None = None

    def __len__(self) -> int:
        return len(self.ids)

    # No __iter__: Lightning would infer the batch size from the bodies. Indexing by numbers iterates too.
    @overload
    def __getitem__(self, index: int) -> Body: ...
    @overload
    def __getitem__(self, index: Indices) -> SignatureBatch: ...
    def __getitem__(self, index: int | Indices) -> Body | SignatureBatch:
        """One shape as a `Body` by its number; some as a batch by a slice, numbers, or a mask."""
        index = scalar_index(index)
        if isinstance(index, int | np.integer):
            number = range(len(self))[index]
            return self[number : number + 1].to("cpu")._body(0)
        chosen = resolve_indices(index, len(self))
        rows: slice | Tensor = torch.tensor(chosen, dtype=torch.int64, device=self.labels.device)
        if isinstance(index, slice) and (index.step or 1) > 0:  # views; tensors take no slices backwards
            rows = index
        return replace(
            self.map(lambda values: values[rows]),
            ids=tuple(self.ids[i] for i in chosen),
            meshes=None if self.meshes is None else tuple(self.meshes[i] for i in chosen),
            units=None if self.units is None else tuple(self.units[i] for i in chosen),
        )

    @property
    def device(self) -> torch.device:
        """Where its tensors are."""
        return self.area.device

    def map(self, function: Callable[[Tensor], Tensor]) -> SignatureBatch:
        """The batch with a function applied to each of its tensors."""
        return replace(
            self,
            eigenvalues=function(self.eigenvalues),
            interior=self.interior.map(function),
            surface=self.surface.map(function),
            area=function(self.area),
            volume=function(self.volume),
            labels=function(self.labels),
        )

    def to(self, device: torch.device | str | torch.dtype, non_blocking: bool = False) -> SignatureBatch:
        """The same batch on another device, see `torch.Tensor.to`, where meshes stay; or samples of another type.

        Eigenvalues, area and volume stay in double precision.
        """
        if isinstance(device, torch.dtype):
            return replace(self, interior=self.interior.to(device), surface=self.surface.to(device))
        return self.map(lambda values: values.to(device, non_blocking=non_blocking))

    def pin_memory(self) -> SignatureBatch:
        """The same batch in pinned memory: what `DataLoader(pin_memory=True)` calls."""
        return self.map(Tensor.pin_memory)

    @staticmethod
    def concatenate(batches: Sequence[SignatureBatch]) -> SignatureBatch:
        """The shapes of several batches in one, padded to the longest.

        They are on one device, their samples carry the same attributes, and all have meshes, or none.
        """
        if not batches:
            raise ValueError("batches: expected at least one, got none.")
        meshes = [batch.meshes for batch in batches if batch.meshes is not None]
        if meshes and len(meshes) < len(batches):
            raise ValueError("batches: expected all with meshes or none, got some of each.")
        return SignatureBatch(
            eigenvalues=_joined([batch.eigenvalues for batch in batches], math.inf),
            interior=_joined_samples([batch.interior for batch in batches]),
            surface=_joined_samples([batch.surface for batch in batches]),
            area=torch.cat([batch.area for batch in batches]),
            volume=torch.cat([batch.volume for batch in batches]),
            labels=torch.cat([batch.labels for batch in batches]),
            ids=tuple(name for batch in batches for name in batch.ids),
            meshes=tuple(mesh for several in meshes for mesh in several) if meshes else None,
            units=tuple(unit for batch in batches for unit in batch.units or (None,) * len(batch)),
        )

    def bodies(self) -> Iterator[Body]:
        """The shapes one by one."""
        return map(self.to("cpu")._body, range(len(self)))

    def _body(self, i: int) -> Body:
        eigenvalues = self.eigenvalues[i][torch.isfinite(self.eigenvalues[i])].numpy()
        interior, surface = (_samples_of(one, i, len(eigenvalues)) for one in (self.interior, self.surface))
        mesh = None if self.meshes is None else self.meshes[i]
        return Body(eigenvalues, interior, surface, float(self.area[i]), float(self.volume[i]), self.ids[i], mesh)


def _refuse(batch: Any, name: str, value: Any) -> None:
    # Not the error of a frozen dataclass, which Lightning replaces by one that names neither batch nor remedy
    raise AttributeError(
        f"{name}: a batch is fixed. Make another by dataclasses.replace, or by batch.to(torch.float64). Of Lightning's "
        'precisions only "32-true", "16-mixed" and "bf16-mixed" leave batches alone, of Fabric\'s only "32-true": take '
        "one of these, in Fabric with torch.autocast around the module."
    )


for _kind in (SampleBatch, SignatureBatch):
    _kind.__setattr__ = _refuse  # type: ignore[method-assign]
# They hold tensors and names alone, so that torch.load(weights_only=True) may make them
torch.serialization.add_safe_globals([SampleBatch, SignatureBatch])


def _joined(parts: Sequence[Tensor], padding: float = 0) -> Tensor:
    """(N₁ + N₂ + …, ...), padded up to the largest size along each further dimension."""
    shape = [max(sizes) for sizes in zip(*(part.shape[1:] for part in parts), strict=True)]
    joined = parts[0].new_full((sum(map(len, parts)), *shape), padding)
    start = 0
    for part in parts:
        joined[(slice(start, start + len(part)), *map(slice, part.shape[1:]))] = part
        start += len(part)
    return joined


def attribute_names(samples: Sequence[Samples | SampleBatch], what: str) -> list[str]:
    """Those that all samples carry; a ValueError that names what they are of where they differ."""
    names, *others = (sorted(one.attributes) for one in samples)
    if differing := [one for one in others if one != names]:
        raise ValueError(f"{what}: all must carry the same sample attributes, got {names} and {differing[0]}.")
    return names


def _joined_samples(parts: Sequence[SampleBatch]) -> SampleBatch:
    names = attribute_names(parts, "batches")
    points, eigenfunctions, mask = (
        _joined([getattr(part, name) for part in parts]) for name in ("points", "eigenfunctions", "mask")
    )
    attributes = {name: _joined([part.attributes[name] for part in parts]) for name in names}
    return SampleBatch(points, eigenfunctions, mask, attributes)


def _samples_of(batch: SampleBatch, i: int, n_eigenpairs: int) -> Samples:
    real = batch.mask[i]

    def array(values: Tensor) -> Singles:
        return values[i, real].numpy()

    return Samples(
        array(batch.points).astype(np.float64),
        array(batch.eigenfunctions)[:, :n_eigenpairs],
        {name: array(values) for name, values in batch.attributes.items()},
    )
