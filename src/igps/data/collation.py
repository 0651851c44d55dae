"""Collation of Signatures to a padded batch."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from igps.data.batch import LabelledSignature, SampleBatch, SignatureBatch, attribute_names
from igps.mesh.mesh import Mesh
from igps.signature.measures import POWERS
from igps.signature.signature import Samples, Signature


def collate(
    items: Sequence[LabelledSignature | Signature], meshes: Sequence[Mesh] | None = None
) -> SignatureBatch:
    """Pad Signatures and collate them to a batch.

    For a `DataLoader(dataset, collate_fn=collate)`.

    Example:
        >>> import trimesh
        >>> from igps.signature.signature import SignatureConfig, compute_signature
        >>> config, ball = SignatureConfig(n_eigenpairs=20), trimesh.creation.icosphere(subdivisions=2)
        >>> bodies = [Mesh(ball.vertices * [1, 1, height], ball.faces) for height in (1, 2)]
        >>> batch = collate([compute_signature(body, config) for body in bodies])
        >>> tuple(batch.eigenvalues.shape), (batch.volume[1] / batch.volume[0]).item()
        ((2, 20), 2.0)

    Args:
        items: N Signatures, with or without labels.
        meshes: the N surfaces, for descriptors that need them.

    Raises:
        ValueError: there are no items, their samples have different attributes, or the number of meshes is not N.
    """
    if not items:
        raise ValueError("items: expected at least one signature, got none.")
    if meshes is not None and len(meshes) != len(items):
        raise ValueError(
            f"meshes: expected one for each of {len(items)} signatures, got {len(meshes)}."
        )
    labelled = [
        x if isinstance(x, LabelledSignature) else LabelledSignature(x, -1, x.name) for x in items
    ]
    signatures = [item.signature for item in labelled]
    n_eigenpairs = max(len(s.eigenvalues) for s in signatures)
    columns: list[list[Any]] = [
        # Padded by infinity, so that every spectral weight of the padding is zero
        [
            np.pad(s.eigenvalues, (0, n_eigenpairs - len(s.eigenvalues)), constant_values=np.inf)
            for s in signatures
        ],
        [np.float64(s.area) for s in signatures],
        [np.float64(s.volume) for s in signatures],
        [np.int64(item.label) for item in labelled],
        [_row(s.measures) for s in signatures],
    ]
    samples_by_kind = [[s.interior for s in signatures], [s.surface for s in signatures]]
    for samples in samples_by_kind:
        columns += _sample_columns(samples)
    eigenvalues, area, volume, labels, rows, *sample_tensors = _padded(columns)
    data = iter(sample_tensors)
    interior, surface = (
        SampleBatch(
            next(data),
            next(data),
            next(data),
            {name: next(data) for name in sorted(samples[0].attributes)},
        )
        for samples in samples_by_kind
    )
    ids = tuple(item.id for item in labelled)
    units = tuple(s.unit for s in signatures)
    surfaces = None if meshes is None else tuple(meshes)
    measures = rows if all(s.measures for s in signatures) else None
    return SignatureBatch(
        eigenvalues, interior, surface, area, volume, labels, ids, surfaces, units, measures
    )


def _row(measures: Mapping[str, float]) -> NDArray[np.float64]:
    return np.array([measures.get(name, np.nan) for name in POWERS])


def _sample_columns(samples: Sequence[Samples]) -> list[list[NDArray[Any]]]:
    """Return lists of points, eigenfunctions, masks, and attributes in the order of their names."""
    names = attribute_names(samples, "items")
    return [
        # Centred before the conversion to single precision, where shapes far from the origin would lose digits
        [(s.points - s.points.mean(axis=0)).astype(np.float32) for s in samples],
        [np.asarray(s.eigenfunctions, dtype=np.float32) for s in samples],
        [np.ones(len(s), dtype=bool) for s in samples],
        *([np.asarray(s.attributes[name], dtype=np.float32) for s in samples] for name in names),
    ]


def _padded(columns: Sequence[Sequence[Any]]) -> list[Tensor]:
    """Stack each list of N arrays to an (N, ...) tensor, padded by zeros to the largest size of each dimension."""
    stacks = []
    for arrays in columns:
        shape = map(max, zip(*(array.shape for array in arrays), strict=True))
        stack = np.zeros((len(arrays), *shape), arrays[0].dtype)
        for i, array in enumerate(arrays):
            stack[(i, *map(slice, array.shape))] = array
        stacks.append(torch.from_numpy(stack))
    return stacks
