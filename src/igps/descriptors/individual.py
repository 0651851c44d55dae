"""What tells individuals apart beside their form: size, and which of two mirror images a body is."""

import math
from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Literal, get_args

import torch
from torch import Tensor

from igps._parameters import check_one_of
from igps.data.batch import SignatureBatch
from igps.mesh.mesh import MILLIMETRES, millimetres
from igps.nn.axes import InteriorDistance, PairTwist
from igps.nn.batch_features import BatchFeatures
from igps.nn.descriptor import Descriptor
from igps.nn.embedding import SpectralEmbedding
from igps.nn.histograms.pairs import PairHistogram
from igps.retrieval import euclidean

Size = Literal["auto", "keep", "ignore"]
Mirror = Literal["same", "distinct"]

SIZE, SIDE = "+size", "+side"
"""Behind the name of a descriptor that keeps size, and of one that tells a body from its mirror image."""

SCALES: Mapping[str, float] = {
    "interior": 0.017, "gps": 0.017, "multiscale": 0.03, "rich": 0.026, "pretrained": 0.1, "d2": 0.035,
    "shape_dna": 17, "volume_shape_dna": 23, "local_diameter_centricity": 0.14, "inner_distance": 0.004,
    "canonical_form": 0.066, "geodesic_spectral": 0.0014, "spectral_gw": 0.0014,
}  # fmt: skip
"""The median distance between generated bodies of one class, by descriptor, as `training.study scales` prints it."""

# The distance between individuals of a body is a quarter of that, but for `pretrained`, which leaves little of it.
_SHARE, _NEAR = 0.25, {"pretrained": 0.0043}
# How much more a distance counts at most where size differs; the difference in size of half that; and the differences
# in twist and in signed volumes between individuals of one body.
_MOST, _HALF, _TWIST, _VOLUME = 2.0, 0.3, 0.002, 0.0085
# Vectors of `signed_volumes`, and diffusion times over area
_N_VECTORS, _TIMES = 7, (0.01, 0.04, 0.15)


class IndividualDescriptor(Descriptor):
    """A descriptor that also keeps size, or tells left from right, or both: `NAME+side+size`.

    A description is that of the descriptor, then for the side `signed_volumes` and the odd part of a histogram of
    `PairTwist`, whose signs a mirror image turns, then for size log √area and log ∛volume, of millimetres where the
    unit is known. With d the distance of the descriptor, n what is usual between individuals of a body (a quarter of
    its scale if not known), t the Euclidean distance of the numbers of side and s the sum of the two differences in
    size, that of the bodies is e + 2 (e + n) s/(0.3 + s) of e = d + t. So where bodies are much the same in form size
    adds to the distance, and else multiplies it, up to three times; no collection is looked at. The numbers of side and
    size are written so that Euclidean distances of whole descriptions, too, count them like this.

    Args:
        descriptor: any.
        size: whether to keep size.
        side: whether to tell a body from its mirror image.
        scale: of the descriptor, see `Descriptor`; its own, or that of `SCALES`, if None.

    Raises:
        ValueError: the scale of the descriptor is not known, or it keeps size already.
    """

    def __init__(
        self, descriptor: Descriptor, *, size: bool = False, side: bool = False, scale: float | None = None
    ) -> None:
        super().__init__()
        if size and "scale" not in descriptor.invariant_to:
            raise ValueError(f"size: expected a descriptor that ignores size by itself, got {descriptor.name!r}.")
        scale = scale or scale_of(descriptor)
        if scale is None:
            raise ValueError(
                f"size, mirror: expected a descriptor whose distances are known, got {descriptor.name!r}. Set its "
                "attribute `scale` to the median of its distances between bodies of one class."
            )
        self.descriptor, self.scale, self.keeps_size = descriptor, scale, size
        self._unit = _NEAR.get(descriptor.name, _SHARE * scale)
        embedding = SpectralEmbedding(n_eigenpairs=16)
        axes = [InteriorDistance(6, 3.0), PairTwist()]
        self.twists = PairHistogram(axes, embedding) if side else None
        self.name, self.source = descriptor.name + SIDE * side + SIZE * size, descriptor.source
        # "motion" holds reflections
        lost = ["scale"] * size + ["motion"] * side
        self.invariant_to = tuple(one for one in descriptor.invariant_to if one not in lost)
        self.requirements = descriptor.requirements
        if self.twists is not None:
            self.requirements |= self.twists.requirements

    def describe(self, batch: SignatureBatch) -> Tensor:
        """(N, D + 53 + 2); without the numbers of side or of size where these are not kept."""
        parts = [self.descriptor(batch).flatten(1)]
        if self.twists is not None:
            counts = self.twists(BatchFeatures(batch, self.training))
            odd = (counts - counts.flip(-1))[..., counts.shape[-1] // 2 :] / 2
            parts += [self._unit / _VOLUME * signed_volumes(batch).to(odd), self._unit / _TWIST * odd.flatten(1)]
        if self.keeps_size:
            lengths = [millimetres(one) for one in batch.units or [None] * len(batch)]
            size = torch.stack([batch.area.log() / 2, batch.volume.log() / 3], dim=1)
            size = size + torch.tensor(lengths, dtype=size.dtype, device=size.device).log()[:, None]
            parts.append(self._unit * _MOST / _HALF * size.to(parts[0].dtype))
        return torch.cat(parts, dim=1)

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, D) and (G, D) descriptions to (Q, G) distances."""
        (form, side, size), (forms, sides, sizes) = self.split(queries), self.split(gallery)
        found = self.descriptor.distances(form, forms)
        if self.twists is not None:
            found = found + euclidean(side, sides)
        if self.keeps_size:
            apart = torch.cdist(size, sizes, p=1) / (self._unit * _MOST)  # over 0.3
            found = found + _MOST * (found + self._unit) * apart / (1 + apart)
        return found

    def coordinates(self, descriptions: Tensor, *, of_one_kind: bool = False) -> Tensor:
        """(N, D) descriptions to the coordinates of the descriptor, and the numbers of side and size."""
        form, *others = self.split(descriptions)
        return torch.cat([self.descriptor.coordinates(form, of_one_kind=of_one_kind), *others], dim=1)

    def short(self, descriptions: Tensor) -> Tensor:
        """(N, D) descriptions to (N, ≤ 256 + 55): those of the descriptor, or a ValueError, and of side and size."""
        form, *others = self.split(descriptions)
        return torch.cat([self.descriptor.short(form), *others], dim=1)

    def wrap(self, descriptor: Descriptor) -> "IndividualDescriptor":
        """The same numbers of side and size beside another descriptor."""
        kept = {"size": self.keeps_size, "side": self.twists is not None}
        found = IndividualDescriptor(descriptor, scale=self.scale, **kept)
        found._unit = self._unit
        return found

    def split(self, descriptions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(N, D) descriptions split into the descriptor's own, in its shape, and the numbers of side and of size."""
        n_volumes = math.comb(_N_VECTORS, 3)
        n_size, n_side = 2 * self.keeps_size, 0 if self.twists is None else n_volumes + self.twists.n_cells // 2
        n_form = descriptions.shape[1] - n_side - n_size
        form, side, size = descriptions.split([n_form, n_side, n_size], dim=1)
        return form.unflatten(1, self.descriptor.description_shape), side, size


