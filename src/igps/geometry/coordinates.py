"""Mean value coordinates of a triangle mesh, the extension of surface functions into the volume, winding numbers.

Mean value interpolation (Ju, Schaefer, Warren 2005) is a ratio of two surface integrals,
``f̂(x) = ∫ f·h/r⁴ dS ⁄ ∫ h/r⁴ dS``, with ``r`` the distance from ``x`` to the surface point and ``h`` that from ``x`` to
its tangent plane (positive on the inner side). For a piecewise linear ``f`` it is ``Σ_v w_v f_v ⁄ Σ_v w_v``. All
routines here compute the unnormalised ``w_v`` on this one scale, by one of three rules:

* dense exact: the closed form for all pairs of face and point, each vertex, edge and face of a mesh visited once;
* dense far: the first moments of a vertex's hat function, a few matrix products;
* listed exact: the closed form, arranged to stay accurate on and near a face, for a list of pairs of face and point.

A dense rule gives all weights of a block of points; those of the vertices near a point are then replaced by the listed
rule. Coordinates are scaled to the mesh: its bounding box gets a half-diagonal of 1.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

__all__ = ["extend", "mean_value_coordinates", "winding_number"]

_BLOCK_BYTES = 256 * 2**20  # of dense weights at a time
_ROOT_EPS = 2.0**-26  # flatter faces (height / length) are left out
_ON_SURFACE = 2e-9  # half-diagonals: closer points take the surface value, and coplanar faces count as exactly so
_EXACT_RATIO = 1.1  # opening ratio that keeps the dense exact rule away from points near an edge, where it cancels
_FAR_ERROR = 3.5e-3  # of the far rule at opening ratio 1; it falls with the third power (largest of 15 models measured)
_FEW_VERTICES = 2000  # meshes so coarse were up to three times worse, and the closed form takes no time there
_FLOAT32_ACCURACY = 1e-4  # from here on, single precision is enough for the far rule and the product
_NEAR_SHARE = 0.07  # of hats near a point, above which the dense exact rule is the faster one
_NEAR_PAIRS = 2**24  # the most that are listed: 128 MiB


def mean_value_coordinates(
    vertices: NDArray[np.floating],
    faces: NDArray[np.integer],
    points: NDArray[np.floating],
    *,
    device: torch.device | str = "cpu",
) -> NDArray[np.float64]:
    """Dense mean value coordinates (P, V) of points (P, 3); rows sum to 1 (Ju, Schaefer, Warren 2005, section 3).

    Vertices (V, 3) and points share one unit; faces (F, 3) are oriented alike, either way. A point on the surface gets
    the barycentric coordinates in its triangle. Meant for few points: the result holds P·V numbers.

    Raises:
        ValueError: a shape, an index or a value of an argument is invalid, or the weights of a point sum to zero.
    """
    surface, x = _prepare(vertices, faces, points, device)
    out = np.empty((len(x), len(surface.vertices)))
    for rows, weights in _weight_blocks(surface, x, None, torch.float64):
        out[rows] = _normalised(weights, weights.sum(0)).T.cpu().numpy()
    return out


def extend(
    vertices: NDArray[np.floating],
    faces: NDArray[np.integer],
    functions: NDArray[np.floating],
    points: NDArray[np.floating],
    *,
    accuracy: float | None = None,
    device: torch.device | str = "cpu",
    dtype: torch.dtype | None = None,
) -> NDArray[np.float64]:
    """Extend surface functions (V, K) to points (P, 3) by mean value interpolation (Ju, Schaefer, Warren 2005): (P, K).

    Vertices (V, 3) and points share one unit; faces (F, 3) are oriented alike, either way. ``accuracy`` None evaluates
    the closed form for all pairs. Otherwise it is the relative error below which 99 % of the interior distances stay
    (Euclidean distances of rows of the result, for points inside a closed surface), and far faces are integrated
    approximately. ``dtype`` is that of the dense weights and of the product with the functions; None takes the cheapest
    that keeps the accuracy. Memory beside arguments and result: at most 256 MiB of weights at a time.

    Raises:
        ValueError: a shape, an index or a value of an argument is invalid, or the weights of a point sum to zero.
    """
    if accuracy is not None and not 0 < accuracy < 1:
        raise ValueError(f"accuracy: expected None (exact) or a relative error in (0, 1), got {accuracy}")
    if dtype is None:
        dtype = torch.float32 if accuracy is not None and accuracy >= _FLOAT32_ACCURACY else torch.float64
    if dtype not in (torch.float32, torch.float64):
        raise ValueError(f"dtype: expected torch.float32 or torch.float64, got {dtype}")
    surface, x = _prepare(vertices, faces, points, device)
    values = np.asarray(functions)
    if values.ndim != 2 or len(values) != len(surface.vertices):
        raise ValueError(
            f"functions: expected shape (V, K) with V = {len(surface.vertices)} vertices, got {values.shape}; "
            "give one row per vertex"
        )
    if not np.isfinite(values).all():
        raise ValueError("functions: expected finite values, got NaN or infinity")
    columns = torch.as_tensor(np.column_stack([values, np.ones(len(values))]), dtype=dtype, device=device)
    ratio = None
    if accuracy is not None and len(values) >= _FEW_VERTICES:
        ratio = max(_EXACT_RATIO, (_FAR_ERROR / accuracy) ** (1 / 3))
    out = np.empty((len(x), values.shape[1]))
    for rows, weights in _weight_blocks(surface, x, ratio, dtype):
        product = weights.T @ columns  # the last column sums the weights
        out[rows] = _normalised(product[:, :-1], product[:, -1:]).cpu().numpy()
    return out


def winding_number(
    vertices: NDArray[np.floating],
    faces: NDArray[np.integer],
    points: NDArray[np.floating],
    *,
    device: torch.device | str = "cpu",
) -> NDArray[np.float64]:
    """Winding number (P,) of a mesh about points (P, 3): the solid angles of its faces over 4π.

    1 inside and 0 outside a closed, outward oriented surface; fractions for an open one. Solid angles by
    Van Oosterom and Strackee 1983, equation 8. On the surface itself the value is one of those beside it, or between.

    Raises:
        ValueError: a shape, an index or a value of an argument is invalid.
    """
    surface, x = _prepare(vertices, faces, points, device)
    tile = _Tile.of(x.device)
    blocks = _face_blocks(surface, tile.faces)
    out = [x.new_zeros(0)]
    for part in x.split(tile.points):
        out.append(sum((block.solid_angles(part) for block in blocks), start=part.new_zeros(len(part))))
    return torch.cat(out).cpu().numpy() / (4 * np.pi)


@dataclass(frozen=True)
class _Tile:
    """How many faces and points are worked on at a time: on a CPU a tile stays in the second-level cache."""

    faces: int
    points: int
    hats: int
    pairs: int

    @staticmethod
    def of(device: torch.device) -> _Tile:
        return _Tile(1024, 128, 256, 2**13) if device.type == "cpu" else _Tile(2**12, 2**10, 2**11, 2**17)


@dataclass(frozen=True)
class _Surface:
    """A scaled mesh without its flat faces. Side l of a face is opposite to its corner l and runs from l+1 to l+2."""

    vertices: torch.Tensor  # (V, 3)
    faces: torch.Tensor  # (F, 3)
    normals: torch.Tensor  # (F, 3), unit
    double_areas: torch.Tensor  # (F,)
    inward: torch.Tensor  # (F, 3, 3): in the face's plane, across side l, as long as it
    squared_sides: torch.Tensor  # (F, 3)

    @staticmethod
    def of(vertices: torch.Tensor, faces: torch.Tensor) -> _Surface:
        corners = vertices[faces]
        sides = corners.roll(-2, dims=1) - corners.roll(-1, dims=1)
        area_vectors = torch.linalg.cross(sides[:, 0], sides[:, 1])
        double_areas = area_vectors.norm(dim=1)
        squared_sides = sides.square().sum(-1)
        keep = double_areas > _ROOT_EPS * squared_sides.amax(1)
        normals = area_vectors[keep] / double_areas[keep, None]
        inward = torch.linalg.cross(normals[:, None].expand(-1, 3, -1), sides[keep])
        return _Surface(vertices, faces[keep], normals, double_areas[keep], inward, squared_sides[keep])


def _prepare(
    vertices: NDArray[np.floating], faces: NDArray[np.integer], points: NDArray[np.floating], device: torch.device | str
) -> tuple[_Surface, torch.Tensor]:
    """Check the arguments; the scaled surface and the points on its scale."""
    vertices, faces, points = np.asarray(vertices, np.float64), np.asarray(faces), np.asarray(points, np.float64)
    for name, array in (("vertices", vertices), ("faces", faces), ("points", points)):
        if array.ndim != 2 or array.shape[1] != 3:
            raise ValueError(f"{name}: expected shape (n, 3), got {array.shape}")
    for name, array in (("vertices", vertices), ("points", points)):
        if not np.isfinite(array).all():
            raise ValueError(f"{name}: expected finite coordinates, got NaN or infinity; remove those rows")
    if not np.issubdtype(faces.dtype, np.integer):
        raise ValueError(f"faces: expected integer vertex indices, got {faces.dtype}")
    if len(faces) == 0 or faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(f"faces: expected at least one face, with indices in [0, {len(vertices)}), got another")
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    centre, scale = (low + high) / 2, np.linalg.norm(high - low) / 2
    if not scale > 0:
        raise ValueError("vertices: expected distinct vertices, got one place for all; check the mesh")
    scaled = torch.as_tensor((vertices - centre) / scale, device=device)
    surface = _Surface.of(scaled, torch.as_tensor(faces.astype(np.int64), device=device))
    if len(surface.faces) == 0:
        raise ValueError("faces: expected at least one face with an area, got flat ones only; check the mesh")
    return surface, torch.as_tensor((points - centre) / scale, device=device)


def _tree(points: torch.Tensor) -> cKDTree:
    """A tree whose `indices` order the points so that neighbours in space are neighbours in the list."""
    return cKDTree(points.cpu().numpy(), leafsize=16, compact_nodes=False, balanced_tree=False)


def _weight_blocks(
    surface: _Surface, points: torch.Tensor, ratio: float | None, dtype: torch.dtype
) -> Iterator[tuple[NDArray[np.int64], torch.Tensor]]:
    """Weights (V, n) of n points at a time, up to a factor per point, with the indices of those points."""
    if len(points) == 0:
        return
    tile = _Tile.of(points.device)
    n_vertices = len(surface.vertices)
    size = max(1, min(2 * tile.points, len(points), _BLOCK_BYTES // (n_vertices * dtype.itemsize)))
    hats = _HatMoments.of(surface)
    listed = _ListedRule.of(surface)
    tree = _tree(points)
    points = points[torch.as_tensor(tree.indices, device=points.device)]
    blocks = points.split(size)
    near = [] if ratio is None else hats.near(tree, blocks, ratio, dtype)
    face_blocks: list[_FaceBlock] = []
    if not near:
        near = hats.near(tree, blocks, _EXACT_RATIO, None)
        face_blocks = _face_blocks(surface, tile.faces)
    memory = torch.empty(n_vertices * size, dtype=dtype, device=points.device)
    mask_memory = torch.empty(n_vertices * size, dtype=torch.bool, device=points.device)
    for index, x in enumerate(blocks):
        weights = memory[: n_vertices * len(x)].view(n_vertices, -1)
        if face_blocks:
            for part, out in zip(x.split(tile.points), weights.split(tile.points, 1), strict=True):
                total = torch.zeros(n_vertices, len(part), dtype=torch.float64, device=x.device)
                for block in face_blocks:
                    block.add_weights(part, total)
                out.copy_(total)
        else:
            hats.far_weights(x, weights)
        listed.replace(x, near[index].long(), mask_memory[: n_vertices * len(x)], weights)
        yield tree.indices[index * size : index * size + len(x)], weights


def _normalised(values: torch.Tensor, totals: torch.Tensor) -> torch.Tensor:
    if not bool((totals.isfinite() & (totals != 0)).all()):
        raise ValueError("points: expected mean value weights with a sum, got a sum of zero or none; close the mesh")
    return values / totals


@dataclass(frozen=True)
class _HatMoments:
    """Far rule. The kernel h/r⁴ of a vertex's hat function, expanded about the hat's centroid.

    To first order, and to second as if the hat were flat; on a smooth surface that leaves an error of third order.

    With p the centroid, r = |p − x|, n and v the normal and a vertex of the face that y lies on, λ the hat function:
    w = L/r⁴ · (1 − 2 tr C/r² + 12 B/r⁴) − 4 Q/r⁶, where L = ∫ λ n·(v − x), C is the covariance of y under λ,
    B = (p − x)ᵀ C (p − x) and Q = ∫ λ n·(v − x) (y − p)·(p − x), zero in a flat hat. All are quadratic in x.
    """

    centres: torch.Tensor  # (V, 3)
    radii: torch.Tensor  # (V,): of a ball about the centroid that holds the faces around the vertex
    polynomials: torch.Tensor  # (V, 4, 10): r², L, −4 Q − 2 tr C·L and 12 B in the monomials of `_monomials`

    @staticmethod
    def of(surface: _Surface) -> _HatMoments:
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
        mass, total, flux, squares, tilt = sums.split([1, 3, 3, 9, 9], 1)
        mass = mass.clamp_min(torch.finfo(torch.float64).tiny)
        total = total / mass
        centres = (vertices + total) / 4
        mixed = _outer(vertices, total)
        squares = squares.view(-1, 3, 3) / mass[..., None]
        covariances = (2 * _outer(vertices, vertices) + mixed + mixed.mT + squares) / 20 - _outer(centres, centres)
        tilt = tilt.view(-1, 3, 3) / 4 + _outer(flux, vertices / 4 - centres)
        traces = covariances.diagonal(dim1=1, dim2=2).sum(1, keepdim=True)
        eye = torch.eye(3, dtype=torch.float64, device=vertices.device).expand_as(tilt)
        linear = _affine(flux, vertices)
        polynomials = [
            _quadratic(eye, centres, centres),
            linear,
            -4 * _quadratic(tilt, vertices, centres) - 2 * traces * linear,
            12 * _quadratic(covariances, centres, centres),
        ]
        radii = reach + (centres - vertices).norm(dim=1)
        return _HatMoments(centres, radii, torch.stack(polynomials, 1))

    def near(
        self, tree: cKDTree, blocks: Sequence[torch.Tensor], ratio: float, dtype: torch.dtype | None
    ) -> list[torch.Tensor]:
        """Per block of points, in the order of the tree: the pairs (2, m) of a hat and a point within ratio radii.

        With dtype, that of the far weights, hats that its rounding would spoil are near too; and the result is empty
        where so many are near that the dense exact rule is the cheaper one.
        """
        n_points, size = tree.n, len(blocks[0])
        limits = (ratio * self.radii).square()
        if dtype is not None:
            spread = torch.stack([(block - block.mean(0)).square().sum(1).amax() for block in blocks]).amax()
            limits = limits + 128 * torch.finfo(dtype).eps * spread
        centres, reach = self.centres.cpu().numpy(), limits.sqrt().cpu().numpy()
        most = np.inf if dtype is None else min(_NEAR_PAIRS, _NEAR_SHARE * n_points * len(centres))
        position = np.empty(n_points, np.int32)
        position[tree.indices] = np.arange(n_points, dtype=np.int32)
        hats, points, n_found = [], [], 0
        for start in range(0, len(centres), 1024):
            part = slice(start, start + 1024)
            lists = tree.query_ball_point(centres[part], reach[part], return_sorted=False)
            counts = np.fromiter(map(len, lists), np.int32, len(lists))
            hats.append(np.repeat(np.arange(start, start + len(counts), dtype=np.int32), counts))
            points.append(position[np.fromiter(chain.from_iterable(lists), np.int32, counts.sum())])
            n_found += len(points[-1])
            if n_found > most:
                return []
        pairs = np.stack([np.concatenate(hats), np.concatenate(points)])
        block = (pairs[1] // size).astype(np.min_scalar_type(len(blocks)))
        pairs = pairs[:, np.argsort(block, kind="stable")]
        bounds = np.cumsum(np.bincount(block, minlength=len(blocks)))[:-1]
        return [
            torch.as_tensor(part - np.array([[0], [index * size]], np.int32), device=self.centres.device)
            for index, part in enumerate(np.split(pairs, bounds, axis=1))
        ]

    def far_weights(self, points: torch.Tensor, weights: torch.Tensor) -> None:
        """Fill weights (V, n); those of hats near a point are unusable."""
        dtype, n_points = weights.dtype, len(points)
        centre = points.mean(0)
        coefficients = (self.polynomials.view(-1, 10) @ _shift(centre)).to(dtype)
        monomials = _monomials(points - centre).to(dtype)
        size = _Tile.of(points.device).hats
        buffer = torch.empty(4 * size, n_points, dtype=dtype, device=points.device)
        for part, out in zip(coefficients.split(4 * size), weights.split(size), strict=True):
            values = torch.mm(part, monomials, out=buffer[: len(part)])
            inverse, first, second, third = values.view(-1, 4, n_points).unbind(1)
            third.mul_(inverse.reciprocal_())
            torch.addcmul(second, third, first, out=third)
            torch.addcmul(first, third, inverse, out=third)
            torch.mul(third, inverse.square_(), out=out)


def _squared_distances(one: torch.Tensor, two: torch.Tensor) -> torch.Tensor:
    """(n, m) between points (n, 3) and (m, 3), from differences: exact to rounding at any distance."""
    squared = (one[:, 0, None] - two[:, 0]).square_()
    for axis in (1, 2):
        difference = one[:, axis, None] - two[:, axis]
        squared.addcmul_(difference, difference)
    return squared


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


@dataclass(frozen=True)
class _ListedRule:
    """Exact weights of single (face, point) pairs, accurate up to the surface."""

    faces: torch.Tensor  # (F, 3)
    table: torch.Tensor  # (F, 22): corners, normal, two inward vectors, squared sides, double area
    first: torch.Tensor  # (V + 1,): where the faces of a vertex begin in `around`
    around: torch.Tensor  # (3F,)

    @staticmethod
    def of(surface: _Surface) -> _ListedRule:
        faces = surface.faces
        corners, inward = surface.vertices[faces].flatten(1), surface.inward[:, :2].flatten(1)
        parts = [corners, surface.normals, inward, surface.squared_sides, surface.double_areas[:, None]]
        around = faces.flatten().argsort(stable=True) // 3
        counts = faces.flatten().bincount(minlength=len(surface.vertices))
        first = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
        return _ListedRule(faces, torch.cat(parts, 1), first, around)

    def replace(self, points: torch.Tensor, near: torch.Tensor, mask: torch.Tensor, weights: torch.Tensor) -> None:
        """Replace the weights (V, n) of the pairs near (2, m) of a hat and a point; mask (V n,) is working memory.

        Points on the surface get only their triangle's.
        """
        n_points, flat_weights = len(points), weights.view(-1)
        cells = near[0] * n_points + near[1]
        flat_weights.index_fill_(0, cells, 0)
        mask.zero_().index_fill_(0, cells, True)
        touching: list[tuple[torch.Tensor, ...]] = []
        for hat, column in near.split(_Tile.of(points.device).pairs, 1):
            counts = self.first[hat + 1] - self.first[hat]
            source = torch.repeat_interleave(counts)
            offset = torch.arange(len(source), device=hat.device) - (counts.cumsum(0) - counts).index_select(0, source)
            hat, column = hat.index_select(0, source), column.index_select(0, source)
            face = self.around.index_select(0, self.first.index_select(0, hat) + offset)
            corner = self.faces.index_select(0, face).T
            cells = corner * n_points + column
            is_near = mask.index_select(0, cells.flatten()).view(3, -1)
            # A face counts once: with its first near corner.
            keep = (is_near & (corner < hat)).any(0).logical_not_().nonzero()[:, 0]
            face, column = face.index_select(0, keep), column.index_select(0, keep)
            values, barycentric, on_face = self.weights(face, points.index_select(0, column).T.contiguous())
            values.masked_fill_(~is_near.index_select(1, keep), 0)
            flat_weights.index_add_(0, cells.index_select(1, keep).flatten(), values.flatten().to(weights.dtype))
            touching.append((column[on_face], self.faces[face[on_face]], barycentric.T[on_face]))
        if touching:
            column, corner, values = (torch.cat(parts) for parts in zip(*touching, strict=True))
            first = np.unique(column.cpu().numpy(), return_index=True)[1]
            chosen = torch.as_tensor(first, device=column.device)
            weights[:, column[chosen]] = 0
            weights[corner[chosen], column[chosen, None]] = values[chosen].to(weights.dtype)

    def weights(self, faces: torch.Tensor, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """For faces (n,) and points (3, n): weights and barycentric coordinates (3, n), and which lie on their face.

        With λ the barycentric coordinates of the projection of x, h its distance to the plane, e_l the sides, N_l the
        product of the vectors from x to the ends of side l and θ_l the angle between them, the published
        N_i·m / (N_i·v_i) becomes ½ [λ_i s/h + h Σ_l g_l e_l·e_i / |n|²] |n|, with g_l = θ_l/|N_l| and s = Σ_l g_l λ_l,
        because N_l = λ_l n + h n̂×e_l. The length of N_l taken from that too makes all terms agree near side l.
        """
        table = self.table.index_select(0, faces).T.contiguous()
        a, b, c = (table[3 * i : 3 * i + 3] - points for i in range(3))
        squared_sides, double_area = table[18:21], table[21]
        h = (table[9:12] * a).sum(0)
        areas = torch.empty_like(squared_sides)  # of the projection with each side, doubled: λ |n|
        torch.sum(table[12:15] * b, 0, out=areas[0]).neg_()
        torch.sum(table[15:18] * c, 0, out=areas[1]).neg_()
        torch.sub(double_area, areas[0], out=areas[2]).sub_(areas[1])
        lengths = areas.square().addcmul_(squared_sides, h.square()).sqrt_().clamp_min_(1e-150)
        cosines = torch.stack([(b * c).sum(0), (c * a).sum(0), (a * b).sum(0)])
        g = torch.atan2(lengths, cosines).div_(lengths)
        s = (g * areas).sum(0)
        # In the plane of a face but outside it s vanishes like h², the weight like h: what is left is rounding.
        outside = (h.abs() < _ON_SURFACE) & (s < 1e-2)
        first = torch.where(outside, 0, s / h) * areas
        products = squared_sides - squared_sides.sum(0) / 2  # of the two other sides
        second = g * squared_sides
        second.addcmul_(g.roll(1, 0), products.roll(2, 0)).addcmul_(g.roll(2, 0), products.roll(1, 0))
        weights = second.mul_(h).add_(first).div_(2 * double_area)
        on_face = (h.abs() <= _ON_SURFACE) & (areas >= -_ON_SURFACE * squared_sides.sqrt()).all(0)
        barycentric = areas.clamp_min(0)
        return weights, barycentric / barycentric.sum(0), on_face


@dataclass(frozen=True)
class _FaceBlock:
    """Faces that lie close together, with the vertices and edges they use, numbered within the block."""

    vertex_ids: torch.Tensor  # (v,) in the mesh
    vertices: torch.Tensor  # (v, 3)
    edges: torch.Tensor  # (2, e)
    squared_edges: torch.Tensor  # (e, 1)
    faces: torch.Tensor  # (3, f)
    face_edges: torch.Tensor  # (3, f)
    gradients: torch.Tensor  # (3f, 3): h, λ₁|n| and λ₂|n| as gradient · (origin − x)
    origins: torch.Tensor  # (3f, 3)
    double_areas: torch.Tensor  # (f, 1)
    gather: torch.Tensor  # (v, 5f), sparse: from the quantities of the faces to the weights of the vertices

    @staticmethod
    def of(surface: _Surface, chosen: torch.Tensor) -> _FaceBlock:
        vertex_ids, local = surface.faces[chosen].unique(return_inverse=True)
        n_vertices = len(vertex_ids)
        ends = torch.stack([local.roll(-1, 1), local.roll(-2, 1)], -1).sort(-1).values
        keys, face_edges = (ends[..., 0] * n_vertices + ends[..., 1]).unique(return_inverse=True)
        edges = torch.stack([keys // n_vertices, keys % n_vertices])
        vertices = surface.vertices[vertex_ids]
        squared_edges = (vertices[edges[0]] - vertices[edges[1]]).square().sum(1, keepdim=True)
        gradients = torch.cat([surface.normals[chosen], -surface.inward[chosen, 0], -surface.inward[chosen, 1]])
        origins = vertices[local].transpose(0, 1).flatten(0, 1)  # h is 0 at corner 0, λ₁ at corner 1, λ₂ at corner 2
        double_areas = surface.double_areas[chosen]
        gather = _gather_matrix(local, surface.squared_sides[chosen], double_areas, n_vertices)
        return _FaceBlock(
            vertex_ids=vertex_ids,
            vertices=vertices,
            edges=edges,
            squared_edges=squared_edges,
            faces=local.T.contiguous(),
            face_edges=face_edges.T.contiguous(),
            gradients=gradients,
            origins=origins,
            double_areas=double_areas[:, None],
            gather=gather,
        )

    def _affine(self, points: torch.Tensor, n_rows: int) -> torch.Tensor:
        """The first rows of gradient · (origin − x), taken about the centre of the points to keep rounding small."""
        centre = points.mean(0)
        gradients = self.gradients[:n_rows]
        offsets = (gradients * (self.origins[:n_rows] - centre)).sum(1, keepdim=True)
        local = torch.cat([centre - points, torch.ones_like(points[:, :1])], 1)
        return torch.cat([gradients, offsets], 1) @ local.T

    def add_weights(self, points: torch.Tensor, weights: torch.Tensor) -> None:
        """Add the weights of these faces to weights (V, n). Where a point nearly touches an edge they are unusable.

        The formula of `_ListedRule.weights`, with θ and |N| of an edge from its length and the distances of its ends:
        tan² θ/2 = (l² − (r − r')²) / ((r + r')² − l²), so that g = 4 A(tan² θ/2) / ((r + r')² − l²), A(t²) = atan(t)/t.
        """
        n_faces = self.faces.shape[1]
        distances = _squared_distances(self.vertices, points).sqrt_()
        one, two = (distances.index_select(0, ends) for ends in self.edges)
        total = one + two
        total = torch.addcmul(-self.squared_edges, total, total, out=total)
        tangent = one.sub_(two)
        tangent = torch.addcmul(self.squared_edges, tangent, tangent, value=-1, out=tangent)
        tangent.div_(total).clamp_min_(1e-30).sqrt_()
        edge_g = torch.atan(tangent, out=two).div_(tangent.mul_(total))  # a quarter of g; the matrix has the 4

        affine = self._affine(points, 3 * n_faces)
        h, first, second = affine[:n_faces], affine[n_faces : 2 * n_faces], affine[2 * n_faces :]
        h = torch.nn.functional.hardshrink(h, _ON_SURFACE)  # coplanar points: no weight
        g = edge_g.index_select(0, self.face_edges[2])
        rows = affine.new_empty(5 * n_faces, len(points))
        first_out, second_out, ratio, first_h, second_h = rows.view(5, n_faces, -1).unbind(0)
        torch.index_select(edge_g, 0, self.face_edges[0], out=first_h).sub_(g)
        torch.index_select(edge_g, 0, self.face_edges[1], out=second_h).sub_(g)
        torch.mul(g, self.double_areas, out=ratio).addcmul_(first_h, first).addcmul_(second_h, second)
        torch.nan_to_num_(ratio.div_(h), nan=0.0, posinf=0.0, neginf=0.0)
        torch.mul(ratio, first, out=first_out)
        torch.mul(ratio, second, out=second_out)
        first_h.mul_(h)
        second_h.mul_(h)
        weights.index_add_(0, self.vertex_ids, (self.gather @ rows).to(weights.dtype))

    def solid_angles(self, points: torch.Tensor) -> torch.Tensor:
        """Sum (n,) of the solid angles of these faces, positive from the inside."""
        distances = _squared_distances(self.vertices, points).sqrt_()
        one, two = (distances.index_select(0, ends) for ends in self.edges)
        cosines = one.square_().addcmul_(two, two).sub_(self.squared_edges).mul_(0.5)
        corners = [distances.index_select(0, corner) for corner in self.faces]
        denominator = corners[0] * corners[1] * corners[2]
        for corner, index in zip(corners, self.face_edges, strict=True):
            denominator.addcmul_(corner, cosines.index_select(0, index))
        volume = self._affine(points, self.faces.shape[1]).mul_(self.double_areas)
        return torch.atan2(volume, denominator, out=volume).sum(0).mul_(2)


def _face_blocks(surface: _Surface, size: int) -> list[_FaceBlock]:
    order = torch.as_tensor(_tree(surface.vertices[surface.faces].mean(1)).indices, device=surface.faces.device)
    return [_FaceBlock.of(surface, chosen) for chosen in order.split(size)]


def _gather_matrix(
    faces: torch.Tensor, squared_sides: torch.Tensor, double_areas: torch.Tensor, n_vertices: int
) -> torch.Tensor:
    """Sparse (V, 5F): weights from s/h·λ₁|n|, s/h·λ₂|n|, s/h, h(g₁−g₃), h(g₂−g₃) of each face, with g/4 for g."""
    n_faces = len(faces)
    scale = 4 / (2 * double_areas)
    products = squared_sides - squared_sides.sum(1, keepdim=True) / 2  # of the two other sides
    column = torch.arange(n_faces, device=faces.device)
    entries = [
        (0, 0, scale), (1, 1, scale), (2, 0, -scale), (2, 1, -scale), (2, 2, scale * double_areas),
        (0, 3, scale * squared_sides[:, 0]), (1, 3, scale * products[:, 2]), (2, 3, scale * products[:, 1]),
        (0, 4, scale * products[:, 2]), (1, 4, scale * squared_sides[:, 1]), (2, 4, scale * products[:, 0]),
    ]  # fmt: skip
    indices = torch.stack(
        [
            torch.cat([faces[:, corner] for corner, _, _ in entries]),
            torch.cat([quantity * n_faces + column for _, quantity, _ in entries]),
        ]
    )
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sparse", category=UserWarning)  # beta, says torch; tested here
        values = torch.cat([value for _, _, value in entries])
        coo = torch.sparse_coo_tensor(indices, values, (n_vertices, 5 * n_faces), check_invariants=True)
        return coo.to_sparse_csr()
