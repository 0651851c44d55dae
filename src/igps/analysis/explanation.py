"""Where two bodies differ: their distance, shared out among the parts of the description and the samples of each."""

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from igps._arrays import Floats
from igps.analysis.correspondence import dissimilarity
from igps.data.batch import SampleBatch, SignatureBatch
from igps.descriptors.individual import IndividualDescriptor
from igps.nn.batch_features import WEIGHT, BatchFeatures
from igps.nn.descriptor import Descriptor, EmbeddedDescriptor, HistogramDescriptor
from igps.nn.histograms.base import DescriptionPart, SampleHistogram
from igps.signature.signature import SAMPLE_KINDS, SampleKind

# Nodes of the integral along the line between two descriptions, and of what share of the distance it may miss
_NODES, _MISSED = (16, 64, 256, 1024), 1e-8
# Samples that a point of the surface takes its value from
_NEIGHBOURS = 12

Shares = Mapping[SampleKind, Floats]


@dataclass(frozen=True, eq=False)
class Explanation:
    """A distance, shared out. Shares may be negative: what makes the bodies alike."""

    distance: float  # by the descriptor
    parts: Mapping[str, float]  # of each histogram, by what it counts, its share; they sum to the distance
    # Of the one and the other body, of each kind of samples (P,) their shares; all together sum to the distance
    samples: tuple[Shares, Shares]
    # The same distance shared out among the samples of the surfaces by where the bodies are unlike, see
    # `igps.analysis.correspondence`; none is negative. None of two groups
    places: tuple[Shares, Shares] | None = None

    def summary(self) -> str:
        """The three largest shares in words."""
        if self.distance < 1e-12:  # but for rounding
            return "no difference"
        largest = sorted(self.parts.items(), key=lambda one: -abs(one[1]))[:3]
        return ", ".join(f"{share / self.distance:.0%} {name}" for name, share in largest)


def explain(descriptor: Descriptor, one: SignatureBatch, other: SignatureBatch) -> Explanation:
    """Share the distance of two bodies out among the histograms, and among the samples of both.

    A cell's share is that of Aumann and Shapley (1974): its derivative of the distance, in mean along the straight line
    on which the square roots of both descriptions come apart from their midpoint, times how far the cell's root comes.
    Of χ² this is the cell's own term, of a squared Euclidean distance behind a linear head the product of its two
    factors; and of a nonlinear head, as that of `pretrained`, too, the shares sum to the distance. A cell's share, over
    the difference of the two bodies in it, is what a unit of its contents counts, positive in one body and negative in
    the other. So it goes to the pairs in the cell, from each pair to its two samples in halves, and from a limb, a
    piece or an eigenvalue to the samples that make it.

    In other poses most pairs move a little, and what they share lies everywhere. `places` tells better where a small
    part is other: half of the distance goes to each body, and there to each sample of the surface in proportion to how
    unlike it is to those of the other body that correspond to it.

    Args:
        descriptor: of histograms, such as interior or rich, alone or under a head, such as pretrained; with side or
            size, or without.

    Raises:
        ValueError: a descriptor of another kind, or not one body each.
    """
    if len(one) != 1 or len(other) != 1:
        raise ValueError(f"one, other: expected a body each, got {len(one)} and {len(other)}.")
    descriptor = copy.deepcopy(descriptor).double().eval()
    contents, pair = contents_of(descriptor), (_doubled(one), _doubled(other))
    first, second = torch.cat([contents(batch).detach().flatten(1) for batch in pair])
    units, distance = unit_shares(descriptor, first, second)
    shares = units * (first - second)
    samples = _of_samples(descriptor, pair, units, shares)
    places = _placed(one, other, samples[0], distance), _placed(other, one, samples[1], distance)
    return Explanation(distance, _of_parts(descriptor, shares), samples, places)


def _placed(body: SignatureBatch, other: SignatureBatch, samples: Shares, distance: float) -> Shares:
    """Half of the distance, shared out among the surface samples of a body."""
    weights = dissimilarity(body, other)
    return {"interior": np.zeros(len(samples["interior"])), "surface": distance / 2 * weights / weights.sum()}


def contents_of(descriptor: Descriptor) -> Descriptor:
    """What describes the cells of a descriptor, and behind them its numbers of side and size; without its head."""
    histograms = _histograms(descriptor)
    return descriptor.wrap(histograms) if isinstance(descriptor, IndividualDescriptor) else histograms


