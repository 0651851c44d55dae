"""How a surface looks to the mean value weights: face by face near it, by hats and clusters of hats from afar.

The weight of a vertex at a point x is ∫ λ h/r⁴ dS over its hat function λ, with r the distance from x to a surface
point y and h that to its tangent plane. From afar the kernel is expanded in a Taylor series:

* of a hat about its centroid p, to first order, and to second as if the hat were flat. With n and v the normal and a
  vertex of the face that y lies on, C the covariance of y under λ and r = |p − x|, w = ((B L/r² + S)/r² + L)/r⁴, where
  L = ∫ λ n·(v − x), B = 12 (p − x)ᵀ C (p − x), S = −4 Q − 2 tr C L, and Q = ∫ λ n·(v − x) (y − p)·(p − x), which is
  zero in a flat hat. On a smooth surface that leaves an error of third order in radius over distance;
* of a cluster about its centre to second order. At an element n dS the kernel is n·∇u(d + s), with d the vector from
  the point to the centre, s that from the centre to the element and u(d) = −1/(2|d|²). Its series in s is |e|² times a
  polynomial in e = R d/|d|², with R the cluster's radius. So Σ f w over the hats of the cluster is the product of
  |e|²·(e_i, e_i e_j, e_i e_j e_k), 19 terms that depend on the point, with 19 sums of f that do not.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from igps._arrays import Floats, Integers
from igps._threads import ALONE, Team
from igps.mesh.surface import has_area
from igps.signature._weight_loops import fill_cluster_terms, fill_hats, replace_near, seen_from
from igps.signature.ordering import principal_axes, spatial_order

_LEAF = 32  # hats in the smallest clusters; one costs as much as 19
N_TERMS = 19
_HALVES = 1 - np.eye(3) / 2


class HatSurface:
    """A scaled mesh without flat faces and loose vertices, numbered so that close vertices follow each other.

    It is turned into its principal axes, so that boxes turn with the body. A ValueError if no face has an area.

    Attributes:
        axes: (3, 3) the principal axes, as columns: points x become x @ axes.
        order: (V,) which of the mesh's vertices its own are.
        faces: (F, 3).
        table: (F, 22) of each face its corners, unit normal, the vectors in its plane across its first two sides,
            inwards and as long as these, the squared sides, and twice its area. Side i is opposite to corner i.
        first: (V + 1,) where the faces of a vertex begin in `around`.
        around: (3 F,) the faces of each vertex.
        hats: (V, 24) of each vertex the centroid p of its hat, the radius of a ball about it that holds the faces, and
            as polynomials in p − x: L (4), S (10) and B (6); quadratic coefficients in the order xx, xy, xz, yy,
            yz, zz.
    """

    def __init__(self, vertices: Floats, faces: Integers) -> None:
        faces = faces[has_area(vertices[faces])]
        if len(faces) == 0:
            raise ValueError("faces: expected at least one face with an area, got flat ones only; check the mesh")
        used = np.flatnonzero(np.bincount(faces.ravel(), minlength=len(vertices)))
        self.axes = principal_axes(vertices[used])
        vertices = vertices @ self.axes
        self.order = used[spatial_order(vertices[used], _LEAF)]
        rank = np.empty(len(vertices), np.int64)
        rank[self.order] = np.arange(len(self.order))
        vertices, self.faces = vertices[self.order], rank[faces]

        corners = vertices[self.faces]
        sides = np.roll(corners, -2, axis=1) - np.roll(corners, -1, axis=1)
        normals = np.cross(sides[:, 0], sides[:, 1])
        double_areas = np.linalg.norm(normals, axis=1, keepdims=True)
        normals /= double_areas
        inward = np.cross(normals[:, None], sides[:, :2])
        squared_sides = np.square(sides).sum(axis=2)
        flat = corners.reshape(-1, 9), normals, inward.reshape(-1, 6), squared_sides, double_areas
        self.table = np.concatenate(flat, axis=1)
        n_corners = 3 * len(faces)
        of_corner = sparse.csr_matrix(
            (np.ones(n_corners), self.faces.ravel(), np.arange(n_corners + 1)), shape=(n_corners, len(vertices))
        )
        at_vertex = of_corner.T.tocsr()
        self.hats = _hats(vertices, at_vertex, corners, normals, double_areas / 6, squared_sides)
        self.first, self.around = at_vertex.indptr.astype(np.int64), at_vertex.indices.astype(np.int64) // 3

    def weights(self, x: Floats, hats: Integers, ratio: float, out: Floats) -> None:
        """Fill the last rows of `out` (…, n) with the weights of hats (h,) at points x (3, n), far by `ratio` radii.

        For a point on the surface all rows are filled, with the weights of its triangle.
        """
        near = np.zeros((len(hats) + 1, x.shape[1]), dtype=bool)
        fill_hats(x, hats, self.hats, ratio, out[len(out) - len(hats) :], near)
        replace_near(x, hats, near, (self.faces, self.table, self.first, self.around), out)


def _hats(
    vertices: Floats,
    at_vertex: sparse.csr_matrix,
    corners: Floats,
    normals: Floats,
    thirds: Floats,
    squared_sides: Floats,
) -> Floats:
    """`HatSurface.hats`; thirds (F, 1) are those of the areas, and `at_vertex` (V, 3 F) sums over corners.

    Over a face with corners v, a, b and t = v + a + b the hat of v has the mean (v + t)/4 and the second moment
    (2vvᵀ + vtᵀ + tvᵀ + ttᵀ + aaᵀ + bbᵀ + vvᵀ)/20.
    """
    total = corners.sum(axis=1)
    squares = _outer(total, total) + corners.transpose(0, 2, 1) @ corners
    columns = [np.ones_like(thirds), total, normals, squares.reshape(-1, 9), _outer(normals, total).reshape(-1, 9)]
    sums = at_vertex @ np.repeat(thirds * np.concatenate(columns, axis=1), 3, axis=0)
    mass, total, flux, squares, tilt = np.split(sums, (1, 4, 7, 16), axis=1)
    total, squares = total / mass, squares.reshape(-1, 3, 3) / mass[..., None]
    centres = (vertices + total) / 4
    to_vertex = vertices - centres
    mixed = _outer(vertices, total)
    moments = (2 * _outer(vertices, vertices) + mixed + mixed.transpose(0, 2, 1) + squares) / 20
    covariance = moments - _outer(centres, centres)
    tilt = tilt.reshape(-1, 3, 3) / 4 + _outer(flux, vertices / 4 - centres)
    trace = np.trace(covariance, axis1=1, axis2=2)[:, None]
    # The two sides at each corner
    longest = np.sqrt(np.maximum(np.roll(squared_sides, -1, axis=1), np.roll(squared_sides, -2, axis=1)))
    reach = np.maximum.reduceat(longest.ravel()[at_vertex.indices], at_vertex.indptr[:-1])
    constant = (flux * to_vertex).sum(axis=1, keepdims=True)
    linear = -4 * np.einsum("vij,vi->vj", tilt, to_vertex) - 2 * trace * flux
    parts = [
        centres, reach[:, None] + np.linalg.norm(to_vertex, axis=1, keepdims=True), constant, flux,
        -2 * trace * constant, linear, -4 * _entries(tilt), 12 * _entries(covariance),
    ]  # fmt: skip
    return np.concatenate(parts, axis=1)


def _outer(left: Floats, right: Floats) -> Floats:
    return left[:, :, None] * right[:, None]


def _entries(forms: Floats) -> Floats:
    """(n, 6) coefficients of xx, xy, xz, yy, yz, zz of quadratic forms (n, 3, 3)."""
    return ((forms + forms.transpose(0, 2, 1)) * _HALVES)[:, (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)]


@dataclass(frozen=True)
class HatClusters:
    """Consecutive hats: 32 each on the first level, four clusters of the level before on the next."""

    centres: Floats  # (C, 3) of all levels, numbered through
    radii: Floats  # (C,) of balls about them that hold those of the hats
    first: Integers  # (levels + 1,) cluster at which each level begins, and their number
    sums: NDArray[np.floating]  # (C, 19, K) of the functions
    n_hats: int  # V

    @classmethod
    def of(cls, hats: Floats, functions: NDArray[np.floating], team: Team = ALONE) -> Self:
        """Of functions (V, K) at hats (V, 24)."""
        n_hats = len(hats)
        sizes = [_LEAF]
        while 16 * sizes[-1] < n_hats:
            sizes.append(4 * sizes[-1])
        centres, radii = [], []
        for size in sizes:
            starts = np.arange(0, n_hats, size)
            counts = np.diff(np.append(starts, n_hats))
            centre = np.add.reduceat(hats[:, :3], starts) / counts[:, None]
            reach = np.linalg.norm(hats[:, :3] - np.repeat(centre, counts, axis=0), axis=1) + hats[:, 3]
            centres.append(centre)
            radii.append(np.maximum.reduceat(reach, starts))
        first = np.cumsum([0, *map(len, radii)])
        sums = np.empty((first[-1], N_TERMS, functions.shape[1]), functions.dtype)

        def fill(level: int) -> None:
            terms = np.empty((n_hats, N_TERMS), functions.dtype)
            fill_cluster_terms(hats, sizes[level], centres[level], radii[level], terms)
            for cluster, start in enumerate(range(0, n_hats, sizes[level]), start=first[level]):
                part = slice(start, start + sizes[level])
                np.matmul(terms[part].T, functions[part], out=sums[cluster])

        team.each(fill, range(len(sizes)))
        return cls(np.concatenate(centres), np.concatenate(radii), first, sums, n_hats)

    def seen_from(self, x: Floats, ratio: float) -> tuple[Integers, Integers]:
        """The clusters that are `ratio` radii or more away from the box of points x (3, n), and the other hats."""
        return seen_from(x.min(axis=1), x.max(axis=1), self.centres, self.radii, self.first, ratio, _LEAF, self.n_hats)
