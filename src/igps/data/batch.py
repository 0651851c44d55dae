"""Batches of Signatures as padded tensors, and single bodies without padding."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar, overload

import numpy as np
import torch
from torch import Tensor
from torch.utils._pytree import KeyEntry, MappingKey, register_pytree_node, tree_map_only

from igps._arrays import Floats, Singles
from igps._tensors import with_axes_of
from igps.data.indices import Indices, resolve_indices, scalar_index
from igps.mesh.mesh import Mesh
from igps.signature.measures import POWERS
from igps.signature.signature import SAMPLE_KINDS, SampleKind, Samples, Signature


@dataclass(frozen=True, eq=False)
class LabelledSignature:
    """An item of a `SignatureDataset`: a Signature, the index of its class (−1 if unknown), and its name."""

    signature: Signature
    label: int
    id: str
    batched: tuple[SampleKind, ...] = SAMPLE_KINDS  # kinds of samples that a batch takes


@dataclass(frozen=True, eq=False)
class SampleBatch:
    """Samples of N shapes, padded to the largest number of samples."""

    points: Tensor  # (N, P, 3) float32, unit of length, relative to the mean of the samples of each shape
    eigenfunctions: Tensor  # (N, P, K) float32, 1/length; zero where padded
    mask: Tensor  # (N, P) bool, false where padded
    # By name, each (N, P) or (N, P, C) float32; a direction has C = 3
    attributes: Mapping[str, Tensor]

    def map(self, function: Callable[[Tensor], Tensor]) -> SampleBatch:
        """Return the batch with a function applied to each of its tensors."""
        mapped: SampleBatch = tree_map_only(Tensor, function, self)
        return mapped

    def subset(self, n_samples: int, seed: int | None = None) -> SampleBatch:
        """Return at most `n_samples` samples of each shape.

        With a seed, samples are taken at equal steps, with a start that depends on the seed. The samples of a Signature
        are ordered by the shape of the body, so the choice depends neither on the batch nor on how grid and mesh are
        numbered. Without a seed, the global generator of the device draws samples at random.
        """
        n_shapes, n_padded = self.mask.shape
        n_chosen = min(n_samples, n_padded)
        n_present = self.mask.sum(dim=1, keepdim=True)
        numbers = torch.arange(n_chosen, dtype=torch.float64, device=self.mask.device)
        mask = numbers < n_present
        if seed is None:
            priority = torch.rand(self.mask.shape, device=self.mask.device)
            index = priority.masked_fill(~self.mask, -1).topk(n_chosen).indices
        else:
            start = _START_OF_SEED_0 if seed == 0 else _random_start(seed)
            step = (n_present.double() / n_samples).clamp(min=1)
            rank = (step * (numbers + start)).long().clamp(max=n_present - 1)
            index = torch.searchsorted(self.mask.cumsum(dim=1), rank + 1)
        index = index.masked_fill(~mask, 0)
        first_rows = n_padded * torch.arange(n_shapes, device=index.device)
        rows = (first_rows[:, None] + index).flatten()
        has_padding = torch.compiler.is_compiling() or not bool(mask.all())

        def take(values: Tensor) -> Tensor:
            taken = values.flatten(0, 1).index_select(0, rows).unflatten(0, (n_shapes, n_chosen))
            if not has_padding:
                return taken
            return taken.masked_fill_(with_axes_of(~mask, taken), 0)

        attributes = {name: take(values) for name, values in self.attributes.items()}
        return SampleBatch(take(self.points), take(self.eigenfunctions), mask, attributes)


def _random_start(seed: int) -> float:
    generator = torch.Generator("cpu").manual_seed(seed)
    return torch.rand(1, generator=generator, dtype=torch.float64, device="cpu").item()


# The seed of all descriptors; `torch.compile` cannot trace a generator
_START_OF_SEED_0 = _random_start(0)


@dataclass(frozen=True, eq=False)
class Body:
    """One shape of a batch as arrays without padding."""

    eigenvalues: Floats  # (K,) ascending, 1/length²
    interior: Samples  # points relative to their mean
    surface: Samples  # points relative to their mean
    area: float  # of the surface, length²
    volume: float  # of the body, length³
    id: str  # name
    surface_mesh: Mesh | None  # None if the batch has no meshes
    measures: Mapping[str, float] = field(default_factory=dict)  # plain numbers by name, if known

    @property
    def mesh(self) -> Mesh:
        """The surface; raises a ValueError if the batch has no meshes."""
        if self.surface_mesh is None:
            raise ValueError(
                f"{self.id}: expected a batch with meshes, got one without. See SignatureDataset.batch."
            )
        return self.surface_mesh


@dataclass(frozen=True, eq=False)
class SignatureBatch:
    """N Signatures as padded tensors. Padding does not change descriptions.

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
        meshes: N surfaces, for descriptors that need more than the Signatures; None without meshes.
        units: N units of length, each None if unknown; None if all are unknown.
        measures: (N, M) float64, the plain numbers in the order of `POWERS`, NaN where unknown; None without them.
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
    measures: Tensor | None = None

    def __len__(self) -> int:
        return len(self.ids)

    def __repr__(self) -> str:
        names = ", ".join(self.ids[:2])
        more = ", …" if len(self) > 2 else ""
        interior = tuple(self.interior.mask.shape)
        surface = tuple(self.surface.mask.shape)
        n_classes = len(self.labels.unique())
        return (
            f"SignatureBatch({len(self)} bodies: {names}{more}; {self.eigenvalues.shape[-1]} eigenpairs, "
            f"interior {interior}, surface {surface} samples, {n_classes} classes, {self.device})"
        )

    # `for x, y in loader` would unpack two bodies; write `for batch in loader` and batch.labels, or batch.bodies().
    __iter__ = None

    @overload
    def __getitem__(self, index: int) -> Body: ...
    @overload
    def __getitem__(self, index: Indices) -> SignatureBatch: ...
    def __getitem__(self, index: int | Indices) -> Body | SignatureBatch:
        """Return one shape as a `Body` for an integer, or a batch for a slice, indices, or a mask."""
        index = scalar_index(index)
        if isinstance(index, int | np.integer):
            i = range(len(self))[index]
            return self[i : i + 1].to("cpu")._body(0)
        indices = resolve_indices(index, len(self))
        rows: slice | Tensor = torch.tensor(indices, dtype=torch.int64, device=self.labels.device)
        # Slices give views, but tensors allow no negative step
        if isinstance(index, slice) and (index.step or 1) > 0:
            rows = index
        chosen = self.map(lambda values: values[rows])
        meshes = self.meshes and tuple(self.meshes[i] for i in indices)
        units = self.units and tuple(self.units[i] for i in indices)
        ids = tuple(self.ids[i] for i in indices)
        return replace(chosen, ids=ids, meshes=meshes, units=units)

    @property
    def device(self) -> torch.device:
        """Device of the tensors."""
        return self.area.device

    def map(self, function: Callable[[Tensor], Tensor]) -> SignatureBatch:
        """Return the batch with a function applied to each of its tensors."""
        mapped: SignatureBatch = tree_map_only(Tensor, function, self)
        return mapped

    def to(
        self, device: torch.device | str | torch.dtype, non_blocking: bool = False
    ) -> SignatureBatch:
        """Return the batch on another device, or with samples of another floating type, see `torch.Tensor.to`.

        Meshes stay on the CPU, and eigenvalues, area and volume in double precision.
        """
        if not isinstance(device, torch.dtype):
            return self.map(lambda values: values.to(device, non_blocking=non_blocking))

        def convert(values: Tensor) -> Tensor:
            return values.to(device) if values.is_floating_point() else values

        interior = self.interior.map(convert)
        surface = self.surface.map(convert)
        return replace(self, interior=interior, surface=surface)

    def pin_memory(self) -> SignatureBatch:
        """Return the batch in pinned memory; `DataLoader(pin_memory=True)` calls this method."""
        return self.map(Tensor.pin_memory)

    @staticmethod
    def concatenate(batches: Sequence[SignatureBatch]) -> SignatureBatch:
        """Concatenate batches with the same device and sample attributes, and with meshes in all of them or in none."""
        if not batches:
            raise ValueError("batches: expected at least one, got none.")
        meshes = [batch.meshes for batch in batches if batch.meshes is not None]
        if meshes and len(meshes) < len(batches):
            raise ValueError(
                "batches: expected meshes in all batches or in none, got some of each."
            )
        measures = [batch.measures for batch in batches if batch.measures is not None]
        units: list[str | None] = []
        for batch in batches:
            units += batch.units or [None] * len(batch)
        return SignatureBatch(
            eigenvalues=_joined([batch.eigenvalues for batch in batches], math.inf),
            interior=_joined_samples([batch.interior for batch in batches]),
            surface=_joined_samples([batch.surface for batch in batches]),
            area=torch.cat([batch.area for batch in batches]),
            volume=torch.cat([batch.volume for batch in batches]),
            labels=torch.cat([batch.labels for batch in batches]),
            ids=tuple(name for batch in batches for name in batch.ids),
            meshes=tuple(itertools.chain(*meshes)) if meshes else None,
            units=tuple(units),
            measures=torch.cat(measures) if len(measures) == len(batches) else None,
        )

    def bodies(self) -> Iterator[Body]:
        """Iterate over the shapes."""
        return map(self.to("cpu")._body, range(len(self)))

    def _body(self, i: int) -> Body:
        padded = self.eigenvalues[i]
        eigenvalues = padded[torch.isfinite(padded)].numpy()
        return Body(
            eigenvalues,
            _samples_of(self.interior, i, len(eigenvalues)),
            _samples_of(self.surface, i, len(eigenvalues)),
            float(self.area[i]),
            float(self.volume[i]),
            self.ids[i],
            None if self.meshes is None else self.meshes[i],
            {} if self.measures is None else _known(self.measures[i]),
        )