def unit_shares(descriptor: Descriptor, one: Tensor, other: Tensor) -> tuple[Tensor, float]:
    """The share of a unit of each cell's contents in the distance, positive in the first body, and the distance itself.

    The descriptor is in double precision, see `explain`; its contents are (cells,), see `contents_of`, whose numbers of
    side and size come apart as they are and not as roots.
    """
    n, form = _n_cells(descriptor), descriptor
    if isinstance(descriptor, IndividualDescriptor):
        form = descriptor.descriptor
    ends = torch.stack([one, other]).double()
    roots = torch.cat([ends[:, :n].sqrt(), ends[:, n:]], dim=1)
    middle, half = roots.mean(dim=0), (roots[0] - roots[1]) / 2

    def distances(ends: Tensor) -> Tensor:
        cells = (one[:, :n].square() for one in ends)
        if isinstance(form, EmbeddedDescriptor):
            cells = (form.head(one) for one in cells)
        rows = (torch.cat([own, one[:, n:]], dim=1) for own, one in zip(cells, ends, strict=True))
        return descriptor.distances(*rows).diagonal()

    with torch.no_grad():
        distance = float(distances(roots[:, None]))
    gradient = torch.zeros_like(middle)
    for n_nodes in _NODES if distance else ():
        gradient.zero_()
        nodes, weights = np.polynomial.legendre.leggauss(n_nodes)
        steps = zip(torch.tensor(nodes).split(16), torch.tensor(weights).split(16), strict=True)
        for places, parts in steps:
            away = (places[:, None] + 1) / 2 * half
            ends = torch.stack([middle + away, middle - away]).requires_grad_()
            (found,) = torch.autograd.grad(distances(ends) @ (parts / 2), ends)
            gradient += (found[0] - found[1]).sum(dim=0) / 2
        if abs(float(gradient @ half) * 2 - distance) <= _MISSED * distance:
            break
    total = roots[:, :n].sum(dim=0)
    units = torch.where(total > 0, gradient[:n] / total.clamp_min(torch.finfo(total.dtype).tiny), 0)
    return torch.cat([units, gradient[n:]]), distance


def on_surface(shares: Shares, samples: Mapping[SampleKind, Floats], points: Floats) -> Any:
    """(V,) what the body has of the difference about each point: 1 where it is as everywhere, if the sum were 1.

    Of the samples of each kind, shares (P,) and places (P, 3); and points (V, 3), such as vertices.
    """
    found = np.zeros(len(points))
    for kind, values in shares.items():
        if np.any(values):
            _, nearest = cKDTree(samples[kind]).query(points, min(_NEIGHBOURS, len(values)))
            found += len(values) * values[nearest].reshape(len(points), -1).mean(axis=1)
    return found


def _histograms(descriptor: Descriptor) -> HistogramDescriptor:
    found = descriptor.descriptor if isinstance(descriptor, IndividualDescriptor) else descriptor
    found = found.descriptor if isinstance(found, EmbeddedDescriptor) else found
    if not isinstance(found, HistogramDescriptor):
        raise ValueError(
            f"descriptor: expected histograms of samples, such as interior, rich or pretrained, whose cells know their "
            f"samples, got {descriptor.name!r}."
        )
    return found


def _n_cells(descriptor: Descriptor) -> int:
    return sum(_histograms(descriptor).part_cells)


def _of_parts(descriptor: Descriptor, shares: Tensor) -> dict[str, float]:
    """The share of each histogram in the distance, and of side and size where these are kept, from those of cells."""
    parts = [part for group in _histograms(descriptor).parts for part in group]
    own, found = shares[: _n_cells(descriptor)].split([part.n_cells for part in parts]), dict[str, float]()
    for part, values in zip(parts, own, strict=True):
        found[part_name(part)] = found.get(part_name(part), 0.0) + float(values.sum())
    form, side, size = (shares[None], *shares.new_empty(2, 1, 0))
    if isinstance(descriptor, IndividualDescriptor):
        form, side, size = descriptor.split(shares[None])
    told = {"side": side, "size": torch.cat([form[:, _n_cells(descriptor) :], size], dim=1)}
    return found | {name: float(values.sum()) for name, values in told.items() if values.numel()}


def _doubled(batch: SignatureBatch) -> SignatureBatch:
    """In double precision, and with weights of the samples that have a gradient."""

    def weighted(samples: SampleBatch) -> SampleBatch:
        weights = torch.ones_like(samples.points[..., 0]).requires_grad_()
        return replace(samples, attributes={**samples.attributes, WEIGHT: weights})

    batch = batch.to(torch.float64)
    return replace(batch, interior=weighted(batch.interior), surface=weighted(batch.surface))


