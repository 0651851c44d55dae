"""Compiled loops for mean value weights: Taylor series far from the surface, the closed form near it.

Points x are (3, n), and close together. The tables of the surface are those of `igps.signature._far_field.HatSurface`.
"""

import math
from typing import NamedTuple, cast

import numpy as np
from numpy.polynomial import Chebyshev, Polynomial

from igps._arrays import Booleans, Floats, Integers
from igps._compiled import FUSE, compiled

SurfaceArrays = tuple[Integers, Floats, Integers, Integers]
"""Faces, table, face_starts and incident_faces of a `HatSurface`."""

# A plain 0 has another type, for which Numba would compile `add_faces` again
_ZERO = cast(int, np.int64(0))
# Pairs of a face and a point computed at a time: their data stay in the first-level cache
_N_PAIRS = 128
# Half-diagonals; points closer than this are on the surface, or in the plane of a face
_ON_SURFACE = 2e-9
_TAN = math.tan(math.pi / 8)


def _arctan_coefficients() -> tuple[float, ...]:
    """Return coefficients of arctan(√q)/√q for √q ≤ tan π/8, accurate to rounding, from the highest power down."""

    def function(q: Floats) -> Floats:
        root = np.sqrt(q)
        return np.arctan(root) / root

    series = Chebyshev.interpolate(function, 12, domain=[1e-9, _TAN**2])
    polynomial = series.convert(kind=Polynomial)
    return tuple(polynomial.coef[::-1].tolist())


_ARCTAN = _arctan_coefficients()


@compiled()
def find_far_clusters(
    box: tuple[Floats, Floats],
    balls: tuple[Floats, Floats, Integers],
    ratio: float,
    leaf: int,
    stack: Integers,
    clusters: Integers,
    hats: Integers,
) -> tuple[int, int]:
    """Write the clusters (C,) that are `ratio` or more radii from a box, and the hats (V,) in none of these, ascending.

    Return their numbers. The balls are the centres, radii and level starts of `HatClusters`. The stack (C, 2) is
    scratch space.
    """
    low, high = box
    centres, radii, starts = balls
    n_clusters, n_near, n_stacked = 0, 0, 0
    n_levels = len(starts) - 1
    for cluster in range(starts[n_levels] - 1, starts[n_levels - 1] - 1, -1):
        stack[n_stacked, 0] = cluster
        stack[n_stacked, 1] = n_levels - 1
        n_stacked += 1
    while n_stacked > 0:
        n_stacked -= 1
        cluster = stack[n_stacked, 0]
        level = stack[n_stacked, 1]
        squared_gap = 0.0
        for axis in range(3):
            centre = centres[cluster, axis]
            squared_gap += (centre - min(max(centre, low[axis]), high[axis])) ** 2
        number = cluster - starts[level]
        if squared_gap >= (ratio * radii[cluster]) ** 2:
            clusters[n_clusters] = cluster
            n_clusters += 1
        elif level > 0:
            children = starts[level - 1] + 4 * number
            for child in range(min(children + 4, starts[level]) - 1, children - 1, -1):
                stack[n_stacked, 0] = child
                stack[n_stacked, 1] = level - 1
                n_stacked += 1
        else:
            for hat in range(leaf * number, min(leaf * number + leaf, len(hats))):
                hats[n_near] = hat
                n_near += 1
    return n_clusters, n_near


@compiled(fastmath=FUSE)
def fill_hats(
    x: Floats, chosen: Integers, hats: Floats, ratio: float, weights: Floats, near: Booleans
) -> None:
    """Fill the weights (h, n) of the chosen hats (h,), 0 at points within `ratio` radii; mark zeros in `near`."""
    n = x.shape[1]
    for k in range(len(chosen)):
        p = hats[chosen[k]]
        p0 = p[0]
        p1 = p[1]
        p2 = p[2]
        limit = (ratio * p[3]) ** 2
        f = p[4]
        f0 = p[5]
        f1 = p[6]
        f2 = p[7]
        s = p[8]
        s0 = p[9]
        s1 = p[10]
        s2 = p[11]
        s00 = p[12]
        s01 = p[13]
        s02 = p[14]
        s11 = p[15]
        s12 = p[16]
        s22 = p[17]
        b00 = p[18]
        b01 = p[19]
        b02 = p[20]
        b11 = p[21]
        b12 = p[22]
        b22 = p[23]
        row = weights[k]
        for i in range(n):
            a = p0 - x[0, i]
            b = p1 - x[1, i]
            c = p2 - x[2, i]
            distance = a * a + b * b + c * c
            inverse = 1 / distance
            linear = f + f0 * a + f1 * b + f2 * c
            second = (
                s
                + a * (s0 + s00 * a + s01 * b + s02 * c)
                + b * (s1 + s11 * b + s12 * c)
                + c * (s2 + s22 * c)
            )
            third = a * (b00 * a + b01 * b + b02 * c) + b * (b11 * b + b12 * c) + b22 * c * c
            value = ((third * linear * inverse + second) * inverse + linear) * (inverse * inverse)
            row[i] = 0.0 if distance < limit else value
        for i in range(n):
            near[k, i] = row[i] == 0.0


