"""Mean value weights of a surface: in closed form face by face near it, by series of hats and of clusters far from it.

The weight of a vertex at a point x is ∫ λ h/r⁴ dS over its hat function λ, where r is the distance from x to a surface
point y, and h the distance from x to the tangent plane at y. Far away the kernel is expanded in a Taylor series:

* The series of a hat is taken about its centroid p, to first order; the second order treats the hat as flat. Let n be
  the normal and v a vertex of the face that contains y, C the covariance of y under λ, and r = |p − x|. Then the weight
  is w = ((B L/r² + S)/r² + L)/r⁴ with L = ∫ λ n·(v − x), B = 12 (p − x)ᵀ C (p − x), S = −4 Q − 2 tr C L, and
  Q = ∫ λ n·(v − x) (y − p)·(p − x), which is zero for a flat hat. On a smooth surface the error is of third order in
  radius over distance.
* The series of a cluster is taken about its centre, to second order. At an element n dS the kernel is n·∇u(d + s),
  where d is the vector from the point to the centre, s the vector from the centre to the element, and
  u(d) = −1/(2|d|²). The series in s is |e|² times a polynomial in e = R d/|d|², where R is the radius of the cluster.
  The sum Σ f w over the hats of a cluster is therefore the scalar product of 19 terms |e|²·(e_i, e_i e_j, e_i e_j e_k),
  which depend on the point, with 19 sums of f, which do not.
"""

from dataclasses import dataclass
from itertools import combinations_with_replacement, product
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from igps._arrays import Floats, Integers
from igps._threads import SERIAL, Team
from igps.mesh.surface import has_area, lengths
from igps.signature._weight_loops import (
    Touched,
    add_near_faces,
    fill_hats,
    find_far_clusters,
    pairs_for,
)
from igps.signature.ordering import principal_axes, spatial_order

_LEAF_SIZE = 32  # hats in the smallest clusters; a cluster costs as much as 19 hats
_N_TERMS = 19
_HALF_DIAGONAL = 1 - np.eye(3) / 2  # halves the diagonal of a matrix plus its transpose
# The products of two coordinates, xx, xy, xz, yy, yz, zz, by the coordinates of each
_ROWS, _COLUMNS = np.triu_indices(3)
_SQUARES = np.where(_ROWS == _COLUMNS, 1.0, 0.0)  # coefficients of |e|²
# (6, 3, 3) matrix of each product of two coordinates
_MATRICES = np.zeros((6, 3, 3))
_MATRICES[range(6), _ROWS, _COLUMNS] += 0.5
_MATRICES[range(6), _COLUMNS, _ROWS] += 0.5


def _cubes() -> Floats:
    """Return (18, 10) to which product of three coordinates each product of one and two belongs."""
    cubes: list[tuple[int, ...]] = list(combinations_with_replacement(range(3), 3))
    pairs = combinations_with_replacement(range(3), 2)
    table = np.zeros((18, 10))
    for row, (one, two) in enumerate(product(range(3), pairs)):
        factors = sorted((one, *two))
        table[row, cubes.index(tuple(factors))] = 1
    return table


_CUBES = _cubes()