def _joined(parts: Sequence[Tensor], padding: float = 0) -> Tensor:
    """Concatenate tensors along the first dimension, padded to the largest size along the other dimensions."""
    sizes = [part.shape[1:] for part in parts]
    shape = [max(along) for along in zip(*sizes, strict=True)]
    joined = _empty((sum(map(len, parts)), *shape), parts[0])
    start = 0
    for part in parts:
        end = start + len(part)
        rows = joined[start:end]
        behind = rows
        if list(part.shape[2:]) == shape[1:]:  # mostly: only what lies behind the part is padded
            behind = rows[:, part.shape[1] :] if shape else rows[:0]
        behind.fill_(padding)
        rows[tuple(map(slice, part.shape))] = part
        start = end
    return joined


def _empty(shape: tuple[int, ...], like: Tensor) -> Tensor:
    """Return an empty tensor with the type and the device of another."""
    if like.device.type != "cpu" or 0 in shape:
        return like.new_empty(shape)
    # NumPy requests huge pages, which the system provides many times faster than those that PyTorch gets: new memory
    # took a quarter of the time of an epoch.
    n_bytes = math.prod(shape) * like.element_size()
    memory = torch.from_numpy(np.empty(n_bytes, np.uint8))
    return memory.view(like.dtype).view(shape)