@compiled(fastmath=FUSE)
def fill_clusters(
    x: Floats, chosen: Integers, centres: Floats, radii: Floats, terms: Floats
) -> None:
    """Fill the terms (19 c, n) of the chosen clusters (c,): |e|² times e, its products of two, and of three."""
    for k in range(len(chosen)):
        c0 = centres[chosen[k], 0]
        c1 = centres[chosen[k], 1]
        c2 = centres[chosen[k], 2]
        radius = radii[chosen[k]]
        out = terms[19 * k : 19 * k + 19]
        for i in range(x.shape[1]):
            a = c0 - x[0, i]
            b = c1 - x[1, i]
            c = c2 - x[2, i]
            inverse = radius / (a * a + b * b + c * c)
            a = a * inverse
            b = b * inverse
            c = c * inverse
            scale = radius * inverse
            sa = scale * a
            sb = scale * b
            sc = scale * c
            aa = sa * a
            ab = sa * b
            ac = sa * c
            bb = sb * b
            bc = sb * c
            cc = sc * c
            out[0, i] = sa
            out[1, i] = sb
            out[2, i] = sc
            out[3, i] = aa
            out[4, i] = ab
            out[5, i] = ac
            out[6, i] = bb
            out[7, i] = bc
            out[8, i] = cc
            out[9, i] = aa * a
            out[10, i] = aa * b
            out[11, i] = aa * c
            out[12, i] = ab * b
            out[13, i] = ab * c
            out[14, i] = ac * c
            out[15, i] = bb * b
            out[16, i] = bb * c
            out[17, i] = bc * c
            out[18, i] = cc * c


class Touched(NamedTuple):
    """The faces on which points lie: their numbers (n,), or -1, and the barycentric coordinates (n, 3) there."""

    face_at: Integers
    barycentric: Floats


class Pairs(NamedTuple):
    """Scratch space for up to m pairs of a face and a point that are computed at a time."""

    numbers: Integers  # (2, m) of the face and of the point
    squares: Floats  # (3, m) squared lengths of the cross products of `add_faces`, then its g
    cosines: Floats  # (3, m)
    projections: Floats  # (m, 4) areas λ |n| and height


def pairs_for(n_points: int) -> Pairs:
    """Return the scratch space of `add_near_faces` for n points."""
    m = n_points + _N_PAIRS
    return Pairs(
        numbers=np.empty((2, m), np.int64),
        squares=np.empty((3, m)),
        cosines=np.empty((3, m)),
        projections=np.empty((m, 4)),
    )


@compiled()
def add_near_faces(
    x: Floats,
    hats: Integers,
    near: Booleans,
    surface: SurfaceArrays,
    row_of: Integers,
    weights: Floats,
    touched: Touched,
    pairs: Pairs,
) -> None:
    """Add the closed form to the weights (h, n) of hats (h,), where a hat is `near` a point (h + 1, n).

    The hats without a near point are given as -1. The row of each vertex among the hats is `row_of` (V,): that of a
    vertex that is not among them is h, the last row of `near`, which is False.
    """
    faces = surface[0]
    face_starts = surface[2]
    incident_faces = surface[3]
    n_hats = len(hats)
    n_pairs = _ZERO
    for k in range(n_hats):
        hat = hats[k]
        if hat < 0:
            continue
        for j in range(face_starts[hat], face_starts[hat + 1]):
            face = incident_faces[j]
            # Each face is added once: at its near corner of lowest index. Are corners of lower index near, too?
            row_1, row_2 = n_hats, n_hats
            for corner in range(3):
                if faces[face, corner] < hat:
                    row_1, row_2 = row_of[faces[face, corner]], row_1
            for i in range(x.shape[1]):
                if near[k, i] and not near[row_1, i] and not near[row_2, i]:
                    pairs.numbers[0, n_pairs] = face
                    pairs.numbers[1, n_pairs] = i
                    n_pairs += 1
            if n_pairs >= _N_PAIRS:
                add_faces(x, n_pairs, surface, row_of, near, weights, touched, pairs)
                n_pairs = _ZERO
    add_faces(x, n_pairs, surface, row_of, near, weights, touched, pairs)


