"""Descriptors that compare size and handedness beside the form, to tell individuals apart."""

import math
from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Literal, get_args

import torch
from torch import Tensor

from igps._parameters import check_one_of
from igps._tensors import above_zero
from igps.data.batch import SampleBatch, SignatureBatch
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
"""Suffixes of the names of descriptors that keep size, and that distinguish a body from its mirror image."""

SIZE_COLUMNS = ("size.log_area", "size.log_volume")
"""Names of the columns that hold the size of a body."""

SCALES: Mapping[str, float] = {
    "interior": 0.017,
    "gps": 0.017,
    "multiscale": 0.03,
    "rich": 0.026,
    "pretrained": 0.083,
    "d2": 0.035,
    "shape_dna": 17,
    "volume_shape_dna": 23,
    "local_diameter_centricity": 0.14,
    "inner_distance": 0.004,
    "canonical_form": 0.066,
    "geodesic_spectral": 0.0014,
    "spectral_gw": 0.0014,
}
"""The median distance between generated bodies of one class, by descriptor: eight classes of four bodies."""

# Typical distance between generated individuals of one body, over the scale of the descriptor
_INDIVIDUAL_SHARE = 0.25
# The difference in size, |Δ log area| + |Δ log volume|, that doubles a distance. NN / FT of `pretrained` among made-up
# individuals in poses, the given half of the red cells, and thigh bones: with 0.5, 97.2 / 86.9, 92.8 / 70.9 and
# 79.4 / 79.4; with 0.2, 94.4 / 83.6, 91.3 / 71.7 and 79.4 / 79.4; without size, 85.0 / 72.5, 81.2 / 56.0 and
# 79.4 / 79.4.
_DOUBLING_SIZE = 0.5
# Typical differences in twist and in signed volumes between individuals of one body.
_TYPICAL_TWIST, _TYPICAL_VOLUME = 0.002, 0.0085
# Eigenpairs for the heat in `signed_volumes`: at its shortest time, later ones have decayed on most bodies
_N_HEAT_EIGENPAIRS = 16
# Vectors in `signed_volumes`, and their diffusion times over area
_N_VECTORS = 7
_TIMES = (0.01, 0.04, 0.15)