class HatSurface:
    """Tables of a scaled mesh for the evaluation of mean value weights, without flat faces and unused vertices.

    Vertices with close indices are close in space. The coordinates are rotated to the principal axes, so that bounding
    boxes turn with the body. A ValueError is raised if no face has an area.

    Attributes:
        axes: (3, 3) principal axes as columns; points x are rotated by x @ axes.
        order: (V,) index of each vertex in the original mesh.
        faces: (F, 3).
        table: (F, 22) for each face: corners, unit normal, two inward vectors in its plane that are perpendicular to
            its first two sides and as long as these, squared side lengths, twice the area. Side i is opposite corner i.
        face_starts: (V + 1,) start of the faces of each vertex in `incident_faces`.
        incident_faces: (3 F,) faces around the vertices, vertex by vertex.
        hats: (V, 24) for each vertex: centroid p of its hat, radius of a ball about p that contains its faces, and the
            coefficients of L (4), S (10) and B (6) as polynomials in p − x, quadratic ones as xx, xy, xz, yy, yz, zz.
    """

    def __init__(self, vertices: Floats, faces: Integers) -> None:
        faces = faces[has_area(vertices[faces])]
        if len(faces) == 0:
            raise ValueError(
                "faces: expected at least one face with an area, got flat ones only; check the mesh"
            )
        used = np.flatnonzero(np.bincount(faces.ravel()))
        self.axes = principal_axes(vertices[used])
        vertices = vertices @ self.axes
        self.order = used[spatial_order(vertices[used], _LEAF_SIZE)]
        rank = np.empty(len(vertices), np.int64)
        rank[self.order] = np.arange(len(self.order))
        self.faces = rank[faces]
        vertices = vertices[self.order]
        corners = vertices[self.faces]
        self.table = _face_table(corners)
        n_corners = self.faces.size
        columns = (np.ones(n_corners), self.faces.ravel(), np.arange(n_corners + 1))
        shape = (len(vertices), n_corners)
        incidence = sparse.csc_matrix(columns, shape=shape).tocsr()
        self.hats = _hats(vertices, incidence, corners, self.table)
        self.face_starts = incidence.indptr.astype(np.int64)
        self.incident_faces = incidence.indices.astype(np.int64) // 3

    def fill_weights(self, x: Floats, hats: Integers, ratio: float, out: Floats) -> None:
        """Fill the last rows of `out` (…, n) with the weights of hats (h,) at points x (3, n).

        The series is used where a point is `ratio` or more radii from a hat, the closed form elsewhere. For a point on
        the surface all rows are filled: with barycentric coordinates at the corners of its face, with zeros elsewhere.
        """
        n = x.shape[1]
        n_hats = len(hats)
        near = np.zeros((n_hats + 1, n), dtype=bool)
        last_rows = out[len(out) - n_hats :]
        fill_hats(x, hats, self.hats, ratio, last_rows, near)
        row_of = np.full(len(self.order), n_hats)
        row_of[hats] = np.arange(n_hats)
        is_near = near[:-1].any(axis=1)
        near_hats = np.where(is_near, hats, -1)
        surface = (self.faces, self.table, self.face_starts, self.incident_faces)
        touched = Touched(face_at=np.full(n, -1), barycentric=np.empty((n, 3)))
        add_near_faces(x, near_hats, near, surface, row_of, last_rows, touched, pairs_for(n))
        on_surface = np.flatnonzero(touched.face_at >= 0)
        touched_faces = touched.face_at[on_surface]
        rows = row_of[self.faces[touched_faces]]
        out[:, on_surface] = 0
        last_rows[rows, on_surface[:, None]] = touched.barycentric[on_surface]


def _face_table(corners: Floats) -> Floats:
    """Return `HatSurface.table`, from the corners (F, 3, 3)."""
    following = np.roll(corners, -1, axis=1)
    sides = np.roll(corners, -2, axis=1) - following
    normals = np.cross(sides[:, 0], sides[:, 1])
    double_areas = lengths(normals)[:, None]
    normals /= double_areas
    inward = np.cross(normals[:, None], sides[:, :2])
    squared_sides = np.square(sides).sum(axis=2)
    columns = [
        corners.reshape(-1, 9),
        normals,
        inward.reshape(-1, 6),
        squared_sides,
        double_areas,
    ]
    return np.concatenate(columns, axis=1)


