"""Explanation of the distance of two bodies: shares of the parts of their descriptions and of their samples."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from igps._arrays import Floats
from igps._tensors import above_zero
from igps.analysis.dissimilarity import REQUIREMENTS, dissimilarity
from igps.analysis.superposition import Movement
from igps.data.batch import SampleBatch, SignatureBatch
from igps.data.collation import collate
from igps.data.dataset import SignatureDataset
from igps.data.requirements import Requirements
from igps.descriptors.size_and_side import SizeAndSide, form_of
from igps.nn.batch_features import WEIGHT, BatchFeatures
from igps.nn.descriptor import Descriptor, EmbeddedDescriptor, HistogramDescriptor
from igps.nn.histograms.base import DescriptionPart, SampleHistogram
from igps.signature.signature import SAMPLE_KINDS, SampleKind

# Nodes of the quadrature along the line between two descriptions, tried in order until its relative error is small
_N_NODES = (16, 64, 256, 1024)
_TOLERANCE = 1e-8
_BLOCK_NODES = 16  # nodes whose gradients are in memory at once
_MIN_DISTANCE = 1e-12  # smaller distances are 0 up to rounding
_N_NEIGHBOURS = 12  # samples whose mean is the value of a point of the surface

Shares = Mapping[SampleKind, Floats]


@dataclass(frozen=True, eq=False)
class Explanation:
    """Shares of a distance. A negative share comes from a property that makes the bodies more similar."""

    distance: float  # by the descriptor
    # Share of each histogram, by the quantity that it counts; they sum to the distance
    parts: Mapping[str, float]
    # Shares (P,) of the samples of each kind in the first and in the second body; all together sum to the distance
    samples: tuple[Shares, Shares]
    # As `samples`, but non-negative and by weights or local dissimilarity, see `explain`
    places: tuple[Shares, Shares]

    def summary(self) -> str:
        """Return the three largest shares of histograms as text."""
        if not self.distance:
            return "identical"
        by_size = sorted(self.parts.items(), key=lambda item: -abs(item[1]))
        largest = by_size[:3]
        return ", ".join(f"{share / self.distance:.0%} {name}" for name, share in largest)


def explain(
    descriptor: Descriptor,
    one: SignatureBatch,
    other: SignatureBatch,
    weights: tuple[Floats, Floats] | None = None,
) -> Explanation:
    """Divide the distance of two bodies among the histograms, and among the samples of both bodies.

    The share of a histogram cell is its value by Aumann and Shapley (1974): the derivative of the distance with respect
    to the square root of the cell, averaged along the straight line on which the square roots of both descriptions move
    apart from their midpoint, times the difference of the two roots. The shares sum to the distance, also under a
    nonlinear head such as that of `pretrained`. For the χ² distance, the share is the term of the cell; for a squared
    Euclidean distance under a linear head, it is the product of its two factors.

    The share of a cell divided by the difference of its two contents is the share of one unit of content, of opposite
    sign in the two bodies. It goes to the pairs of samples in the cell, half to each sample of a pair; the share of a
    limb, a piece or an eigenvalue goes to the samples from which that is computed.

    Between poses, most pairs change a little, and these shares spread over the whole body. The field `places` locates
    small differences better: each body has half of the distance, divided among its surface samples in proportion to
    their dissimilarity to the corresponding samples of the other body, or to given weights: such as those of a
    `Movement`, where places of the bodies correspond by what their files say.

    Args:
        descriptor: histograms, such as interior or rich, or histograms under a head, such as pretrained; with or
            without side and size.
        one, other: batches of one body each; without weights, with the attribute "surface_direction".
        weights: (P,) of the surface samples of both bodies, not negative, for `places`.

    Raises:
        ValueError: another kind of descriptor, or a batch of several bodies.
    """
    if len(one) != 1 or len(other) != 1:
        raise ValueError(
            f"one, other: expected batches of one body, got {len(one)} and {len(other)} bodies."
        )
    # Samples of the surface, and their normals, show how far places differ
    requirements = REQUIREMENTS if weights is None else Requirements()
    requirements.check(one)
    requirements.check(other)
    descriptor = copy.deepcopy(descriptor).double().eval()
    headless = without_head(descriptor)
    pair = (_with_weights(one), _with_weights(other))
    first, second = (headless(batch).detach().flatten() for batch in pair)
    units, distance = unit_shares(descriptor, first, second)
    shares = units * (first - second)
    parts = _part_shares(descriptor, shares)
    samples = _sample_shares(descriptor, pair, units, shares)
    if weights is None:
        body = one[0]
        other_body = other[0]
        weights = (dissimilarity(body, other_body), dissimilarity(other_body, body))
    on_first = _on_surface(distance / 2, weights[0], samples[0])
    on_second = _on_surface(distance / 2, weights[1], samples[1])
    return Explanation(distance, parts, samples, (on_first, on_second))


def explain_bodies(
    descriptor: Descriptor, dataset: SignatureDataset, moved: Movement | None
) -> Explanation:
    """Divide the distance of the two bodies of a dataset, by how far their places moved, if that is known."""
    one = dataset[0].signature
    other = dataset[1].signature
    weights = None
    if moved is not None:
        weights = moved.weights(one.surface.points, other.surface.points)
    return explain(descriptor, collate([one]), collate([other]), weights)


def _on_surface(half: float, weights: Floats, like: Shares) -> Shares:
    """Divide half of a distance among the surface samples alone, in proportion to their weights."""
    shares = half * weights / weights.sum()
    return {"interior": np.zeros(len(like["interior"])), "surface": shares}


def without_head(descriptor: Descriptor) -> Descriptor:
    """Return the descriptor without its head: it describes the histogram cells, followed by side and size, if any."""
    histograms = _histograms(descriptor)
    if isinstance(descriptor, SizeAndSide):
        return descriptor.wrap(histograms)
    return histograms


def unit_shares(descriptor: Descriptor, one: Tensor, other: Tensor) -> tuple[Tensor, float]:
    """Return the shares of one unit of each content in the distance of two bodies, and the distance.

    Args:
        descriptor: see `explain`, in double precision.
        one, other: (cells,) contents, see `without_head`. Side and size vary linearly on the line of `explain`.

    Returns:
        (cells,) shares of a unit in the first body, those in the second being the negatives; and the distance.
    """
    n = _n_cells(descriptor)
    contents = torch.stack([one, other]).double()
    roots = _with_roots(contents, n)
    midpoint = roots.mean(dim=0)
    half = (roots[0] - roots[1]) / 2
    distance = float(_distances_of_roots(descriptor, roots[:, None]).detach())
    if distance <= _MIN_DISTANCE:
        return torch.zeros_like(midpoint), 0.0
    for n_nodes in _N_NODES:
        gradient = _mean_gradient(descriptor, midpoint, half, n_nodes)
        error = abs(float(gradient @ half) * 2 - distance)
        if error <= _TOLERANCE * distance:
            break
    total = roots[:, :n].sum(dim=0)
    units = torch.where(total > 0, gradient[:n] / above_zero(total), 0)
    return torch.cat([units, gradient[n:]]), distance


def _with_roots(contents: Tensor, n_cells: int) -> Tensor:
    """Return contents (N, cells + others) with square roots of the cells."""
    roots = contents[:, :n_cells].sqrt()
    return torch.cat([roots, contents[:, n_cells:]], dim=1)


def _distances_of_roots(descriptor: Descriptor, pairs: Tensor) -> Tensor:
    """Return the distances (M,) of M pairs of bodies, given (2, M, cells + others) with roots of the cells."""
    n = _n_cells(descriptor)
    form_descriptor = form_of(descriptor)
    descriptions = []
    for roots in pairs:
        form = roots[:, :n].square()
        if isinstance(form_descriptor, EmbeddedDescriptor):
            form = form_descriptor.head(form)
        descriptions.append(torch.cat([form, roots[:, n:]], dim=1))
    return descriptor.distances(*descriptions).diagonal()


def _mean_gradient(descriptor: Descriptor, midpoint: Tensor, half: Tensor, n_nodes: int) -> Tensor:
    """Return the derivative of the distance by the first body's roots, averaged along the line of `explain`.

    Args:
        descriptor: see `explain`.
        midpoint, half: (cells,) mean of the roots of both bodies, and half of their difference.
        n_nodes: number of nodes of the Gauss-Legendre quadrature.
    """
    nodes, weights = np.polynomial.legendre.leggauss(n_nodes)
    gradient = torch.zeros_like(midpoint)
    for first in range(0, n_nodes, _BLOCK_NODES):
        block = slice(first, first + _BLOCK_NODES)
        x = torch.tensor(nodes[block])
        w = torch.tensor(weights[block])
        step = (x[:, None] + 1) / 2 * half
        ends = torch.stack([midpoint + step, midpoint - step]).requires_grad_()
        mean = _distances_of_roots(descriptor, ends) @ (w / 2)
        (derivative,) = torch.autograd.grad(mean, ends)
        gradient += (derivative[0] - derivative[1]).sum(dim=0) / 2
    return gradient


def share_density(shares: Shares, samples: Mapping[SampleKind, Floats], points: Floats) -> Any:
    """Return the density of shares at points near the samples.

    Args:
        shares, samples: shares (P,) and positions (P, 3) of the samples of each kind.
        points: (V, 3) points, such as vertices.

    Returns:
        (V,) mean share of the nearest samples times the number of samples, added over both kinds: 1 everywhere if all
        shares of one kind are equal and sum to 1.
    """
    density = np.zeros(len(points))
    for kind, values in shares.items():
        if np.any(values):
            n_nearest = min(_N_NEIGHBOURS, len(values))
            _, nearest = cKDTree(samples[kind]).query(points, n_nearest)
            nearby = values[nearest].reshape(len(points), -1)
            density += len(values) * nearby.mean(axis=1)
    return density


def _histograms(descriptor: Descriptor) -> HistogramDescriptor:
    found = form_of(descriptor)
    if isinstance(found, EmbeddedDescriptor):
        found = found.descriptor
    if not isinstance(found, HistogramDescriptor):
        raise ValueError(
            f"descriptor: expected histograms of samples (interior, rich, pretrained, ...), got {descriptor.name!r}."
        )
    return found


def _n_cells(descriptor: Descriptor) -> int:
    return sum(_histograms(descriptor).part_cells)


def _part_shares(descriptor: Descriptor, shares: Tensor) -> dict[str, float]:
    """Sum the shares of cells for each histogram, and those of side and of size if the descriptor keeps these."""
    sums: dict[str, float] = {}
    first = 0
    for _, part in _histograms(descriptor).histogram_shares:
        values = shares[first : first + part.n_cells]
        first += part.n_cells
        name = part_name(part)
        sums[name] = sums.get(name, 0.0) + float(values.sum())
    if isinstance(descriptor, SizeAndSide):
        _, side, size = descriptor.split(shares[None])
        if side.numel():
            sums["side"] = float(side.sum())
        if size.numel():
            sums["size"] = float(size.sum())
    return sums


def _with_weights(batch: SignatureBatch) -> SignatureBatch:
    """Return a batch in double precision whose samples have weights 1 that require gradients."""

    def weighted(samples: SampleBatch) -> SampleBatch:
        weights = torch.ones_like(samples.points[..., 0]).requires_grad_()
        return replace(samples, attributes={**samples.attributes, WEIGHT: weights})

    batch = batch.to(torch.float64)
    return replace(batch, interior=weighted(batch.interior), surface=weighted(batch.surface))


def _sample_shares(
    descriptor: Descriptor, pair: Sequence[SignatureBatch], units: Tensor, shares: Tensor
) -> tuple[Shares, Shares]:
    """Divide the distance among the samples of two bodies, given the unit shares and the shares of all contents."""
    # Side and size are divided equally among both bodies and both kinds of samples
    uniform = float(shares[_n_cells(descriptor) :].sum()) / 4
    histograms = _histograms(descriptor)
    first, second = pair
    return (
        _shares_of_body(histograms, first, units, uniform),
        _shares_of_body(histograms, second, -units, uniform),
    )


def _shares_of_body(
    histograms: HistogramDescriptor, batch: SignatureBatch, units: Tensor, uniform: float
) -> Shares:
    """Return the shares of the samples of a body, given the shares of units; each kind shares `uniform` equally."""
    weights = [getattr(batch, kind).attributes[WEIGHT] for kind in SAMPLE_KINDS]
    features = BatchFeatures(batch, False)
    total = units.new_zeros(())
    first = 0
    for share, part in histograms.histogram_shares:
        cells = share * part.of_features(features).flatten()
        value = cells @ units[first : first + part.n_cells]
        first += part.n_cells
        if not value.requires_grad:
            name = type(part).__name__
            raise ValueError(
                f"descriptor: {name} does not use the weights of samples, see DescriptionPart."
            )
        total = total + value / part.degree
    gradients = torch.autograd.grad(total, weights, allow_unused=True, materialize_grads=True)
    shares = {}
    for kind, gradient in zip(SAMPLE_KINDS, gradients, strict=True):
        values = gradient[0].numpy()
        shares[kind] = values + uniform / len(values)
    return shares


_AXES = {
    "InteriorDistance": "interior distances",
    "EuclideanDistance": "distances in space",
    "PairCosines": "directions",
    "EmbeddedPairCosines": "directions to the surface",
    "BallRadius": "thickness",
    "Attribute": "attributes",
    "AxialHistogram": "place along the axes",
    "BranchHistogram": "lengths of limbs",
    "PieceHistogram": "sizes of pieces",
    "SpectrumShares": "spectrum",
}


def part_name(part: DescriptionPart) -> str:
    """Return what a part of a description counts, as text."""
    label: str = getattr(part, "label", "")
    if label:
        return label
    axes = getattr(part, "axes", [part])
    words = []
    for axis in axes:
        name = type(axis).__name__
        word = getattr(axis, "label", _AXES.get(name, name))
        is_only_position = name == "Potential" and len(axes) > 1
        if word not in words and not is_only_position:
            words.append(word)
    samples = f" ({part.samples})" if isinstance(part, SampleHistogram) else ""
    return " and ".join(words) + samples
