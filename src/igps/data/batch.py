"""Signatures of several bodies as padded tensors, and one body of them without the padding."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

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
    """Samples of N shapes, padded to the longest.

    Args:
        points: (N, P, 3) float32, length, measured from the centre of each shape's own samples.
        eigenfunctions: (N, P, K) float32, 1/length; zero where padded.
        mask: (N, P) true where a sample is real.
        attributes: named scalars, each (N, P) float32, and directions, each (N, P, 3) float32.
    """

    points: Tensor
    eigenfunctions: Tensor
    mask: Tensor
    attributes: Mapping[str, Tensor]

    def to(self, device: torch.device | str) -> SampleBatch:
        """The same batch on another device."""
        attributes = {name: values.to(device) for name, values in self.attributes.items()}
        return SampleBatch(self.points.to(device), self.eigenfunctions.to(device), self.mask.to(device), attributes)

    def subset(self, n_samples: int, seed: int | None = None) -> SampleBatch:
        """At most `n_samples` samples of each shape.

        Args:
            n_samples: how many; a shape with fewer keeps all of them.
            seed: takes samples at equal steps along the order they come in, from a start that it draws. In a Signature
                that order is by what the body looks like, and so is the choice: it depends neither on its batch nor on
                how grid and mesh are numbered. If None, torch's global generator draws the samples at random.
        """
        n_kept = min(n_samples, self.mask.shape[1])
        index = torch.zeros(len(self.mask), n_kept, dtype=torch.long)
        kept = torch.zeros(len(self.mask), n_kept, dtype=torch.bool)
        for i, real in enumerate(self.mask.cpu()):
            present = real.nonzero().flatten()
            chosen = present[_chosen(len(present), n_samples, seed)]
            index[i, : len(chosen)] = chosen
            kept[i, : len(chosen)] = True
        index, kept = index.to(self.mask.device), kept.to(self.mask.device)

        n_shapes, longest = self.mask.shape
        rows = (index + longest * torch.arange(n_shapes, device=index.device)[:, None]).flatten()
        missing = ~kept if not bool(kept.all()) else None

        def take(values: Tensor) -> Tensor:
            taken = values.flatten(0, 1).index_select(0, rows).unflatten(0, (n_shapes, n_kept))
            return taken if missing is None else taken.masked_fill_(missing[(..., *[None] * (values.ndim - 2))], 0)

        attributes = {name: take(values) for name, values in self.attributes.items()}
        return SampleBatch(take(self.points), take(self.eigenfunctions), kept, attributes)


def _chosen(n_present: int, n_samples: int, seed: int | None) -> Tensor:
    if seed is None:
        return torch.randperm(n_present)[:n_samples]
    if n_present <= n_samples:
        return torch.arange(n_present)
    start = torch.rand(1, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    steps = (torch.arange(n_samples) + start) * (n_present / n_samples)
    return steps.long().clamp_(max=n_present - 1)


@dataclass(frozen=True, eq=False)
class Body:
    """One shape of a batch, without padding, as arrays.

    Args:
        eigenvalues: (K,) float64 ascending, 1/length².
        interior: interior samples, their points measured from their centre.
        surface: surface samples, likewise.
        area: of the surface, length².
        volume: of the body, length³.
        id: its name.
        surface_mesh: its surface; None where the batch has no meshes.
    """

    eigenvalues: NDArray[np.float64]
    interior: Samples
    surface: Samples
    area: float
    volume: float
    id: str
    surface_mesh: Mesh | None

    @property
    def mesh(self) -> Mesh:
        """The surface, for a descriptor that says it needs it.

        Raises:
            ValueError: the batch has no meshes.
        """
        if self.surface_mesh is None:
            raise ValueError(f"{self.id}: expected a batch with meshes, got one without. See SignatureDataset.batch.")
        return self.surface_mesh


@dataclass(frozen=True, eq=False)
class SignatureBatch:
    """N Signatures, padded so that no descriptor changes by it.

    Example:
        >>> import trimesh
        >>> from igps.signature.signature import SignatureConfig, compute_signature
        >>> bodies = [trimesh.creation.icosphere(subdivisions=2), trimesh.creation.capsule(height=2.0, radius=0.5)]
        >>> config = SignatureConfig(n_eigenpairs=20)
        >>> batch = collate([compute_signature(Mesh(body.vertices, body.faces), config) for body in bodies])
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
    """

    eigenvalues: Tensor
    interior: SampleBatch
    surface: SampleBatch
    area: Tensor
    volume: Tensor
    labels: Tensor
    ids: tuple[str, ...]
    meshes: tuple[Mesh, ...] | None = None

    def __len__(self) -> int:
        return len(self.ids)

    def to(self, device: torch.device | str) -> SignatureBatch:
        """The same batch on another device; meshes stay where they are."""
        return replace(
            self,
            eigenvalues=self.eigenvalues.to(device),
            interior=self.interior.to(device),
            surface=self.surface.to(device),
            area=self.area.to(device),
            volume=self.volume.to(device),
            labels=self.labels.to(device),
        )

    def bodies(self) -> Iterator[Body]:
        """The shapes one by one."""
        for i, name in enumerate(self.ids):
            eigenvalues = self.eigenvalues[i]
            real = torch.isfinite(eigenvalues)
            yield Body(
                eigenvalues=eigenvalues[real].cpu().numpy(),
                interior=_samples_of(self.interior, i, int(real.sum())),
                surface=_samples_of(self.surface, i, int(real.sum())),
                area=float(self.area[i]),
                volume=float(self.volume[i]),
                id=name,
                surface_mesh=None if self.meshes is None else self.meshes[i],
            )


def collate(items: Sequence[LabelledSignature | Signature], meshes: Sequence[Mesh] | None = None) -> SignatureBatch:
    """Pad Signatures to a batch: the `collate_fn` of a `DataLoader` over a `SignatureDataset`.

    Example:
        Bodies differ in the number of their samples, of which the shorter are padded.

        >>> import trimesh
        >>> from igps.signature.signature import SignatureConfig, compute_signature
        >>> config, ball = SignatureConfig(n_eigenpairs=20), trimesh.creation.icosphere(subdivisions=2)
        >>> bodies = [Mesh(ball.vertices * [1, 1, height], ball.faces) for height in (1, 2)]
        >>> batch = collate([compute_signature(body, config) for body in bodies])
        >>> tuple(batch.eigenvalues.shape), (batch.volume[1] / batch.volume[0]).item()
        ((2, 20), 2.0)

    Args:
        items: N Signatures, with or without labels.
        meshes: their surfaces, for descriptors that need them.

    Raises:
        ValueError: no items, samples that carry different attributes, or not one mesh for each.
    """
    if not items:
        raise ValueError("items: expected at least one signature, got none.")
    if meshes is not None and len(meshes) != len(items):
        raise ValueError(f"meshes: expected one for each of {len(items)} signatures, got {len(meshes)}.")
    labelled = [
        item if isinstance(item, LabelledSignature) else LabelledSignature(item, -1, item.name) for item in items
    ]
    signatures = [item.signature for item in labelled]
    eigenvalues = [torch.from_numpy(np.asarray(s.eigenvalues, dtype=np.float64)) for s in signatures]
    return SignatureBatch(
        eigenvalues=pad_sequence(eigenvalues, batch_first=True, padding_value=float("inf")),
        interior=_pad_samples([s.interior for s in signatures]),
        surface=_pad_samples([s.surface for s in signatures]),
        area=torch.tensor([s.area for s in signatures], dtype=torch.float64),
        volume=torch.tensor([s.volume for s in signatures], dtype=torch.float64),
        labels=torch.tensor([item.label for item in labelled], dtype=torch.int64),
        ids=tuple(item.id for item in labelled),
        meshes=None if meshes is None else tuple(meshes),
    )


def _pad_samples(samples: Sequence[Samples]) -> SampleBatch:
    names = set(samples[0].attributes)
    for s in samples:
        if set(s.attributes) != names:
            raise ValueError(
                f"items: all must carry the same sample attributes, got {sorted(names)} and {sorted(s.attributes)}."
            )
    return SampleBatch(
        # Centred before the cast, or a shape far from the origin would lose its digits.
        points=_padded([s.points - s.points.mean(axis=0) for s in samples]),
        eigenfunctions=_padded([s.eigenfunctions for s in samples]),
        mask=pad_sequence([torch.ones(len(s), dtype=torch.bool) for s in samples], batch_first=True),
        attributes={name: _padded([s.attributes[name] for s in samples]) for name in sorted(names)},
    )


def _padded(arrays: Sequence[NDArray[Any]]) -> Tensor:
    """(N, ...) float32 copies of N arrays, with zeros up to the largest size along each dimension."""
    shape = [max(sizes) for sizes in zip(*(array.shape for array in arrays), strict=True)]
    same = all(list(array.shape) == shape for array in arrays)
    # Zeros that nobody will see would take as long as the copy.
    padded = (torch.empty if same else torch.zeros)(len(arrays), *shape)
    for into, array in zip(padded, arrays, strict=True):
        into[tuple(slice(n) for n in array.shape)] = torch.from_numpy(array)
    return padded


def _samples_of(batch: SampleBatch, i: int, n_eigenpairs: int) -> Samples:
    real = batch.mask[i]

    def array(values: Tensor) -> NDArray[np.float32]:
        return values[i, real].cpu().numpy()

    return Samples(
        array(batch.points).astype(np.float64),
        array(batch.eigenfunctions)[:, :n_eigenpairs],
        {name: array(values) for name, values in batch.attributes.items()},
    )