def _hats(vertices: Floats, incidence: sparse.csr_matrix, corners: Floats, table: Floats) -> Floats:
    """Return `HatSurface.hats`, from corners (F, 3, 3), and `incidence` (V, 3 F), which sums over the corners.

    Over a face with corners v, a, b and t = v + a + b the hat of v has the mean (v + t)/4 and the second moment
    (2vvᵀ + vtᵀ + tvᵀ + ttᵀ + aaᵀ + bbᵀ + vvᵀ)/20.
    """
    normals = table[:, 9:12]
    squared_sides = table[:, 18:21]
    third_areas = table[:, 21:] / 6

    def integral(values: Floats) -> Floats:
        """Return the integrals (V, …) over all hats of values (F, …) on the faces."""
        by_face = third_areas * values.reshape(len(values), -1)
        by_hat = incidence @ np.repeat(by_face, 3, axis=0)
        return np.asarray(by_hat).reshape(-1, *values.shape[1:])

    total = corners.sum(axis=1)
    mass = integral(np.ones_like(third_areas))
    flux = integral(normals)
    normal_moments = integral(_outer(normals, total)) / 4
    squares = _outer(total, total) + corners.transpose(0, 2, 1) @ corners
    moments = integral(squares) / mass[..., None]
    total = integral(total) / mass
    centres = (vertices + total) / 4
    to_vertex = vertices - centres
    mixed = _outer(vertices, total)
    hat_moments = 2 * _outer(vertices, vertices)
    hat_moments += mixed
    hat_moments += mixed.transpose(0, 2, 1)
    hat_moments += moments
    covariance = hat_moments / 20 - _outer(centres, centres)
    shifts = vertices / 4 - centres
    normal_moments = normal_moments + _outer(flux, shifts)
    trace = np.trace(covariance, axis1=1, axis2=2)[:, None]
    # At each corner, the longer of its two sides
    one_side = np.roll(squared_sides, -1, axis=1)
    other_side = np.roll(squared_sides, -2, axis=1)
    longest = np.sqrt(np.maximum(one_side, other_side)).ravel()
    by_vertex = longest[incidence.indices]
    extents = np.maximum.reduceat(by_vertex, incidence.indptr[:-1])
    radii = extents + lengths(to_vertex)
    constant = (flux * to_vertex).sum(axis=1, keepdims=True)
    tilted = np.einsum("vij,vi->vj", normal_moments, to_vertex)
    linear = -4 * tilted - 2 * trace * flux
    parts = [
        centres,
        radii[:, None],
        constant,
        flux,
        -2 * trace * constant,
        linear,
        -4 * _entries(normal_moments),
        12 * _entries(covariance),
    ]
    return np.concatenate(parts, axis=1)


def _outer(left: Floats, right: Floats) -> Floats:
    return left[:, :, None] * right[:, None]


def _entries(forms: Floats) -> Floats:
    """Return the coefficients (n, 6) of xx, xy, xz, yy, yz, zz of quadratic forms (n, 3, 3)."""
    coefficients = (forms + forms.transpose(0, 2, 1)) * _HALF_DIAGONAL
    return coefficients[:, _ROWS, _COLUMNS]


