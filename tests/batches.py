"""Batches of made-up bodies."""

from dataclasses import replace

import torch
from torch import nn
from torch.nn.functional import normalize

from igps.data.batch import SampleBatch, SignatureBatch

N_POINTS = (40, 25)
N_EIGENPAIRS = (12, 7)


def two_bodies():
    """Two shapes of different numbers of samples and eigenpairs."""
    generator = torch.Generator().manual_seed(11)
    eigenvalues = torch.rand(2, 12, generator=generator, dtype=torch.float64).cumsum(dim=1) * 10 + 5
    eigenvalues[1, 7:] = torch.inf
    return SignatureBatch(
        eigenvalues=eigenvalues,
        interior=_samples(generator),
        surface=_samples(generator),
        area=torch.tensor([2.0, 3.0], dtype=torch.float64),
        volume=torch.tensor([0.2, 0.3], dtype=torch.float64),
        labels=torch.tensor([0, 1]),
        ids=("a", "b"),
    )


def _samples(generator):
    longest = max(N_POINTS)
    mask = torch.arange(longest) < torch.tensor(N_POINTS)[:, None]
    functions = torch.randn(2, longest, max(N_EIGENPAIRS), generator=generator) * mask[:, :, None]
    for i, n in enumerate(N_EIGENPAIRS):
        functions[i, :, n:] = 0
    points = torch.rand(2, longest, 3, generator=generator) * mask[:, :, None]
    depths = torch.rand(2, longest, generator=generator) * mask
    directions = normalize(torch.randn(2, longest, 3, generator=generator), dim=2)
    attributes = {"depth": depths, "surface_direction": directions * mask[:, :, None]}
    return SampleBatch(points, functions, mask, attributes)


def alone(batch, i):
    """One shape without its padding."""

    def unpadded(samples):
        n_points = int(samples.mask[i].sum())
        n_eigenpairs = int(torch.isfinite(batch.eigenvalues[i]).sum())
        return SampleBatch(
            samples.points[i : i + 1, :n_points],
            samples.eigenfunctions[i : i + 1, :n_points, :n_eigenpairs],
            samples.mask[i : i + 1, :n_points],
            {name: values[i : i + 1, :n_points] for name, values in samples.attributes.items()},
        )

    return replace(
        batch,
        eigenvalues=batch.eigenvalues[i : i + 1, torch.isfinite(batch.eigenvalues[i])],
        interior=unpadded(batch.interior),
        surface=unpadded(batch.surface),
        area=batch.area[i : i + 1],
        volume=batch.volume[i : i + 1],
        labels=batch.labels[i : i + 1],
        ids=batch.ids[i : i + 1],
    )


def scaled(batch, scale):
    """The same shapes, larger."""

    def grown(samples):
        return replace(
            samples, points=samples.points * scale, eigenfunctions=samples.eigenfunctions / scale
        )

    return replace(
        batch,
        eigenvalues=batch.eigenvalues / scale**2,
        interior=grown(batch.interior),
        surface=grown(batch.surface),
        area=batch.area * scale**2,
        volume=batch.volume * scale**3,
    )


def embedded(batch, i, kind="interior", n_eigenpairs=None):
    """(P, K) commute time embedding of one shape's samples, φₖ/√λₖ, float64, by its definition."""
    samples = getattr(batch, kind)
    eigenvalues = batch.eigenvalues[i, torch.isfinite(batch.eigenvalues[i])][:n_eigenpairs]
    functions = samples.eigenfunctions[i, samples.mask[i], : len(eigenvalues)]
    return functions.double() / eigenvalues.sqrt()


def batch_of(embedding, mask=None, points=None, attributes=None):
    """Shapes whose commute time embedding, (N, P, D), is the given one: their eigenvalues are 1, and their areas.

    All that is given is as it is, gradients and padding included; the surface samples are the interior ones.
    """
    n_shapes, n_points, dimension = embedding.shape
    if mask is None:
        mask = torch.ones(n_shapes, n_points, dtype=torch.bool, device=embedding.device)
    if points is None:
        points = torch.zeros_like(embedding[..., :3])
    samples = SampleBatch(points, embedding, mask, attributes or {})
    ones = torch.ones(n_shapes, dtype=torch.float64, device=embedding.device)
    return SignatureBatch(
        eigenvalues=ones[:, None].expand(-1, dimension),
        interior=samples,
        surface=samples,
        area=ones,
        volume=ones,
        labels=torch.full((n_shapes,), -1),
        ids=tuple(map(str, range(n_shapes))),
    )


class OfTensors(nn.Module):
    """A descriptor of the tensors of a padded batch, as a program in another language would call it."""

    def __init__(self, descriptor, like):
        super().__init__()
        self.descriptor = descriptor
        self.like = like

    def forward(self, eigenvalues, area, volume, kinds, measures):
        samples = {}
        for kind, one in kinds.items():
            attributes = dict(one)
            own = [attributes.pop(name) for name in ("points", "eigenfunctions", "mask")]
            samples[kind] = SampleBatch(*own, attributes)
        given = {"eigenvalues": eigenvalues, "area": area, "volume": volume, "measures": measures}
        return self.descriptor(replace(self.like, **given, **samples))


def tensors(batch):
    """What `OfTensors` takes of a batch."""
    kinds = {}
    for kind in ("interior", "surface"):
        one = getattr(batch, kind)
        own = {"points": one.points, "eigenfunctions": one.eigenfunctions, "mask": one.mask}
        kinds[kind] = own | one.attributes
    measures = batch.area[:, None] if batch.measures is None else batch.measures
    return batch.eigenvalues, batch.area, batch.volume, kinds, measures


def exported(descriptor, batch):
    """The program of `OfTensors` that `torch.export` makes for any number of bodies and samples."""
    given = tensors(batch)
    some = {0: torch.export.Dim.AUTO}
    of_samples = {}
    for kind, one in given[3].items():
        of_samples[kind] = {name: {**some, 1: torch.export.Dim.AUTO} for name in one}
    shapes = (some, some, some, of_samples, some)
    module = OfTensors(descriptor, batch)
    return torch.export.export(module, given, dynamic_shapes=shapes, strict=False).module()
