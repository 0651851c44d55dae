"""Loops that Numba compiles for `igps.signature.surface_potential`: what its tree gives at blocks of points."""

import math

import numpy as np

from igps._arrays import Floats, Integers
from igps._compiled import compiled

_TINY = math.ulp(1.0) ** 2  # keeps a logarithm finite whose factor is 0


@compiled()
def fill_potentials(
    points: Floats,
    block: int,
    patches: Floats,
    reaches: Floats,
    first: Integers,
    size: int,
    limits: Floats,
    faces: Floats,
    out: Floats,
) -> None:
    """Fill the potentials at points, block after block of points that lie close together.

    Args:
        points: (n, 3).
        block: how many see the same clusters.
        patches: (N, 10) of all levels, the faces first: centre c, area A, and the form A·(3/2 C − ½ tr C·1) with C the
            covariance, as xx, yy, zz, 2xy, 2xz, 2yz.
        reaches: (N,) distance from the centre from which on a patch's series serves.
        first: (levels + 1,) patch at which each level begins, and their number.
        size: patches of a level in one of the next.
        limits: (F,) squared distance from a face's centre from which on its quarters' series serve.
        faces: (F, 25), see `near_potential`.
        out: (n,).
    """
    n_levels = len(first) - 1
    x, far = np.empty((3, block)), np.empty(block)
    # At most the patches of the coarsest level, and of each level below the children of one patch, wait.
    waiting = np.empty((first[n_levels] - first[n_levels - 1] + size * n_levels, 2), np.int64)
    for start in range(0, len(points), block):
        n = min(block, len(points) - start)
        low, high = points[start].copy(), points[start].copy()
        for i in range(n):
            for axis in range(3):
                x[axis, i] = points[start + i, axis]
                low[axis], high[axis] = min(low[axis], x[axis, i]), max(high[axis], x[axis, i])
        here, sums = x[:, :n], out[start : start + n]
        sums[:] = 0
        n_waiting = 0
        for patch in range(first[n_levels - 1], first[n_levels]):
            waiting[n_waiting, 0], waiting[n_waiting, 1] = patch, n_levels - 1
            n_waiting += 1
        while n_waiting > 0:
            n_waiting -= 1
            patch, level = waiting[n_waiting, 0], waiting[n_waiting, 1]
            squared_gap = 0.0
            for axis in range(3):
                gap = patches[patch, axis] - min(max(patches[patch, axis], low[axis]), high[axis])
                squared_gap += gap * gap
            if squared_gap >= reaches[patch] ** 2:
                far[:n] = 1
                add_series(patches[patch], 1.0, 0.0, patches[patch], here, far, sums)
            elif level > 0:
                child = first[level - 1] + size * (patch - first[level])
                for member in range(child, min(child + size, first[level])):
                    waiting[n_waiting, 0], waiting[n_waiting, 1] = member, level - 1
                    n_waiting += 1
            else:
                add_face(patches[patch], limits[patch], faces[patch], here, far, sums)


@compiled()
def add_series(
    patch: Floats, scale: float, share: float, towards: Floats, points: Floats, far: Floats, sums: Floats
) -> None:
    """Add A/r + A (3/2 dᵀCd − ½ tr C r²)/r⁵ of a patch (10,) at points (3, n), times `far` (n,).

    The patch may be made smaller by a scale, and moved by a share of the way to another point (3,).
    """
    c0, c1, c2 = (
        patch[0] + share * (towards[0] - patch[0]),
        patch[1] + share * (towards[1] - patch[1]),
        patch[2] + share * (towards[2] - patch[2]),
    )
    area = patch[3] * scale**2
    f0, f1, f2 = patch[4] * scale**4, patch[5] * scale**4, patch[6] * scale**4
    f3, f4, f5 = patch[7] * scale**4, patch[8] * scale**4, patch[9] * scale**4
    for i in range(points.shape[1]):
        a, b, c = c0 - points[0, i], c1 - points[1, i], c2 - points[2, i]
        # A patch at the point itself is not far from it, and counts for nothing here.
        inverse = 1 / max(a * a + b * b + c * c, 1e-24)
        second = a * (f0 * a + f3 * b + f4 * c) + b * (f1 * b + f5 * c) + f2 * c * c
        sums[i] += far[i] * (area + second * (inverse * inverse)) * math.sqrt(inverse)


@compiled()
def add_face(patch: Floats, limit: float, face: Floats, points: Floats, far: Floats, sums: Floats) -> None:
    """Add a face that was opened at points (3, n): by the series of its quarters, or near it in closed form."""
    n_far = 0
    for i in range(points.shape[1]):
        a, b, c = patch[0] - points[0, i], patch[1] - points[1, i], patch[2] - points[2, i]
        if a * a + b * b + c * c < limit:
            far[i] = 0
            sums[i] += near_potential(face, points[0, i], points[1, i], points[2, i])
        else:
            far[i] = 1
            n_far += 1
    if n_far > 0:
        # The quarters have half of the face's size; one is in its middle, the others half-way to its corners.
        for corner in range(3):
            add_series(patch, 0.5, 0.5, face[3 * corner : 3 * corner + 3], points, far, sums)
        add_series(patch, 0.5, 0.0, face, points, far, sums)


@compiled()
def near_potential(face: Floats, x: float, y: float, z: float) -> float:
    """The potential of a face (25,) at a point: Σ p ln((r + r' + l)/(r + r' − l)) − |h Ω| over its sides.

    For a side of length l, p is the distance of the point's projection from its line, positive inside, and r, r' are
    the distances of its ends; h is that from the plane and Ω the solid angle (Van Oosterom and Strackee 1983). On a
    side both p and the quotient's denominator vanish, and their product is 0.

    A face's numbers are its corners, its normal, the outward normals of its sides in its plane, the lengths of these,
    and twice its area.
    """
    a = (face[0] - x, face[1] - y, face[2] - z)
    b = (face[3] - x, face[4] - y, face[5] - z)
    c = (face[6] - x, face[7] - y, face[8] - z)
    r, s, t = math.sqrt(dot(a, a)), math.sqrt(dot(b, b)), math.sqrt(dot(c, c))
    potential = dot((face[12], face[13], face[14]), a) * logarithm(r + s, face[21])
    potential += dot((face[15], face[16], face[17]), b) * logarithm(s + t, face[22])
    potential += dot((face[18], face[19], face[20]), c) * logarithm(t + r, face[23])
    height = abs(dot((face[9], face[10], face[11]), a))
    denominator = r * s * t + dot(a, b) * t + dot(b, c) * r + dot(c, a) * s
    return potential - 2 * height * math.atan2(height * face[24], denominator)


@compiled()
def dot(p: tuple[float, float, float], q: tuple[float, float, float]) -> float:
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]


@compiled()
def logarithm(total: float, length: float) -> float:
    """ln((r + r' + l)/(r + r' − l)) of a side of length l, from the sum of the distances of its ends."""
    return math.log((total + length) / max(total - length, _TINY))