@compiled()
def add_faces(
    x: Floats,
    n_pairs: int,
    surface: SurfaceArrays,
    row_of: Integers,
    near: Booleans,
    weights: Floats,
    touched: Touched,
    pairs: Pairs,
) -> None:
    """Add the closed form for m pairs of a face and a point, accurate up to the surface.

    If a point is on the surface, the first face that contains it is written to `touched`.

    Let λ be the barycentric coordinates of the projection of x, h its distance to the plane, e_l the sides, N_l the
    cross product of the vectors from x to the ends of side l, and θ_l the angle between these. The published
    N_i·m / (N_i·v_i) becomes ½ [λ_i s/h + h Σ_l g_l e_l·e_i / |n|²] |n|, with g_l = θ_l/|N_l| and s = Σ_l g_l λ_l,
    because N_l = λ_l n + h n̂×e_l. The length of N_l is taken from this identity, too: all terms agree near a side.
    """
    faces = surface[0]
    table = surface[1]
    squares = pairs.squares
    cosines = pairs.cosines
    projections = pairs.projections
    for m in range(n_pairs):
        row = table[pairs.numbers[0, m]]
        i = pairs.numbers[1, m]
        a0 = row[0] - x[0, i]
        a1 = row[1] - x[1, i]
        a2 = row[2] - x[2, i]
        b0 = row[3] - x[0, i]
        b1 = row[4] - x[1, i]
        b2 = row[5] - x[2, i]
        c0 = row[6] - x[0, i]
        c1 = row[7] - x[1, i]
        c2 = row[8] - x[2, i]
        height = row[9] * a0 + row[10] * a1 + row[11] * a2
        # λ |n|: twice the areas of the triangles that the projection spans with each side.
        area_0 = -(row[12] * b0 + row[13] * b1 + row[14] * b2)
        area_1 = -(row[15] * c0 + row[16] * c1 + row[17] * c2)
        area_2 = row[21] - area_0 - area_1
        squares[0, m] = area_0 * area_0 + row[18] * height * height
        squares[1, m] = area_1 * area_1 + row[19] * height * height
        squares[2, m] = area_2 * area_2 + row[20] * height * height
        cosines[0, m] = b0 * c0 + b1 * c1 + b2 * c2
        cosines[1, m] = c0 * a0 + c1 * a1 + c2 * a2
        cosines[2, m] = a0 * b0 + a1 * b1 + a2 * b2
        projections[m, 0] = area_0
        projections[m, 1] = area_1
        projections[m, 2] = area_2
        projections[m, 3] = height
    for side in range(3):
        divide_angles(squares[side, :n_pairs], cosines[side, :n_pairs])
    for m in range(n_pairs):
        face = pairs.numbers[0, m]
        i = pairs.numbers[1, m]
        row = table[face]
        areas = projections[m]
        height = projections[m, 3]
        g = squares[:, m]
        sides = table[face, 18:21]
        half = (sides[0] + sides[1] + sides[2]) / 2
        s = g[0] * areas[0] + g[1] * areas[1] + g[2] * areas[2]
        # In the plane of a face but outside the face, s vanishes like h² and s/h like h: only rounding errors are left.
        s_over_h = 0.0 if abs(height) < _ON_SURFACE and s < 1e-2 else s / height
        on_face = abs(height) <= _ON_SURFACE and touched.face_at[i] < 0
        total_area = 0.0
        for corner in range(3):
            left = (corner + 2) % 3
            right = (corner + 1) % 3
            k = row_of[faces[face, corner]]
            if near[k, i]:
                second = (
                    g[corner] * sides[corner]
                    + g[left] * (sides[right] - half)
                    + g[right] * (sides[left] - half)
                )
                weights[k, i] += (second * height + s_over_h * areas[corner]) / (2 * row[21])
            on_face &= areas[corner] >= -_ON_SURFACE * math.sqrt(sides[corner])
            total_area += max(areas[corner], 0.0)
        if on_face:
            touched.face_at[i] = face
            for corner in range(3):
                touched.barycentric[i, corner] = max(areas[corner], 0.0) / total_area


@compiled(fastmath=FUSE)
def divide_angles(squares: Floats, cosines: Floats) -> None:
    """Replace squared lengths by angles over lengths, arctan2(length, cosine) / length, accurate to rounding."""
    for m in range(len(squares)):
        y = max(math.sqrt(squares[m]), 1e-150)
        cosine = cosines[m]
        x = abs(cosine)
        small = min(x, y)
        large = max(x, y)
        steep = small > _TAN * large
        z = (small - large if steep else small) / (small + large if steep else large)
        q = z * z
        series = 0.0
        for coefficient in _ARCTAN:
            series = series * q + coefficient
        angle = z * series + (math.pi / 4 if steep else 0.0)
        angle = math.pi / 2 - angle if y > x else angle
        squares[m] = (math.pi - angle if cosine < 0 else angle) / y
