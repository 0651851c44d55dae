"""Collation of Signatures to a padded batch."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from igps.data.batch import LabelledSignature, SampleBatch, SignatureBatch
from igps.mesh.mesh import Mesh
from igps.signature.measures import POWERS
from igps.signature.signature import Samples, Signature


def collate(
    items: Sequence[LabelledSignature | Signature], meshes: Sequence[Mesh] | None = None
) -> SignatureBatch:
    """Pad Signatures and collate them to a batch.

    For a `DataLoader(dataset, collate_fn=collate)`. Of a dataset that was made for a descriptor, the batch takes only
    the kinds of samples that the descriptor reads.

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
    batch = SignatureBatch.concatenate([_single(item) for item in labelled])
    return batch if meshes is None else replace(batch, meshes=tuple(meshes))


def _single(item: LabelledSignature) -> SignatureBatch:
    """Return a batch of one body."""
    signature = item.signature
    measures = None
    if signature.measures:
        measures = _row([signature.measures.get(name, math.nan) for name in POWERS])
    interior = _samples(signature.interior, "interior" in item.batched)
    surface = _samples(signature.surface, "surface" in item.batched)
    return SignatureBatch(
        eigenvalues=_row(signature.eigenvalues),
        interior=interior,
        surface=surface,
        area=_row(signature.area),
        volume=_row(signature.volume),
        labels=_row(item.label, np.int64),
        ids=(item.id,),
        units=(signature.unit,),
        measures=measures,
    )


def _samples(samples: Samples, is_read: bool) -> SampleBatch:
    # Centred before the conversion to single precision, where shapes far from the origin would lose digits
    points = samples.points - samples.points.mean(axis=0)
    attributes = {name: _row(v, np.float32) for name, v in sorted(samples.attributes.items())}
    batch = SampleBatch(
        _row(points, np.float32),
        _row(samples.eigenfunctions, np.float32),
        _row(np.ones(len(samples), dtype=bool), bool),
        attributes,
    )
    return batch if is_read else batch.map(lambda values: values[:, :0])


def _row(values: ArrayLike, dtype: type = np.float64) -> Tensor:
    """Return values of one body as the only row of a tensor on the CPU."""
    return torch.from_numpy(np.require(values, dtype, "W"))[None]
