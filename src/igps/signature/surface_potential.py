"""The potential ∫ dS/|x − s| of a uniformly charged triangle mesh, to a relative error that is kept everywhere.

Triangles near a point count by the closed form (Wilton, Rao, Glisson, Schaubert, Al-Bundak and Butler 1984); distant
ones, and clusters of them, by the Taylor series of 1/r about their centroid up to the second order; the first vanishes
there. What is left out of a patch with area A, radius R and mean squared distance σ² from its centroid is at most
A/d · Rσ²/d³ / (1 − R/d) at a distance d from the centroid. As all contributions are positive, a patch that is taken as
far only where this is below a share of A/d keeps that relative error for the sum.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from igps._compiled import is_available
from igps.mesh.surface import longest_side
from igps.signature._closed_forms import spatial_order, squared_distances
from igps.signature._potential_loops import fill_potentials

__all__ = ["surface_potential"]

_POINTS = 32  # in a block; they see the same clusters
_BLOCKS = 128  # worked on at a time: what each of them sees is listed
_FACES = 8  # in the smallest clusters, and so many clusters of one level in one of the next
_PAIRS = 2**13  # of a face and a point at a time: their numbers stay in the second-level cache
_TINY = math.ulp(1.0) ** 2  # keeps a logarithm finite whose factor is 0
_FLAT = 1e-14  # a face's height over its length, below which it has no area and no normal to speak of


def surface_potential(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], points: NDArray[np.float64], accuracy: float = 1e-3
) -> NDArray[np.float64]:
    """∫ dS/|x − s| over a triangle mesh at points x anywhere, on the surface too.

    Args:
        vertices: (V, 3), length.
        faces: (F, 3) vertex indices.
        points: (P, 3), length.
        accuracy: a relative error that is proved for every value. The largest found with 10⁻³, on 26 bodies with and
            without needles, was 4·10⁻⁶: what is left out changes its sign from patch to patch.

    Returns:
        (P,) length.
    """
    corners = torch.from_numpy(vertices[faces])  # a copy
    centre, scale = corners.mean((0, 1)), longest_side(vertices)
    corners = (corners - centre) / scale
    sides = corners.roll(-2, dims=1) - corners.roll(-1, dims=1)
    heights = torch.linalg.cross(sides[:, 0], sides[:, 1]).norm(dim=1) / sides.square().sum(2).amax(1)
    corners = corners[heights > _FLAT]
    x = (torch.tensor(points, dtype=torch.float64) - centre) / scale
    out = torch.zeros(len(x), dtype=torch.float64)
    if len(corners) and len(x):
        tree = _Tree.of(corners[spatial_order(corners.mean(1), _FACES)], accuracy)
        order = spatial_order(x, _POINTS)
        if is_available():
            out[order] = tree.compiled_potentials(x[order])
        else:
            for members in order.split(_POINTS * _BLOCKS):
                out[members] = tree.potentials(x[members])
    return out.numpy() * scale


@dataclass(frozen=True)
class _Tree:
    """Clusters of consecutive faces, in levels, the faces themselves the first; and each face's quarters.

    The quarters are what the series is evaluated of where a face is opened: they halve the distance at which the closed
    form takes over.
    """

    corners: torch.Tensor  # (F, 3, 3)
    levels: list[_Patches]
    reaches: list[torch.Tensor]  # (n,) of the patches of each level
    first: list[int]  # patch at which each level begins if they are numbered through, and the number of all
    limits: torch.Tensor  # (F,): squared distance from a face's centroid from which on its quarters' series serve
    near: _Near

    @staticmethod
    def of(corners: torch.Tensor, accuracy: float) -> _Tree:
        """Of triangles (F, 3, 3), close ones together."""
        levels = [_Patches.of(corners)]
        while len(levels[-1].areas) > 2 * _FACES:
            levels.append(levels[-1].merged(_FACES))
        faces = levels[0]
        quarters = _Patches(faces.areas / 4, faces.centres, faces.spreads / 4, faces.radii / 2)
        # Their centroids are that of the face and those half-way to its corners.
        limits = (quarters.reaches(accuracy) + faces.radii / 2).square()
        first = [0, *np.cumsum([len(level.areas) for level in levels]).tolist()]
        reaches = [level.reaches(accuracy) for level in levels]
        return _Tree(corners, levels, reaches, first, limits, _Near.of(corners))

    @cached_property
    def table(self) -> torch.Tensor:
        """(4 F + …, 15) the series of the quarters, four a face, and of the patches of all levels."""
        quarters = _Patches.of(_quarters(self.corners).flatten(0, 1))
        return torch.cat([patches.series for patches in (quarters, *self.levels)])

    def potentials(self, points: torch.Tensor) -> torch.Tensor:
        """(n,) at points (n, 3), close ones together."""
        blocks = points.split(_POINTS)
        clusters, opened = self._seen(blocks)
        quarter = torch.arange(4)
        values = []
        for block, rows, faces in zip(blocks, clusters, opened, strict=True):
            is_near = squared_distances(self.levels[0].centres[faces], block) < self.limits[faces, None]
            quarters = (4 * faces[:, None] + quarter).flatten()
            value = _far_sum(self.table[rows], block)
            value += _far_sum(self.table[quarters], block, is_near.repeat_interleave(4, 0))
            face, column = is_near.nonzero().T
            values.append(value.index_add_(0, column, self.near(faces[face], block[column])))
        return torch.cat(values)

    def compiled_potentials(self, points: torch.Tensor) -> torch.Tensor:
        """`potentials` by loops that Numba compiles."""
        patches = torch.cat([torch.cat([p.centres, p.areas[:, None], _entries(p.form)], 1) for p in self.levels])
        reaches = torch.cat(self.reaches)
        out = np.empty(len(points))
        fill_potentials(
            points.numpy(),
            _POINTS,
            patches.numpy(),
            reaches.numpy(),
            np.array(self.first),
            _FACES,
            self.limits.numpy(),
            self.near.table.numpy(),
            out,
        )
        return torch.from_numpy(out)

    def _seen(self, blocks: Sequence[torch.Tensor]) -> tuple[Sequence[torch.Tensor], Sequence[torch.Tensor]]:
        """For each block of points: which rows of the table are far from all of it, and which faces are opened."""
        low = torch.stack([block.amin(0) for block in blocks])
        high = torch.stack([block.amax(0) for block in blocks])
        far_blocks, far_rows = [], []
        n_coarsest = len(self.levels[-1].areas)
        block, patch = torch.cartesian_prod(torch.arange(len(blocks)), torch.arange(n_coarsest)).T
        children = torch.arange(_FACES)
        for k in reversed(range(len(self.levels))):
            is_far = _gap(self.levels[k].centres[patch], low[block], high[block]) >= self.reaches[k][patch]
            far_blocks.append(block[is_far])
            far_rows.append(4 * len(self.corners) + self.first[k] + patch[is_far])
            block, patch = block[~is_far], patch[~is_far]
            if k:
                patch = (_FACES * patch[:, None] + children).flatten()
                exists = patch < len(self.levels[k - 1].areas)
                block, patch = block.repeat_interleave(_FACES)[exists], patch[exists]
        rows = _by_block(torch.cat(far_rows), torch.cat(far_blocks), len(blocks))
        return rows, _by_block(patch, block, len(blocks))


def _gap(centres: torch.Tensor, low: torch.Tensor, high: torch.Tensor) -> torch.Tensor:
    gap = (centres - centres.clamp(low, high)).square_()
    return (gap[:, 0] + gap[:, 1] + gap[:, 2]).sqrt_()


def _by_block(values: torch.Tensor, block: torch.Tensor, n_blocks: int) -> tuple[torch.Tensor, ...]:
    return values[block.argsort(stable=True)].split(block.bincount(minlength=n_blocks).tolist())


def _quarters(corners: torch.Tensor) -> torch.Tensor:
    """(F, 4, 3, 3) corners of the four like triangles that each triangle (F, 3, 3) consists of."""
    a, b, c = corners.unbind(1)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return torch.stack([torch.stack(part, 1) for part in parts], 1)


@dataclass(frozen=True)
class _Patches:
    """Pieces of the surface, as the far rule sees them."""

    areas: torch.Tensor  # (n,)
    centres: torch.Tensor  # (n, 3): centroids
    spreads: torch.Tensor  # (n, 3, 3): covariance of the points
    radii: torch.Tensor  # (n,) of a ball about the centroid that holds the patch

    @staticmethod
    def of(corners: torch.Tensor) -> _Patches:
        """Of triangles (n, 3, 3)."""
        centres = corners.mean(1)
        arms = corners - centres[:, None]
        areas = torch.linalg.cross(arms[:, 0] - arms[:, 1], arms[:, 0] - arms[:, 2]).norm(dim=1) / 2
        return _Patches(areas, centres, arms.mT @ arms / 12, arms.norm(dim=2).amax(1))

    def merged(self, size: int) -> _Patches:
        """So many consecutive ones as one."""
        group = torch.arange(len(self.areas)) // size
        n_groups = int(group[-1]) + 1

        def total(values: torch.Tensor) -> torch.Tensor:
            return values.new_zeros(n_groups, *values.shape[1:]).index_add_(0, group, values)

        areas = total(self.areas)
        centres = total(self.areas[:, None] * self.centres) / areas[:, None]
        arms = self.centres - centres[group]
        moments = self.areas[:, None, None] * (self.spreads + arms[:, :, None] * arms[:, None])
        radii = areas.new_zeros(n_groups).scatter_reduce_(0, group, arms.norm(dim=1) + self.radii, "amax")
        return _Patches(areas, centres, total(moments) / areas[:, None, None], radii)

    def reaches(self, accuracy: float) -> torch.Tensor:
        """(n,) distance from the centroid from which on the series has a relative error below the accuracy."""
        variances = self.spreads.diagonal(dim1=1, dim2=2).sum(1)
        # (g + R/2)² (g − R/2) ≥ g³ for g ≥ R.
        least = (self.radii * variances / accuracy).pow(1 / 3)
        return torch.maximum(least, 1.5 * self.radii) + self.radii / 2

    @property
    def form(self) -> torch.Tensor:
        """(n, 3, 3): A·(3/2 C − ½ tr C·1)."""
        trace = self.spreads.diagonal(dim1=1, dim2=2).sum(1)
        form = 1.5 * self.spreads - 0.5 * trace[:, None, None] * torch.eye(3, dtype=torch.float64)
        return self.areas[:, None, None] * form

    @property
    def series(self) -> torch.Tensor:
        """(n, 15): centroid, r² = |c − x|² − |x|² and A·(3/2 dᵀCd − ½ tr C r²) as polynomials, see `_far_sum`; area."""
        form = self.form
        product = (form @ self.centres[:, :, None])[..., 0]
        constant = (self.centres * product).sum(1, keepdim=True)
        quadratic = [constant, -2 * product, _entries(form)]
        squares = self.centres.square().sum(1, keepdim=True)
        return torch.cat([squares, -2 * self.centres, self.areas[:, None], *quadratic], 1)


def _entries(form: torch.Tensor) -> torch.Tensor:
    """(n, 6) coefficients of xx, yy, zz, xy, xz, yz of quadratic forms (n, 3, 3)."""
    return torch.cat([form.diagonal(dim1=1, dim2=2), 2 * form[:, (0, 0, 1), (1, 2, 2)]], 1)


def _far_sum(series: torch.Tensor, points: torch.Tensor, without: torch.Tensor | None = None) -> torch.Tensor:
    """(P,) Σ A/r + A (3/2 dᵀCd − ½ tr C r²)/r⁵ over patches (n, 15), without some of the pairs (n, P)."""
    x, y, z = points.T
    monomials = torch.stack([torch.ones_like(x), x, y, z, x * x, y * y, z * z, x * y, x * z, y * z])
    inverse = torch.addmm(monomials[4:7].sum(0), series[:, :4], monomials[:4])
    # Below, there is but rounding, of a patch that then is too small to tell.
    inverse.clamp_min_(1e-24).reciprocal_()
    root = inverse.sqrt()
    if without is not None:
        root.masked_fill_(without, 0)
    second = series[:, 5:] @ monomials
    return series[:, 4] @ root + second.mul_(inverse.square_()).mul_(root).sum(0)


@dataclass(frozen=True)
class _Near:
    """The closed form, for single pairs of a face and a point."""

    table: torch.Tensor  # (F, 25): corners, normal, outward normals of the sides in the plane, their lengths, 2 area

    @staticmethod
    def of(corners: torch.Tensor) -> _Near:
        sides = corners.roll(-1, dims=1) - corners  # from each corner to the next
        normals = torch.linalg.cross(sides[:, 0], sides[:, 1])
        double_areas = normals.norm(dim=1, keepdim=True)
        normals = normals / double_areas
        lengths = sides.norm(dim=2)
        outward = torch.linalg.cross(sides / lengths[..., None], normals[:, None].expand(-1, 3, -1))
        return _Near(torch.cat([corners.flatten(1), normals, outward.flatten(1), lengths, double_areas], 1))

    def __call__(self, faces: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
        """(n,) potentials of faces (n,) at points (n, 3): Σ p ln((r + r' + l)/(r + r' − l)) − |h Ω|.

        Sum over the sides, of length l, with p the distance of the point's projection from their line, positive inside,
        and r, r' the distances of the ends; h is that from the plane and Ω the solid angle (Van Oosterom and Strackee
        1983). On a side both p and the quotient's denominator vanish, and their product is 0.
        """
        parts = zip(faces.split(_PAIRS), points.split(_PAIRS), strict=True)
        return torch.cat([self._potentials(*part) for part in parts])

    def _potentials(self, faces: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
        table = self.table.index_select(0, faces).T.contiguous()
        x = points.T.contiguous()
        corners = table[:9].view(3, 3, -1) - x
        distances = corners.square().sum(1).sqrt_()
        height = (table[9:12] * corners[0]).sum(0).abs_()
        inside = (table[12:21].view(3, 3, -1) * corners).sum(1)
        lengths, double_areas = table[21:24], table[24]
        total = distances + distances.roll(-1, 0)
        logarithms = torch.log((total + lengths) / (total - lengths).clamp_min_(_TINY))
        products = (corners * corners.roll(-1, 0)).sum(1)  # of corners 0·1, 1·2, 2·0
        denominators = distances.prod(0) + (products * distances.roll(-2, 0)).sum(0)
        angles = torch.atan2(height * double_areas, denominators)
        return (inside * logarithms).sum(0) - 2 * height * angles