class SizeAndSide(Descriptor):
    """A descriptor that also compares size, or distinguishes mirror images, or both: `NAME+side+size`.

    A description has up to three blocks: the description by the wrapped descriptor, a side block and a size block. The
    side block holds `signed_volumes` and the odd part of a histogram of `PairTwist`; a mirror image has the same
    numbers with opposite signs. The size block holds log area and log volume, in millimetres if the unit is known.

    Let d be the distance by the descriptor, t the Euclidean distance of the side blocks, and s the sum of the
    differences of log area and log volume. Let n be a quarter of the descriptor's scale, a typical distance between
    individuals of one body. The distance of two bodies is e + (e + n) s / 0.5 with e = d + t. A difference of 10 % in
    all lengths, s = 0.5, doubles it, and separates bodies of the same form, too. It does not depend on the collection.
    Both blocks are scaled so that they have about the same effect on Euclidean distances of whole descriptions.

    Args:
        descriptor: any descriptor.
        size: whether to compare size.
        side: whether to distinguish a body from its mirror image.
        scale: of the descriptor, see `Descriptor`; its own scale, or its entry in `SCALES`, if None.

    Raises:
        ValueError: the scale of the descriptor is not known, or the descriptor keeps size already.
    """

    def __init__(
        self,
        descriptor: Descriptor,
        *,
        size: bool = False,
        side: bool = False,
        scale: float | None = None,
    ) -> None:
        super().__init__()
        if size and "scale" not in descriptor.invariant_to:
            raise ValueError(
                f"size: expected a descriptor that ignores size by itself, got {descriptor.name!r}."
            )
        scale = scale or scale_of(descriptor)
        if scale is None:
            raise ValueError(
                f"size, mirror: expected a descriptor of known scale, got {descriptor.name!r}. Set its attribute "
                "`scale` to the median of its distances between bodies of one class."
            )
        self.descriptor = descriptor
        self.scale = scale
        self.keeps_size = size
        self._unit = _INDIVIDUAL_SHARE * scale
        self.twists = None
        self.name = descriptor.name
        self.source = descriptor.source
        compared = set()
        if side:
            axes = [InteriorDistance(6, 3.0), PairTwist()]
            self.twists = PairHistogram(axes, SpectralEmbedding(n_eigenpairs=16))
            self.name += SIDE
            compared.add("motion")  # which includes reflections
        if size:
            self.name += SIZE
            compared.add("scale")
        self.invariant_to = tuple(name for name in descriptor.invariant_to if name not in compared)
        self.requirements = descriptor.requirements
        if self.twists is not None:
            self.requirements |= self.twists.requirements

    def describe(self, batch: SignatureBatch) -> Tensor:
        """(N, D + 53 + 2) descriptions; without the side or the size block if it is not compared."""
        parts = [self.descriptor(batch).flatten(1)]
        if self.twists is not None:
            counts = self.twists(BatchFeatures(batch, self.training))
            n_twists = counts.shape[-1]
            differences = counts - counts.flip(-1)
            odd = differences[..., n_twists // 2 :] / 2
            volumes = signed_volumes(batch).to(odd)
            parts.append(self._unit / _TYPICAL_VOLUME * volumes)
            parts.append(self._unit / _TYPICAL_TWIST * odd.flatten(1))
        if self.keeps_size:
            sizes = _log_sizes(batch).to(parts[0].dtype)
            parts.append(self._unit / _DOUBLING_SIZE * sizes)
        return torch.cat(parts, dim=1)

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, D) and (G, D) descriptions to (Q, G) distances."""
        form, side, size = self.split(queries)
        forms, sides, sizes = self.split(gallery)
        distances = self.descriptor.distances(form, forms)
        if self.twists is not None:
            distances = distances + euclidean(side, sides)
        if self.keeps_size:
            share = torch.cdist(size, sizes, p=1) / self._unit  # s / 0.5
            distances = distances + (distances + self._unit) * share
        return distances

    def coordinates(self, descriptions: Tensor, *, within_class: bool = False) -> Tensor:
        """(N, D) descriptions to the coordinates of the descriptor, then the side and size blocks."""
        form, side, size = self.split(descriptions)
        coordinates = self.descriptor.coordinates(form, within_class=within_class)
        return torch.cat([coordinates, side, size], dim=1)

    def column_names(self, width: int) -> list[str]:
        """Return the names of the descriptor's own columns, then `side.0` and so on, and those of size."""
        columns = torch.arange(width)[None]
        form, side, size = self.split(columns)
        names = self.descriptor.column_names(form.numel())
        names += [f"side.{i}" for i in range(side.shape[1])]
        return names + list(SIZE_COLUMNS)[: size.shape[1]]

    def shorten(self, descriptions: Tensor) -> Tensor:
        """(N, D) descriptions to (N, ≤ 256 + 55): `shorten` of the descriptor (or its ValueError), then others."""
        form, side, size = self.split(descriptions)
        return torch.cat([self.descriptor.shorten(form), side, size], dim=1)

    def wrap(self, descriptor: Descriptor) -> "SizeAndSide":
        """Return a `SizeAndSide` of another descriptor with the same options and scales."""
        has_side = self.twists is not None
        return SizeAndSide(descriptor, size=self.keeps_size, side=has_side, scale=self.scale)

    def split(self, descriptions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Split descriptions (N, D) into the descriptor's own, in its shape, the side block and the size block."""
        n_side = 0
        if self.twists is not None:
            n_side = math.comb(_N_VECTORS, 3) + self.twists.n_cells // 2
        n_size = 2 if self.keeps_size else 0
        n_form = descriptions.shape[1] - n_side - n_size
        form, side, size = descriptions.split([n_form, n_side, n_size], dim=1)
        return form.unflatten(1, self.descriptor.description_shape), side, size


def signed_volumes(batch: SignatureBatch) -> Tensor:
    """(N, 35) signed volumes of the parallelepipeds of all triples of seven vectors that rotate with the body.

    The volumes of a mirror image have opposite signs. The first five vectors are weighted means of samples relative to
    their centroid: of the interior samples and of the surface samples by their distances from it, and of the surface
    samples by the heat that remains at each after three diffusion times. The last two are the second and the third
    vector, multiplied by the matrix of second moments of the interior. A volume is divided by the product of its three
    lengths to the power of 2/3, in units of √area. A body that is symmetric under rotations about two axes has zero
    volumes.
    """
    root = batch.area.sqrt()[:, None, None]
    interior, interior_weights = _centred(batch.interior, root)
    surface, surface_weights = _centred(batch.surface, root)
    moments = (interior * interior_weights).mT @ interior
    traces = moments.diagonal(dim1=1, dim2=2).sum(dim=1)
    moments = moments / traces[:, None, None]
    k = min(_N_HEAT_EIGENPAIRS, batch.eigenvalues.shape[1])
    eigenvalues = batch.eigenvalues[:, None, :k] * batch.area[:, None, None]
    times = root.new_tensor(_TIMES)
    decay = torch.exp(-times[:, None] * eigenvalues)
    eigenfunctions = batch.surface.eigenfunctions[..., :k].to(root)
    heat = eigenfunctions.square() @ decay.mT
    heat = heat / (heat * surface_weights).sum(dim=1, keepdim=True)
    distances = surface.norm(dim=2, keepdim=True)
    functions = torch.cat([distances, heat], dim=2)
    on_surface = (functions * surface_weights).mT @ surface
    depths = interior.norm(dim=2, keepdim=True)
    inside = (depths * interior_weights).mT @ interior
    vectors = torch.cat([inside, on_surface], dim=1)
    vectors = torch.cat([vectors, vectors[:, 1:3] @ moments], dim=1)
    indices = list(combinations(range(_N_VECTORS), 3))
    triples = vectors[:, torch.tensor(indices, device=vectors.device)]
    lengths = above_zero(triples.norm(dim=3).prod(dim=2))
    return torch.linalg.det(triples) / lengths.pow(2 / 3)


def _centred(samples: SampleBatch, root: Tensor) -> tuple[Tensor, Tensor]:
    """Positions (N, P, 3) relative to their centroid, in units of √area, and weights (N, P, 1) of sum 1."""
    shares = samples.mask / samples.mask.sum(dim=1, keepdim=True)
    weights = shares[..., None].to(root)
    points = samples.points / root
    centroid = (points * weights).sum(dim=1)
    return points - centroid[:, None], weights


def _log_sizes(batch: SignatureBatch) -> Tensor:
    """(N, 2) log area and log volume, in millimetres where the unit is known."""
    units = batch.units or [None] * len(batch)
    factors = batch.area.new_tensor([millimetres(unit) for unit in units])
    shifts = factors.log()
    log_area = batch.area.log() + shifts * 2
    log_volume = batch.volume.log() + shifts * 3
    return torch.stack([log_area, log_volume], dim=1)


def form_of(descriptor: Descriptor) -> Descriptor:
    """Return a descriptor without size and side."""
    return descriptor.descriptor if isinstance(descriptor, SizeAndSide) else descriptor


def scale_of(descriptor: Descriptor) -> float | None:
    """Return the median distance between bodies of one class by a descriptor; None if it is not known."""
    return descriptor.scale or SCALES.get(descriptor.name)


def keeps_size(size: Size, units: Sequence[str | None]) -> tuple[bool, str]:
    """Return whether sizes are compared, and a warning about bodies without a unit of length ("" if not needed).

    Args:
        size: "auto" compares sizes if all bodies have a unit of length.
        units: of the N bodies.
    """
    check_one_of(get_args(Size), size=size)
    n_known = sum(unit in MILLIMETRES for unit in units)
    n_unknown = len(units) - n_known
    keeps = size == "keep" or (size == "auto" and n_known > 0 and n_unknown == 0)
    if size == "ignore" or n_known == 0 or n_unknown == 0:
        return keeps, ""
    reason = f"{n_unknown} of {len(units)} bodies have no unit of length"
    if keeps:
        return True, f"size is kept: {reason}; their coordinates are taken as millimetres"
    remedy = "if their coordinates are millimetres, give --size keep"
    return False, f"size is ignored: {reason}; {remedy}"
