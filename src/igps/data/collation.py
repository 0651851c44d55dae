"""Signatures become a batch, padded to the longest."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data._utils.collate import default_collate_fn_map

from igps.data._shared_memory import empty_arrays
from igps.data.batch import LabelledSignature, SampleBatch, SignatureBatch, attribute_names
from igps.mesh.mesh import Mesh
from igps.signature.signature import Samples, Signature


def collate(items: Sequence[LabelledSignature | Signature], meshes: Sequence[Mesh] | None = None) -> SignatureBatch:
    """Pad Signatures to a batch, as a `DataLoader` does by itself, also where they are parts of its dataset's items.

    In a worker process of a DataLoader the batch lies in shared memory, from which its consumer reads it.

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
    labelled = [one if isinstance(one, LabelledSignature) else LabelledSignature(one, -1, one.name) for one in items]
    signatures = [item.signature for item in labelled]
    n_most = max(len(s.eigenvalues) for s in signatures)
    # Infinite behind the last eigenvalue, so that every spectral weight is zero there
    missing = [(0, n_most - len(s.eigenvalues)) for s in signatures]
    wanted: list[list[Any]] = [
        [np.pad(s.eigenvalues, n, constant_values=np.inf) for s, n in zip(signatures, missing, strict=True)]
    ]
    wanted += [[np.float64(getattr(s, name)) for s in signatures] for name in ("area", "volume")]
    wanted.append([np.int64(item.label) for item in labelled])
    of_kinds = [[s.interior for s in signatures], [s.surface for s in signatures]]
    for samples in of_kinds:
        wanted += _of_samples(samples)
    eigenvalues, area, volume, labels, *tensors = _padded(wanted)
    rest = iter(tensors)
    interior, surface = (
        SampleBatch(next(rest), next(rest), next(rest), {name: next(rest) for name in sorted(samples[0].attributes)})
        for samples in of_kinds
    )
    ids, units = tuple(item.id for item in labelled), tuple(s.unit for s in signatures)
    given = None if meshes is None else tuple(meshes)
    return SignatureBatch(eigenvalues, interior, surface, area, volume, labels, ids, given, units)


for _kind in (LabelledSignature, Signature):
    default_collate_fn_map[_kind] = lambda items, *, collate_fn_map: collate(items)


def _of_samples(samples: Sequence[Samples]) -> list[list[NDArray[Any]]]:
    """Points, eigenfunctions, masks, and attributes by their names, of each."""
    names = attribute_names(samples, "items")
    return [
        # Centred before the cast, or a shape far from the origin would lose its digits.
        [(s.points - s.points.mean(axis=0)).astype(np.float32) for s in samples],
        [np.asarray(s.eigenfunctions, dtype=np.float32) for s in samples],
        [np.ones(len(s), dtype=bool) for s in samples],
        *([np.asarray(s.attributes[name], dtype=np.float32) for s in samples] for name in names),
    ]


def _padded(wanted: Sequence[Sequence[Any]]) -> list[Tensor]:
    """Of each list of N arrays an (N, ...) tensor, padded by zeros to the largest size along each dimension."""
    shapes = [(len(some), *map(max, zip(*(one.shape for one in some), strict=True))) for some in wanted]
    padded = empty_arrays(shapes, [some[0].dtype for some in wanted])
    for some, filled in zip(wanted, padded, strict=True):
        for i, one in enumerate(some):
            if one.shape[1:] != filled.shape[2:]:
                filled[i] = 0
            where: tuple[Any, ...] = (i, *map(slice, one.shape))
            filled[where] = one
            if filled.ndim > 1:
                filled[i, len(one) :] = 0
    return [torch.from_numpy(filled) for filled in padded]