def _of_samples(
    descriptor: Descriptor, pair: Sequence[SignatureBatch], units: Tensor, shares: Tensor
) -> tuple[Shares, Shares]:
    """The share of each sample of two bodies in the distance, from those of the units and of all contents."""
    # Those of side and size: half in each body, of that half in each kind of samples
    everywhere = float(shares[_n_cells(descriptor) :].sum()) / 4
    histograms, found = _histograms(descriptor), list[Shares]()
    for batch, signed in zip(pair, (units, -units), strict=True):
        weights = [getattr(batch, kind).attributes[WEIGHT] for kind in SAMPLE_KINDS]
        features, total, first = BatchFeatures(batch, False), units.new_zeros(()), 0
        for group in histograms.parts:
            for part in group:
                cells = part.of_features(features).flatten() / (len(histograms.parts) * len(group))
                values = cells @ signed[first : first + part.n_cells]
                first += part.n_cells
                if not values.requires_grad:
                    raise ValueError(
                        f"descriptor: {type(part).__name__} does not heed weights of samples, see DescriptionPart."
                    )
                total = total + values / part.degree
        gradients = torch.autograd.grad(total, weights, allow_unused=True, materialize_grads=True)
        own = zip(SAMPLE_KINDS, (one[0].numpy() for one in gradients), strict=True)
        found.append({kind: values + everywhere / len(values) for kind, values in own})
    return found[0], found[1]


_AXES = {
    "InteriorDistance": "interior distances", "EuclideanDistance": "distances in space", "PairCosines": "directions",
    "EmbeddedPairCosines": "directions to the surface", "BallRadius": "thickness", "Attribute": "attributes",
    "Shares": "kinds of residues",
    "AxialHistogram": "place along the axes", "BranchHistogram": "lengths of limbs",
    "PieceHistogram": "sizes of pieces", "SpectrumShares": "spectrum",
}  # fmt: skip


def part_name(part: DescriptionPart) -> str:
    """What a part of a description counts, in words."""
    axes = [type(axis).__name__ for axis in getattr(part, "axes", [part])]
    words = list(dict.fromkeys(_AXES.get(name, name) for name in axes if name != "Potential" or len(axes) == 1))
    place = f" ({part.samples})" if isinstance(part, SampleHistogram) else ""
    return " and ".join(words) + place


def significant_cells(
    one: Tensor, other: Tensor, *, level: float = 0.05, n_permutations: int = 1000, seed: int = 0
) -> Tensor:
    """(cells,) in which the means of two groups differ by more than chance, any false one with probability `level`.

    A permutation test of the largest difference in standard deviations (Westfall and Young 1993).

    Args:
        one, other: (N, cells) square roots of histograms of two groups.
        level: of the family of all cells.
        n_permutations: of the bodies between the groups.
        seed: of these.
    """
    rows, n = torch.cat([one, other]).double(), len(one)
    rows = rows - rows.mean(dim=0)
    scale = rows.std(dim=0)
    rows = torch.where(scale > 1e-12, rows / scale.clamp_min(1e-12), 0)
    signs = torch.full((n_permutations + 1, len(rows)), -1 / len(other), dtype=torch.float64)
    random = torch.Generator().manual_seed(seed)
    for i in range(n_permutations + 1):
        signs[i, torch.arange(n) if i == 0 else torch.randperm(len(rows), generator=random)[:n]] = 1 / n
    differences = (signs @ rows).abs()
    return differences[0] > differences.max(dim=1).values.quantile(1 - level)


def explain_groups(
    descriptor: Descriptor, one: Tensor, other: Tensor, batches: Sequence[SignatureBatch], **test: Any
) -> tuple[Explanation, Tensor]:
    """Share the distance of two groups' mean descriptions out, on a body of each, by cells that a test holds alone.

    The distance is what is left of it in those cells, see `significant_cells`; the two bodies' shares sum to it where
    their own descriptions are the means.

    Args:
        descriptor: see `explain`.
        one, other: (N, ...) contents, see `contents_of`.
        batches: two bodies to be painted, one of each group.
        test: options of `significant_cells`, whose result comes behind the explanation.

    Raises:
        ValueError: too few bodies for a test.
    """
    level, (n, m) = test.get("level", 0.05), (len(one), len(other))
    ways = math.comb(n + m, n) // (1 + (n == m))  # of equal groups two are the same difference
    if ways * level <= 1:
        raise ValueError(
            f"one, other: {n} and {m} bodies can be arranged in only {ways} ways, too few to tell anything from "
            f"chance at a level of {level}. Add bodies, or explain one of each."
        )
    descriptor = copy.deepcopy(descriptor).double().eval()
    rows, n = [group.double().flatten(1) for group in (one, other)], _n_cells(descriptor)
    kept = significant_cells(*(torch.cat([group[:, :n].sqrt(), group[:, n:]], dim=1) for group in rows), **test)
    means = [group.mean(dim=0) for group in rows]
    units = torch.where(kept, unit_shares(descriptor, *means)[0], 0)
    shares = units * (means[0] - means[1])
    parts = _of_parts(descriptor, shares)
    samples = _of_samples(descriptor, [_doubled(batch) for batch in batches], units, shares)
    return Explanation(sum(parts.values()), parts, samples), kept