@dataclass(frozen=True)
class HatClusters:
    """Sums of functions over clusters: of 32 hats on the first level, of four clusters on each further level."""

    centres: Floats  # (C, 3), level by level
    radii: Floats  # (C,) of balls about the centres that contain the balls of the hats
    level_starts: Integers  # (n_levels + 1,) first cluster of each level, and C
    # (C, 19, K) the 19 sums of each function, see the docstring of the module
    sums: NDArray[np.floating]
    n_hats: int  # V

    @classmethod
    def from_hats(cls, hats: Floats, functions: NDArray[np.floating], team: Team = SERIAL) -> Self:
        """Cluster hats (V, 24), and sum functions (V, K) over each cluster."""
        n_hats = len(hats)
        sizes = [_LEAF_SIZE]
        while 16 * sizes[-1] < n_hats:
            sizes.append(4 * sizes[-1])
        hat_centres = hats[:, :3]
        hat_radii = hats[:, 3]
        centres = []
        radii = []
        for size in sizes:
            starts = np.arange(0, n_hats, size)
            counts = np.diff(starts, append=n_hats)
            centre = np.add.reduceat(hat_centres, starts) / counts[:, None]
            arms = hat_centres - np.repeat(centre, counts, axis=0)
            extents = lengths(arms) + hat_radii
            centres.append(centre)
            radii.append(np.maximum.reduceat(extents, starts))
        level_starts = np.cumsum([0, *map(len, radii)])
        shape = (level_starts[-1], _N_TERMS, functions.shape[1])
        sums = np.empty(shape, functions.dtype)

        def fill(level: int) -> None:
            size = sizes[level]
            terms = _cluster_terms(hats, size, centres[level], radii[level])
            terms = terms.astype(functions.dtype)
            starts = range(0, n_hats, size)
            for cluster, start in enumerate(starts, start=level_starts[level]):
                part = slice(start, start + size)
                np.matmul(terms[part].T, functions[part], out=sums[cluster])

        team.each(fill, range(len(sizes)))
        return cls(
            centres=np.concatenate(centres),
            radii=np.concatenate(radii),
            level_starts=level_starts,
            sums=sums,
            n_hats=n_hats,
        )

    def far_clusters(self, x: Floats, ratio: float) -> tuple[Integers, Integers]:
        """Return the clusters that are `ratio` or more radii from the box of points x (3, n), and the other hats."""
        box = (x.min(axis=1), x.max(axis=1))
        balls = self.centres, self.radii, self.level_starts
        stack = np.empty((len(self.radii), 2), np.int64)
        clusters = np.empty(len(self.radii), np.int64)
        hats = np.empty(self.n_hats, np.int64)
        n_clusters, n_hats = find_far_clusters(box, balls, ratio, _LEAF_SIZE, stack, clusters, hats)
        return clusters[:n_clusters], hats[:n_hats]


def _cluster_terms(hats: Floats, size: int, centres: Floats, radii: Floats) -> Floats:
    """Return the contribution (V, 19) of each hat to the sums of its cluster, which consists of `size` hats in a row.

    The moments of n dS about the cluster's centre are F = ∫ λ n, T + F sᵀ, and 2 T s + F E, where T is the symmetric
    part of ∫ λ n (y − p)ᵀ, E the second moment of y under λ, and s the vector from the cluster's centre to the hat's.
    They are contracted with the derivatives of u, which are |e|² times e, −4 e eᵀ + |e|², and 24 e e e − 4 |e|² e in
    each of three ways: the cubic form is 12 (F·e) eᵀEe + 24 (s·e) eᵀTe − 2 (g·e) |e|².
    """
    cluster = np.arange(len(hats)) // size
    scale = 1 / radii[cluster, None]
    to_hats = hats[:, :3] - centres[cluster]
    s = scale * to_hats
    flux = scale**3 * hats[:, 5:8]
    # The coefficients of forms; S is −4 dᵀTd, and B is 12 dᵀCd
    tilt = -(scale**4) / 4 * hats[:, 12:18]
    spread = scale**2 / 12 * hats[:, 18:24]
    spread += _entries(_outer(s, s))
    first = tilt + _entries(_outer(flux, s))
    second = _trace(first) * _SQUARES - 4 * first
    g = 2 * _trace(tilt) * s
    g += _trace(spread) * flux
    g += 4 * _times(tilt, s) + 2 * _times(spread, flux)
    third = 12 * _cubic(flux, spread)
    third += 24 * _cubic(s, tilt)
    third -= 2 * _cubic(g, _SQUARES[None])
    return np.concatenate([flux, second, third], axis=1)


def _trace(entries: Floats) -> Floats:
    """Return the traces (n, 1) of quadratic forms, by their coefficients (n, 6)."""
    return (entries @ _SQUARES)[:, None]


def _times(entries: Floats, vectors: Floats) -> Floats:
    """Return the products (n, 3) of the matrices of quadratic forms, by their coefficients (n, 6), with vectors."""
    return np.einsum("ne,eij,nj->ni", entries, _MATRICES, vectors)


def _cubic(vectors: Floats, entries: Floats) -> Floats:
    """Return the coefficients (n, 10) of products of linear forms (n, 3) and quadratic ones (n, 6)."""
    products = _outer(vectors, entries)
    return products.reshape(len(products), -1) @ _CUBES
