"""Signatures become a batch: padded to the longest, in one piece of memory that worker processes hand over."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import get_worker_info

from igps.data.batch import LabelledSignature, SampleBatch, SignatureBatch
from igps.mesh.mesh import Mesh
from igps.signature.signature import Samples, Signature

_ALIGNED = 64  # bytes


def collate(items: Sequence[LabelledSignature | Signature], meshes: Sequence[Mesh] | None = None) -> SignatureBatch:
    """Pad Signatures to a batch: the `collate_fn` of a `DataLoader` over a `SignatureDataset`.

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
    wanted: list[list[Any]] = [[np.asarray(s.eigenvalues, dtype=np.float64) for s in signatures]]
    wanted += [[np.float64(getattr(s, name)) for s in signatures] for name in ("area", "volume")]
    wanted.append([np.int64(item.label) for item in labelled])
    eigenvalues, area, volume, labels = _padded(wanted, padding=math.inf)
    interior, surface = _pad_samples([[s.interior for s in signatures], [s.surface for s in signatures]])
    ids, units = tuple(item.id for item in labelled), tuple(s.unit for s in signatures)
    given = None if meshes is None else tuple(meshes)
    return SignatureBatch(eigenvalues, interior, surface, area, volume, labels, ids, given, units)


def _pad_samples(rooms: Sequence[Sequence[Samples]]) -> list[SampleBatch]:
    wanted: list[list[NDArray[Any]]] = []
    for samples in rooms:
        names = sorted(samples[0].attributes)
        for s in samples:
            if sorted(s.attributes) != names:
                raise ValueError(
                    f"items: all must carry the same sample attributes, got {names} and {sorted(s.attributes)}."
                )
        # Centred before the cast, or a shape far from the origin would lose its digits.
        wanted.append([(s.points - s.points.mean(axis=0)).astype(np.float32) for s in samples])
        wanted.append([np.asarray(s.eigenfunctions, dtype=np.float32) for s in samples])
        wanted.append([np.ones(len(s), dtype=bool) for s in samples])
        wanted += [[np.asarray(s.attributes[name], dtype=np.float32) for s in samples] for name in names]
    padded = iter(_padded(wanted))
    return [
        SampleBatch(
            next(padded), next(padded), next(padded), {name: next(padded) for name in sorted(one[0].attributes)}
        )
        for one in rooms
    ]


def _padded(wanted: Sequence[Sequence[Any]], padding: float = 0) -> list[Tensor]:
    """Of each list of N arrays an (N, ...) tensor, padded up to the largest size along each dimension."""
    shapes = [(len(some), *map(max, zip(*(one.shape for one in some), strict=True))) for some in wanted]
    if get_worker_info() is not None and hasattr(os, "memfd_create"):
        return _shared(wanted, shapes, padding)
    return [torch.from_numpy(_filled(some, shape, padding)) for some, shape in zip(wanted, shapes, strict=True)]


def _filled(arrays: Sequence[Any], shape: tuple[int, ...], padding: float) -> NDArray[Any]:
    filled = np.empty(shape, arrays[0].dtype)  # for which NumPy asks for large pages: they come many times faster
    for i, one in enumerate(arrays):
        if one.shape[1:] != shape[2:]:
            filled[i] = padding
        where: tuple[Any, ...] = (i, *map(slice, one.shape))
        filled[where] = one
        if len(shape) > 1:
            filled[i, len(one) :] = padding
    return filled


def _shared(wanted: Sequence[Sequence[Any]], shapes: Sequence[tuple[int, ...]], padding: float) -> list[Tensor]:
    """`_padded` in a worker process: all in one piece of shared memory, which goes to the parent by its handle.

    What is written to it as to a file, rather than to its pages, costs half the time.
    """
    kinds = [some[0].dtype for some in wanted]
    sizes = [math.prod(shape) * kind.itemsize for shape, kind in zip(shapes, kinds, strict=True)]
    *starts, end = np.cumsum([0, *(-(-size // _ALIGNED) * _ALIGNED for size in sizes)]).tolist()
    handle = os.memfd_create("batch")
    try:
        os.ftruncate(handle, max(end, _ALIGNED))  # zeros
        for some, shape, start in zip(wanted, shapes, starts, strict=True):
            as_it_is = padding == 0 and all(one.shape[1:] == shape[2:] for one in some)
            pieces = some if as_it_is else [_filled(some, shape, padding)]
            stride = math.prod(shape[1:]) * some[0].itemsize
            for i, piece in enumerate(pieces):
                _write(handle, np.ascontiguousarray(piece), start + i * stride)
        storage = torch.UntypedStorage._new_shared_fd_cpu(handle, max(end, _ALIGNED))  # type: ignore[attr-defined]
    finally:
        os.close(handle)
    block = torch.empty(0, dtype=torch.uint8).set_(storage)
    return [
        block[start : start + size].view(torch.from_numpy(np.empty(0, kind)).dtype).view(shape)
        for start, size, shape, kind in zip(starts, sizes, shapes, kinds, strict=True)
    ]


def _write(handle: int, array: NDArray[Any], start: int) -> None:
    content = array.reshape(-1).view(np.uint8).data
    while len(content):
        n_written = os.pwrite(handle, content, start)
        content, start = content[n_written:], start + n_written
