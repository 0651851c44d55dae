"""Far field of the mean value weights: moments of hat functions, and of clusters of them (see `closed_forms`).

Both rules are Taylor series of the kernel h/r⁴ about a centre, with an error of third order in radius / distance.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations, combinations_with_replacement, product

import torch

from igps._compiled import is_available
from igps._threads import ALONE, Team
from igps.signature._closed_forms import Surface, Tile, spatial_order
from igps.signature._weight_loops import fill_hat_weights

__all__ = ["Block", "ClusterMoments", "HatMoments", "HatTree", "in_leaves", "principal_axes"]

_LEAF = 32  # hats in the smallest clusters; one costs as much as 19
_N_TERMS = 19
_ROUNDING = 128 * torch.finfo(torch.float32).eps  # of a squared distance in single precision, over that of the points


@dataclass(frozen=True)
class HatMoments:
    """Far rule for vertices. The kernel h/r⁴ of a vertex's hat function, expanded about the hat's centroid.

    To first order, and to second as if the hat were flat; on a smooth surface that leaves an error of third order.

    With p the centroid, r = |p − x|, n and v the normal and a vertex of the face that y lies on, λ the hat function:
    w = L/r⁴ · (1 − 2 tr C/r² + 12 B/r⁴) − 4 Q/r⁶, where L = ∫ λ n·(v − x), C is the covariance of y under λ,
    B = (p − x)ᵀ C (p − x) and Q = ∫ λ n·(v − x) (y − p)·(p − x), zero in a flat hat. All are quadratic in x.
    """

    centres: torch.Tensor  # (V, 3)
    radii: torch.Tensor  # (V,): of a ball about the centroid that holds the faces around the vertex
    fluxes: torch.Tensor  # (V, 3): ∫ λ n
    tilts: torch.Tensor  # (V, 3, 3): ∫ λ n (y − p)ᵀ
    covariances: torch.Tensor  # (V, 3, 3): C
    polynomials: torch.Tensor  # (V, 4, 10): r², L, −4 Q − 2 tr C·L and 12 B in the monomials of `_monomials`

    @staticmethod
    def of(surface: Surface) -> HatMoments:
        vertices, faces, normals = surface.vertices, surface.faces, surface.normals
        corners = vertices[faces]
        total = corners.sum(1)
        squares = _outer(total, total) + corners.mT @ corners
        third = surface.double_areas[:, None] / 6
        tilt = _outer(normals, total)
        per_face = third * torch.cat([torch.ones_like(third), total, normals, squares.flatten(1), tilt.flatten(1)], 1)
        sums = vertices.new_zeros(len(vertices), per_face.shape[1])
        reach = vertices.new_zeros(len(vertices))
        for corner in range(3):
            sums.index_add_(0, faces[:, corner], per_face)
            sides = surface.squared_sides.roll(-corner, 1)[:, 1:]
            reach.scatter_reduce_(0, faces[:, corner], sides.amax(1).sqrt(), "amax")
        # Over a face with corners v, a, b and t = v + a + b, the hat of v has the mean (v + t)/4 and
        # the second moment (2vvᵀ + vtᵀ + tvᵀ + ttᵀ + aaᵀ + bbᵀ + vvᵀ)/20.
        mass, total, fluxes, squares, tilts = sums.split([1, 3, 3, 9, 9], 1)
        mass = mass.clamp_min(torch.finfo(torch.float64).tiny)
        total = total / mass
        centres = (vertices + total) / 4
        mixed = _outer(vertices, total)
        squares = squares.view(-1, 3, 3) / mass[..., None]
        covariances = (2 * _outer(vertices, vertices) + mixed + mixed.mT + squares) / 20 - _outer(centres, centres)
        tilts = tilts.view(-1, 3, 3) / 4 + _outer(fluxes, vertices / 4 - centres)
        traces = covariances.diagonal(dim1=1, dim2=2).sum(1, keepdim=True)
        eye = torch.eye(3, dtype=torch.float64, device=vertices.device).expand_as(tilts)
        linear = _affine(fluxes, vertices)
        polynomials = [
            _quadratic(eye, centres, centres),
            linear,
            -4 * _quadratic(tilts, vertices, centres) - 2 * traces * linear,
            12 * _quadratic(covariances, centres, centres),
        ]
        radii = reach + (centres - vertices).norm(dim=1)
        return HatMoments(centres, radii, fluxes, tilts, covariances, torch.stack(polynomials, 1))

    def near(self, points: torch.Tensor, ratio: float, hats: torch.Tensor | None = None) -> torch.Tensor:
        """Pairs (2, m) of one of the hats (all if not given) and a point within ratio radii, rounded up."""
        centre = points.mean(0)
        centres, radii = (each if hats is None else each[hats] for each in (self.centres, self.radii))
        centres, x = (centres - centre).float(), (points - centre).float()
        limits = (ratio * radii).square().float() + _ROUNDING * x.square().sum(1).amax()
        gap = centres - centres.clamp(x.amin(0), x.amax(0))
        candidates = (gap.square().sum(1) < limits).nonzero()[:, 0]
        centres, limits = centres[candidates], limits[candidates]
        # |c|² − 2 c·x + |x|² < limit
        products = torch.addmm(x.square().sum(1), centres, x.T, alpha=-2)
        cells = (products < (limits - centres.square().sum(1))[:, None]).flatten().nonzero()[:, 0]
        near = candidates[cells // len(x)]
        return torch.stack([near if hats is None else hats[near], cells % len(x)])

    def fill_weights(self, points: torch.Tensor, hats: torch.Tensor, weights: torch.Tensor) -> None:
        """Fill the weights (h, n) of some hats; those of hats near a point are unusable."""
        dtype, n_points = weights.dtype, len(points)
        coefficients = self.polynomials[hats].view(-1, 10)
        if dtype == torch.float64:
            monomials = _monomials(points)
        else:  # about a centre near the points, where single precision is enough
            centre = points.mean(0)
            coefficients = (coefficients @ _shift(centre)).to(dtype)
            monomials = _monomials(points - centre).to(dtype)
        if points.device.type == "cpu" and is_available():
            fill_hat_weights(coefficients.view(-1, 4, 10).numpy(), monomials.numpy(), weights.numpy())
            return
        tile = Tile.of(points.device)
        size = tile.hats * max(1, tile.points // max(n_points, 1))  # few points leave room for more hats
        buffer = torch.empty(4 * size, n_points, dtype=dtype, device=points.device)
        for part, out in zip(coefficients.split(4 * size), weights.split(size), strict=True):
            values = torch.mm(part, monomials, out=buffer[: len(part)])
            inverse, first, second, third = values.view(-1, 4, n_points).unbind(1)
            third.mul_(inverse.reciprocal_())
            torch.addcmul(second, third, first, out=third)
            torch.addcmul(first, third, inverse, out=third)
            torch.mul(third, inverse.square_(), out=out)

    def taylor_terms(self, centres: torch.Tensor, radii: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
        """What each hat adds (V, 19) to the sums of `ClusterMoments`, for a centre (V, 3) and a radius (V,) each."""
        shifts = ((self.centres - centres) / radii[:, None]).to(dtype)
        fluxes = (self.fluxes / radii[:, None] ** 3).to(dtype)
        tilts = (self.tilts / radii[:, None, None] ** 4).to(dtype)
        second = tilts + _outer(fluxes, shifts)
        spreads = (self.covariances / radii[:, None, None] ** 2).to(dtype) + _outer(shifts, shifts)
        third = _outer(2 * tilts.flatten(1), shifts).flatten(1) + _outer(fluxes, spreads.flatten(1)).flatten(1)
        kernels = [kernel.to(shifts) for kernel in _TAYLOR]
        return torch.cat([fluxes, second.flatten(1) @ kernels[0], third @ kernels[1]], 1)


@dataclass(frozen=True)
class Block:
    """Some points close together, and what they see as clusters and what hat by hat."""

    points: torch.Tensor  # (n,)
    clusters: torch.Tensor  # (c,)
    hats: torch.Tensor  # (h,)


@dataclass(frozen=True)
class HatTree:
    """Clusters of consecutive hats: of 32 each on the first level, of four clusters of the level before on the next."""

    n_hats: int
    axes: torch.Tensor  # (3, 3)
    sizes: list[int]  # hats in a cluster, for each level
    centres: list[torch.Tensor]  # (c, 3) for each level
    radii: list[torch.Tensor]  # (c,) for each level: of a ball about the centre that holds those of the hats

    @staticmethod
    def of(hats: HatMoments) -> HatTree:
        """Of hats in the order of `in_leaves`."""
        n_hats = len(hats.centres)
        sizes, centres, radii = [_LEAF], [], []
        while 16 * sizes[-1] < n_hats:
            sizes.append(4 * sizes[-1])
        for size in sizes:
            cluster = torch.arange(n_hats, device=hats.centres.device) // size
            counts = cluster.bincount()
            centre = hats.centres.new_zeros(len(counts), 3).index_add_(0, cluster, hats.centres) / counts[:, None]
            reach = (hats.centres - centre[cluster]).norm(dim=1) + hats.radii
            centres.append(centre)
            radii.append(reach.new_zeros(len(counts)).scatter_reduce_(0, cluster, reach, "amax"))
        return HatTree(n_hats, principal_axes(hats.centres), sizes, centres, radii)

    def blocks(self, points: torch.Tensor, size: int, ratio: float) -> Iterator[Block]:
        """Blocks of size points; a cluster is seen as one if all of a block's box is ratio radii or more away from it.

        The clusters of all levels are numbered through, level by level.
        """
        turned = points @ self.axes
        parts = spatial_order(turned, size).split(size)
        if len(points) == 0:
            return
        low = torch.stack([turned[part].amin(0) for part in parts])
        high = torch.stack([turned[part].amax(0) for part in parts])
        seen_clusters, seen_blocks, first = [], [], sum(map(len, self.radii))
        block, cluster = torch.cartesian_prod(*(torch.arange(len(each)) for each in (parts, self.radii[-1]))).T
        block, cluster = block.to(points.device), cluster.to(points.device)
        children = torch.arange(4, device=points.device)
        for level in reversed(range(len(self.sizes))):
            centre = (self.centres[level] @ self.axes)[cluster]
            gap = centre - centre.clamp(low[block], high[block])
            is_far = gap.square().sum(1) >= (ratio * self.radii[level][cluster]).square()
            first -= len(self.radii[level])
            seen_clusters.append(first + cluster[is_far])
            seen_blocks.append(block[is_far])
            cluster, block = cluster[~is_far], block[~is_far]
            if level:
                cluster = (4 * cluster[:, None] + children).flatten()
                exists = cluster < len(self.radii[level - 1])
                cluster, block = cluster[exists], block.repeat_interleave(4)[exists]
        clusters = _by_block(torch.cat(seen_clusters), torch.cat(seen_blocks), len(parts))
        leaves = _by_block(cluster, block, len(parts))
        within = torch.arange(_LEAF, device=points.device)
        for part, seen_as_one, opened in zip(parts, clusters, leaves, strict=True):
            hats = (_LEAF * opened[:, None] + within).flatten()
            yield Block(part, seen_as_one, hats[hats < self.n_hats])


def _by_block(values: torch.Tensor, block: torch.Tensor, n_blocks: int) -> tuple[torch.Tensor, ...]:
    return values[block.argsort(stable=True)].split(block.bincount(minlength=n_blocks).tolist())


def in_leaves(vertices: torch.Tensor) -> torch.Tensor:
    """The order (V,) of vertices (V, 3) that `HatTree` expects."""
    return spatial_order(vertices @ principal_axes(vertices), _LEAF)


def principal_axes(points: torch.Tensor) -> torch.Tensor:
    """The principal axes of points (n, 3), as columns (3, 3), towards the longer tails: cuts turn with the points."""
    axes = torch.linalg.eigh(torch.cov(points.T)).eigenvectors
    skewness = ((points - points.mean(0)) @ axes).pow(3).sum(0)
    return torch.where(skewness < 0, -axes, axes)


@dataclass(frozen=True)
class ClusterMoments:
    """Far rule for clusters. The kernel h/r⁴ of all hats of a cluster, expanded to second order about its centre.

    At a surface element n dS it is n·∇u(d + s), with d the vector from the point to the centre, s that from the centre
    to the element and u(d) = −1/(2|d|²). Its Taylor series in s is |e|² times a polynomial in e = R d/|d|², with R the
    cluster's radius. So Σ f w over the hats of the cluster is the product of |e|²·(e_i, e_i e_j, e_i e_j e_k), 19 terms
    that depend on the point, with 19 sums of f that do not.
    """

    centres: torch.Tensor  # (C, 3)
    radii: torch.Tensor  # (C,)
    sums: torch.Tensor  # (19 C, K)

    @staticmethod
    def of(tree: HatTree, hats: HatMoments, functions: torch.Tensor, team: Team = ALONE) -> ClusterMoments:
        """Of functions (V, K), given at the hats."""
        n_clusters = [len(each) for each in tree.radii]
        sums = functions.new_empty(sum(n_clusters), _N_TERMS, functions.shape[1])

        def fill_level(level: tuple[int, torch.Tensor, torch.Tensor, torch.Tensor]) -> None:
            size, centres, radii, out = level
            cluster = torch.arange(tree.n_hats, device=functions.device) // size
            terms = hats.taylor_terms(centres[cluster], radii[cluster], functions.dtype)
            n_full = tree.n_hats // size
            left, right = (each[: n_full * size].unflatten(0, (n_full, size)) for each in (terms, functions))
            torch.bmm(left.mT, right, out=out[:n_full])
            if n_full < len(out):
                torch.mm(terms[n_full * size :].T, functions[n_full * size :], out=out[-1])

        team.each(fill_level, list(zip(tree.sizes, tree.centres, tree.radii, sums.split(n_clusters), strict=True)))
        return ClusterMoments(torch.cat(tree.centres), torch.cat(tree.radii), sums.flatten(0, 1))

    def fill_terms(self, points: torch.Tensor, clusters: torch.Tensor, out: torch.Tensor) -> None:
        """Fill out (19 c, n) with the terms of the clusters, the first of all, then the second of all, and so on."""
        centre = points.mean(0)
        to_centre, x = ((each - centre).T.to(out.dtype) for each in (self.centres[clusters], points))
        radii = self.radii[clusters, None].to(out.dtype)
        e = to_centre[:, :, None] - x[:, None]
        inverse = radii / e.square().sum(0)
        e *= inverse
        out = out.view(_N_TERMS, len(clusters), len(points))
        torch.mul(e, inverse.mul_(radii), out=out[:3])
        # In the order of `combinations_with_replacement`: x times all of the degree below, y times those without x, …
        for axis, lower, higher in _PRODUCTS:
            torch.mul(out[lower], e[axis], out=out[higher])

    def rows(self, clusters: torch.Tensor) -> torch.Tensor:
        """Which of the sums belong to some clusters (19 c,), in the order of `fill_terms`."""
        return (torch.arange(_N_TERMS, device=clusters.device)[:, None] + _N_TERMS * clusters).flatten()


def _taylor_matrix(degree: int) -> torch.Tensor:
    """(3ᵈ, m): from moments M_ij… to the m coefficients of M_ij ∂_ij u, or of ½ M_ijk ∂_ijk u, for degree 2 or 3."""
    monomials = {axes: n for n, axes in enumerate(combinations_with_replacement(range(3), degree))}
    power, trace = {2: (-4, 1), 3: (12, -2)}[degree]
    matrix = torch.zeros(3**degree, len(monomials), dtype=torch.float64)
    for row, axes in enumerate(product(range(3), repeat=degree)):
        matrix[row, monomials[tuple(sorted(axes))]] += power
        for i, j in combinations(range(degree), 2):
            if axes[i] == axes[j]:
                others = axes[:i] + axes[i + 1 : j] + axes[j + 1 :]
                for axis in range(3):
                    matrix[row, monomials[tuple(sorted((*others, axis, axis)))]] += trace
    return matrix


# Which terms, times which component of e, are which terms of the next degree.
_PRODUCTS = [
    (0, slice(0, 3), slice(3, 6)), (1, slice(1, 3), slice(6, 8)), (2, slice(2, 3), slice(8, 9)),
    (0, slice(3, 9), slice(9, 15)), (1, slice(6, 9), slice(15, 18)), (2, slice(8, 9), slice(18, 19)),
]  # fmt: skip
_TAYLOR = (_taylor_matrix(2), _taylor_matrix(3))


def _outer(left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
    return left[:, :, None] * right[:, None, :]


def _affine(gradient: torch.Tensor, origin: torch.Tensor) -> torch.Tensor:
    """Coefficients (V, 10) of gradient · (origin − x)."""
    return torch.cat([(gradient * origin).sum(1, keepdim=True), -gradient, gradient.new_zeros(len(gradient), 6)], 1)


def _quadratic(form: torch.Tensor, left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
    """Coefficients (V, 10) of (left − x)ᵀ form (right − x)."""
    to_right = (form @ right[:, :, None])[..., 0]
    to_left = (left[:, None] @ form)[:, 0]
    constant = (left * to_right).sum(1, keepdim=True)
    mixed = (form + form.mT)[:, (0, 0, 1), (1, 2, 2)]
    return torch.cat([constant, -to_right - to_left, form.diagonal(dim1=1, dim2=2), mixed], 1)


def _monomials(points: torch.Tensor) -> torch.Tensor:
    """1, x, y, z, x², y², z², xy, xz, yz of points (n, 3): (10, n)."""
    x, y, z = points.T
    return torch.stack([torch.ones_like(x), x, y, z, x * x, y * y, z * z, x * y, x * z, y * z])


def _shift(centre: torch.Tensor) -> torch.Tensor:
    """The matrix (10, 10) that turns a polynomial's coefficients in x into those in x − centre."""
    a, b, c = centre.tolist()
    shift = torch.eye(10, dtype=torch.float64)
    shift[:, 0] = _monomials(centre.cpu()[None])[:, 0]
    shift[4, 1], shift[5, 2], shift[6, 3] = 2 * a, 2 * b, 2 * c
    shift[7, 1], shift[7, 2], shift[8, 1], shift[8, 3], shift[9, 2], shift[9, 3] = b, a, c, a, c, b
    return shift.to(centre.device)