def signed_volumes(batch: SignatureBatch) -> Tensor:
    """(N, 35) volumes of what three of seven vectors span, whose signs a mirror image turns.

    The vectors are means of samples about their middle: of interior ones and of surface ones by their distance from it,
    of surface ones by the heat that stays with them at three times; and two of these by the second moments of the
    interior. They turn with the body. Each volume is over the product of its three lengths to the power of 2/3, in
    units of √area. A body that looks the same after two turns of its own has none.
    """
    root = batch.area.sqrt()[:, None, None]
    (inside, real), (outside, shown) = (
        (one.points / root, (one.mask / one.mask.sum(dim=1, keepdim=True))[..., None].to(root))
        for one in (batch.interior, batch.surface)
    )
    inside, outside = inside - (inside * real).sum(dim=1)[:, None], outside - (outside * shown).sum(dim=1)[:, None]
    moments = (inside * real).mT @ inside
    moments = moments / moments.diagonal(dim1=1, dim2=2).sum(dim=1)[:, None, None]
    k = min(16, batch.eigenvalues.shape[1])
    eigenvalues = batch.eigenvalues[:, None, :k] * batch.area[:, None, None]
    decay = torch.exp(-root.new_tensor(_TIMES)[:, None] * eigenvalues)
    heat = batch.surface.eigenfunctions[..., :k].to(root).square() @ decay.mT
    heat = heat / (heat * shown).sum(dim=1, keepdim=True)
    weights = torch.cat([outside.norm(dim=2, keepdim=True), heat], dim=2) * shown
    vectors = torch.cat([(inside.norm(dim=2, keepdim=True) * real).mT @ inside, weights.mT @ outside], dim=1)
    vectors = torch.cat([vectors, vectors[:, 1:3] @ moments], dim=1)
    triples = vectors[:, torch.tensor([*combinations(range(_N_VECTORS), 3)], device=vectors.device)]
    lengths = triples.norm(dim=3).prod(dim=2).clamp_min(torch.finfo(triples.dtype).tiny)
    return torch.linalg.det(triples) / lengths.pow(2 / 3)


def scale_of(descriptor: Descriptor) -> float | None:
    """The median of the distances of a descriptor between bodies of one class; None if it is not known."""
    return descriptor.scale or SCALES.get(descriptor.name)


def keeps_size(size: Size, units: Sequence[str | None]) -> tuple[bool, str]:
    """Whether bodies are to be compared in size, too, and a sentence where their units leave that open.

    Args:
        size: "auto" keeps it where all have a unit, and ignores it else.
        units: of the N bodies.
    """
    check_one_of(get_args(Size), size=size)
    n_known = sum(unit in MILLIMETRES for unit in units)
    if size == "ignore" or n_known == len(units) or (n_known == 0 and size == "auto"):
        return size == "keep" or (size == "auto" and n_known > 0), ""
    some = f"{len(units) - n_known} of {len(units)} bodies have no unit of length"
    if size == "keep":
        return True, f"size is kept: {some}; their numbers count as millimetres" if n_known else ""
    return False, f"size is ignored: {some}; where their numbers are millimetres, say --size keep"