def _joined_samples(parts: Sequence[SampleBatch]) -> SampleBatch:
    names = sorted(parts[0].attributes)
    for part in parts:
        others = sorted(part.attributes)
        if others != names:
            raise ValueError(
                f"attributes: all bodies must carry the same, got {names} and {others}."
            )
    attributes = {}
    for name in names:
        attributes[name] = _joined([part.attributes[name] for part in parts])
    return SampleBatch(
        _joined([part.points for part in parts]),
        _joined([part.eigenfunctions for part in parts]),
        _joined([part.mask for part in parts]),
        attributes,
    )


def _known(measures: Tensor) -> dict[str, float]:
    """Return a row of measures by name, without those that are unknown."""
    named = zip(POWERS, measures.tolist(), strict=True)
    return {name: value for name, value in named if not math.isnan(value)}


def _samples_of(batch: SampleBatch, i: int, n_eigenpairs: int) -> Samples:
    mask = batch.mask[i]

    def array(values: Tensor) -> Singles:
        return values[i, mask].numpy()

    return Samples(
        array(batch.points).astype(np.float64),
        array(batch.eigenfunctions)[:, :n_eigenpairs],
        {name: array(values) for name, values in batch.attributes.items()},
    )


@dataclass(frozen=True)
class _Aside:
    """What is no tensor of a batch. All are equal: an exported program takes batches of any names."""

    ids: tuple[str, ...] = field(default=(), compare=False)
    meshes: tuple[Mesh, ...] | None = field(default=None, compare=False)
    units: tuple[str | None, ...] | None = field(default=None, compare=False)


_Context = TypeVar("_Context")
_TENSORS = ("eigenvalues", "interior", "surface", "area", "volume", "labels")
_SAMPLE_TENSORS = ("points", "eigenfunctions", "mask", "attributes")


def _flatten(batch: SignatureBatch) -> tuple[list[Any], _Aside]:
    tensors = [getattr(batch, name) for name in _TENSORS]
    measures = [] if batch.measures is None else [batch.measures]
    return [*tensors, measures], _Aside(batch.ids, batch.meshes, batch.units)


def _unflatten(values: Iterable[Any], aside: _Aside) -> SignatureBatch:
    *tensors, measures = values
    fields = dict(zip(_TENSORS, tensors, strict=True))
    batch = SignatureBatch(**fields, ids=aside.ids, meshes=aside.meshes, units=aside.units)
    return replace(batch, measures=measures[0]) if measures else batch


def _flatten_samples(samples: SampleBatch) -> tuple[list[Any], None]:
    return [samples.points, samples.eigenfunctions, samples.mask, dict(samples.attributes)], None


def _named(
    names: Sequence[str], flat: tuple[Sequence[Any], _Context]
) -> tuple[list[tuple[KeyEntry, Any]], _Context]:
    """Return flattened tensors with their names."""
    values, context = flat
    named = zip(names, values, strict=True)
    return [(MappingKey(name), value) for name, value in named], context


# For `torch.export.export(descriptor, (batch,))` and `torch.func`. These two entries in PyTorch's table of containers
# are of our own types, so nobody else's programs run otherwise.
register_pytree_node(
    SignatureBatch,
    _flatten,
    _unflatten,
    serialized_type_name="igps.SignatureBatch",
    to_dumpable_context=lambda aside: "",
    from_dumpable_context=lambda text: _Aside(),
    flatten_with_keys_fn=lambda batch: _named((*_TENSORS, "measures"), _flatten(batch)),
)
register_pytree_node(
    SampleBatch,
    _flatten_samples,
    lambda tensors, _: SampleBatch(*tensors),
    serialized_type_name="igps.SampleBatch",
    to_dumpable_context=lambda _: "",
    from_dumpable_context=lambda _: None,
    flatten_with_keys_fn=lambda samples: _named(_SAMPLE_TENSORS, _flatten_samples(samples)),
)
