"""Compiled loops for `igps.signature.surface_potential`: potentials of its tree of patches at blocks of points."""

import math
from typing import NamedTuple

import numpy as np

from igps._arrays import Floats, Integers
from igps._compiled import ALLOCATES, compiled

# Keeps the logarithm of a side finite at points on the side, where its factor is 0
_TINY = math.ulp(1.0) ** 2


class PatchTree(NamedTuple):
    """The faces of a surface, and the patches of neighbouring faces, level by level.

    Args:
        patches: (N, 10) of all levels, beginning with the faces: centre c, area A, and the quadratic form
            A·(3/2 C − ½ tr C·1) with C the covariance, as xx, yy, zz, 2xy, 2xz, 2yz.
        min_distances: (N,) smallest distance from the centre of each patch at which its series is used.
        level_starts: (n_levels + 1,) first patch of each level, and N.
        branching: number of patches that are merged into a patch of the next level.
        squared_limits: (F,) squared distance from the centre of each face beyond which its quarters' series are used.
        faces: (F, 25), see `near_potential`.
    """

    patches: Floats
    min_distances: Floats
    level_starts: Integers
    branching: int
    squared_limits: Floats
    faces: Floats


@compiled(**ALLOCATES)
def fill_potentials(
    points: Floats,
    block: int,
    tree: PatchTree,
    out: Floats,
) -> None:
    """Fill `out` (n,) with the potentials at points, one block of neighbouring points at a time.

    Args:
        points: (n, 3) in spatial order.
        block: number of points for which the same patches are far.
        tree: the patches of the surface.
    """
    patches, min_distances, level_starts, branching, squared_limits, faces = tree
    n_levels = len(level_starts) - 1
    x = np.empty((3, block))
    is_far = np.empty(block)
    # The stack holds at most all patches of the coarsest level, and the children of one patch for each level below.
    stack = np.empty(
        (level_starts[n_levels] - level_starts[n_levels - 1] + branching * n_levels, 2), np.int64
    )
    for start in range(0, len(points), block):
        n = min(block, len(points) - start)
        low = points[start].copy()
        high = points[start].copy()
        for i in range(n):
            for axis in range(3):
                x[axis, i] = points[start + i, axis]
                low[axis], high[axis] = min(low[axis], x[axis, i]), max(high[axis], x[axis, i])
        block_points = x[:, :n]
        sums = out[start : start + n]
        sums[:] = 0
        n_stacked = 0
        for patch in range(level_starts[n_levels - 1], level_starts[n_levels]):
            stack[n_stacked, 0] = patch
            stack[n_stacked, 1] = n_levels - 1
            n_stacked += 1
        while n_stacked > 0:
            n_stacked -= 1
            patch = stack[n_stacked, 0]
            level = stack[n_stacked, 1]
            squared_gap = 0.0
            for axis in range(3):
                gap = patches[patch, axis] - min(max(patches[patch, axis], low[axis]), high[axis])
                squared_gap += gap * gap
            if squared_gap >= min_distances[patch] ** 2:
                is_far[:n] = 1
                add_series(patches[patch], 1.0, 0.0, patches[patch], block_points, is_far, sums)
            elif level > 0:
                children = level_starts[level - 1] + branching * (patch - level_starts[level])
                for child in range(children, min(children + branching, level_starts[level])):
                    stack[n_stacked, 0] = child
                    stack[n_stacked, 1] = level - 1
                    n_stacked += 1
            else:
                add_face(
                    patches[patch], squared_limits[patch], faces[patch], block_points, is_far, sums
                )


@compiled()
def add_series(
    patch: Floats,
    scale: float,
    share: float,
    target: Floats,
    points: Floats,
    is_far: Floats,
    sums: Floats,
) -> None:
    """Add the series of a patch (10,), A/r + A (3/2 dᵀCd − ½ tr C r²)/r⁵, where points (3, n) have `is_far` (n,) = 1.

    The patch is first scaled by `scale` about its centre, and moved by `share` of the way to the point `target` (3,).
    """
    c0 = patch[0] + share * (target[0] - patch[0])
    c1 = patch[1] + share * (target[1] - patch[1])
    c2 = patch[2] + share * (target[2] - patch[2])
    area = patch[3] * scale**2
    f0 = patch[4] * scale**4
    f1 = patch[5] * scale**4
    f2 = patch[6] * scale**4
    f3 = patch[7] * scale**4
    f4 = patch[8] * scale**4
    f5 = patch[9] * scale**4
    for i in range(points.shape[1]):
        a = c0 - points[0, i]
        b = c1 - points[1, i]
        c = c2 - points[2, i]
        # A patch at the point itself is never far, so its term is multiplied by 0 below.
        inverse = 1 / max(a * a + b * b + c * c, 1e-24)
        second = a * (f0 * a + f3 * b + f4 * c) + b * (f1 * b + f5 * c) + f2 * c * c
        sums[i] += is_far[i] * (area + second * (inverse * inverse)) * math.sqrt(inverse)


@compiled()
def add_face(
    patch: Floats, squared_limit: float, face: Floats, points: Floats, is_far: Floats, sums: Floats
) -> None:
    """Add the potential of one face at points (3, n): by the series of its quarters, or near it in closed form."""
    n_far = 0
    for i in range(points.shape[1]):
        a = patch[0] - points[0, i]
        b = patch[1] - points[1, i]
        c = patch[2] - points[2, i]
        if a * a + b * b + c * c < squared_limit:
            is_far[i] = 0
            sums[i] += near_potential(face, points[0, i], points[1, i], points[2, i])
        else:
            is_far[i] = 1
            n_far += 1
    if n_far > 0:
        # The quarters have half of the face's size: three lie half-way to its corners, one in its middle.
        for corner in range(3):
            add_series(patch, 0.5, 0.5, face[3 * corner : 3 * corner + 3], points, is_far, sums)
        add_series(patch, 0.5, 0.0, face, points, is_far, sums)


@compiled()
def near_potential(face: Floats, x: float, y: float, z: float) -> float:
    """Return the potential of a face (25,) at a point, in closed form.

    It is −|h Ω| + Σ p ln((r + r' + l)/(r + r' − l)), summed over the sides. For a side of length l, p is the distance
    of the point's projection from the line of the side, positive inside, and r, r' are the distances of the point from
    its ends. The height h is the distance of the point from the plane, and Ω the solid angle of the face (Van Oosterom
    and Strackee 1983). On a side, p and the denominator both vanish: the term is 0.

    The entries of a face are its corners, its normal, the outward normals of its sides in its plane, the lengths of its
    sides, and twice its area.
    """
    a = (face[0] - x, face[1] - y, face[2] - z)
    b = (face[3] - x, face[4] - y, face[5] - z)
    c = (face[6] - x, face[7] - y, face[8] - z)
    r = math.sqrt(dot(a, a))
    s = math.sqrt(dot(b, b))
    t = math.sqrt(dot(c, c))
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
    """Return ln((r + r' + l)/(r + r' − l)) for a side of length l, from the sum r + r' of the distances to its ends."""
    return math.log((total + length) / max(total - length, _TINY))
