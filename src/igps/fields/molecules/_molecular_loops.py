"""Compiled loops over the balls of a molecule: where a probe fits, and how far each grid point is from there."""

import math

import numpy as np
from numpy.typing import NDArray

from igps._arrays import Floats, Integers, Singles
from igps._compiled import compiled

_TURN = 2 * math.pi


@compiled()
def exposed_arcs(
    centres: Floats, radii: Floats, first: Integers, neighbours: Integers
) -> tuple[Floats, Integers]:
    """Return the arcs in which two spheres intersect outside all other balls, and which balls (A,) are exposed.

    No ball lies inside another. The neighbours of ball i, which intersect it, are `neighbours[first[i]:first[i + 1]]`.
    Columns of the arcs (N, 12): centre of the circle (3), first axis (3), normal (3), radius, angle of the start from
    the first axis, and angle from start to end, up to 2π. Exposed balls (1, else 0) have an arc or no neighbours.
    """
    arcs = np.empty((256, 12))
    n_arcs = 0
    exposed = np.zeros(len(radii), np.int64)
    max_intervals = 2 * np.max(np.diff(first))  # an interval may be split in two
    starts, ends = np.empty(max_intervals), np.empty(max_intervals)
    for i in range(len(radii)):
        if first[i] == first[i + 1]:
            exposed[i] = 1
        for at in range(first[i], first[i + 1]):
            j = neighbours[at]
            if j < i:
                continue
            ux, uy, uz = (
                centres[j, 0] - centres[i, 0],
                centres[j, 1] - centres[i, 1],
                centres[j, 2] - centres[i, 2],
            )
            apart = math.sqrt(ux * ux + uy * uy + uz * uz)
            ux, uy, uz = ux / apart, uy / apart, uz / apart
            along = (apart * apart + radii[i] ** 2 - radii[j] ** 2) / (2 * apart)
            square = radii[i] ** 2 - along * along
            if square <= 0:
                continue
            radius = math.sqrt(square)
            mx, my, mz = (
                centres[i, 0] + along * ux,
                centres[i, 1] + along * uy,
                centres[i, 2] + along * uz,
            )
            # Any direction across the normal.
            if abs(ux) < 0.6:
                ax, ay, az = 0.0, uz, -uy
            else:
                ax, ay, az = -uz, 0.0, ux
            size = math.sqrt(ax * ax + ay * ay + az * az)
            ax, ay, az = ax / size, ay / size, az / size
            bx, by, bz = uy * az - uz * ay, uz * ax - ux * az, ux * ay - uy * ax
            n_covered = 0
            buried = False
            for other in range(first[i], first[i + 1]):
                k = neighbours[other]
                if k == j:
                    continue
                wx, wy, wz = mx - centres[k, 0], my - centres[k, 1], mz - centres[k, 2]
                square = wx * wx + wy * wy + wz * wz
                if square > (radius + radii[k]) ** 2:
                    continue
                a, b = wx * ax + wy * ay + wz * az, wx * bx + wy * by + wz * bz
                across = math.sqrt(a * a + b * b)
                bound = (radii[k] ** 2 - square - radius * radius) / (2 * radius)
                if bound >= across:
                    buried = True
                    break
                if bound <= -across:
                    continue
                # The circle is outside the ball within this angle of the direction away from its centre.
                half = math.acos(bound / across)
                start = math.atan2(b, a) + half
                start -= _TURN * math.floor(start / _TURN)
                end = start + _TURN - 2 * half
                starts[n_covered], ends[n_covered] = start, end
                n_covered += 1
                if end > _TURN:
                    starts[n_covered], ends[n_covered] = start - _TURN, end - _TURN
                    n_covered += 1
            if buried:
                continue
            order = np.argsort(starts[:n_covered])
            covered_to = 0.0
            for position in range(n_covered + 1):
                start = min(starts[order[position]], _TURN) if position < n_covered else _TURN
                if start > covered_to:
                    if n_arcs == len(arcs):
                        arcs = np.concatenate((arcs, np.empty_like(arcs)))
                    arcs[n_arcs] = (
                        mx,
                        my,
                        mz,
                        ax,
                        ay,
                        az,
                        ux,
                        uy,
                        uz,
                        radius,
                        covered_to,
                        start - covered_to,
                    )
                    n_arcs += 1
                    exposed[i] = exposed[j] = 1
                if position < n_covered:
                    covered_to = max(covered_to, ends[order[position]])
    return arcs[:n_arcs], exposed


@compiled()
def depths(
    centres: Floats, radii: Floats, shape: tuple[int, int, int], spacing: float, margin: float
) -> tuple[Singles, NDArray[np.int32]]:
    """Return the largest depth of each grid point in any ball, at least `-margin`, and that ball, or -1 for none.

    Depths are negative outside all balls. The first grid point is at the origin.
    """
    depth = np.full(shape, -margin, np.float32)
    owner = np.full(shape, -1, np.int32)
    for i in range(len(radii)):
        reach = radii[i] + margin
        x0, x1 = _span(centres[i, 0] - reach, centres[i, 0] + reach, spacing, shape[0])
        y0, y1 = _span(centres[i, 1] - reach, centres[i, 1] + reach, spacing, shape[1])
        for x in range(x0, x1):
            dx = x * spacing - centres[i, 0]
            for y in range(y0, y1):
                dy = y * spacing - centres[i, 1]
                square = reach * reach - dx * dx - dy * dy
                if square <= 0:
                    continue
                half = math.sqrt(square)
                z0, z1 = _span(centres[i, 2] - half, centres[i, 2] + half, spacing, shape[2])
                for z in range(z0, z1):
                    dz = z * spacing - centres[i, 2]
                    deep = np.float32(radii[i] - math.sqrt(dx * dx + dy * dy + dz * dz))
                    if deep > depth[x, y, z]:
                        depth[x, y, z] = deep
                        owner[x, y, z] = i
    return depth, owner


@compiled()
def distances_outside(
    depth: Singles,
    owner: NDArray[np.int32],
    centres: Floats,
    radii: Floats,
    first: Integers,
    neighbours: Integers,
    exposed: Integers,
    arcs: Floats,
    spacing: float,
    reach: float,
) -> Singles:
    """Return the distance of each grid point inside the balls from the space outside all balls.

    The nearest point of that space lies on a sphere, on an arc of two, or at the end of an arc. If it lies on a sphere,
    this is the sphere of the ball in which the grid point is deepest: any point nearer than its sphere lies inside it.

    For the arguments see `depths` and `exposed_arcs`. Distances are cut at `reach`; outside the balls they are `depth`,
    which is negative.
    """
    shape = depth.shape
    distance = np.minimum(depth, np.float32(reach))
    # Grid points whose distance comes from arcs.
    waiting = np.zeros(shape, np.bool_)
    for x in range(shape[0]):
        for y in range(shape[1]):
            for z in range(shape[2]):
                deep = depth[x, y, z]
                if deep <= 0 or deep >= reach:
                    continue
                i = owner[x, y, z]
                free = exposed[i] == 1
                if free and first[i] < first[i + 1]:
                    dx, dy, dz = (
                        x * spacing - centres[i, 0],
                        y * spacing - centres[i, 1],
                        z * spacing - centres[i, 2],
                    )
                    size = math.sqrt(dx * dx + dy * dy + dz * dz)
                    scale = radii[i] / max(size, 1e-9)
                    px, py, pz = (
                        centres[i, 0] + scale * dx,
                        centres[i, 1] + scale * dy,
                        centres[i, 2] + scale * dz,
                    )
                    for at in range(first[i], first[i + 1]):
                        k = neighbours[at]
                        square = (
                            (px - centres[k, 0]) ** 2
                            + (py - centres[k, 1]) ** 2
                            + (pz - centres[k, 2]) ** 2
                        )
                        if square < radii[k] * radii[k]:
                            free = False
                            break
                if not free:
                    waiting[x, y, z] = True
                    distance[x, y, z] = reach
    for n in range(len(arcs)):
        mx, my, mz, ax, ay, az, ux, uy, uz, radius, start, angle = arcs[n]
        bx, by, bz = uy * az - uz * ay, uz * ax - ux * az, ux * ay - uy * ax
        # Pieces of at most 60°, each with a bounding box of its own.
        n_pieces = math.ceil(angle / (math.pi / 3))
        step = angle / n_pieces
        for piece in range(n_pieces):
            t0, t1 = start + piece * step, start + (piece + 1) * step
            c0, s0, c1, s1 = math.cos(t0), math.sin(t0), math.cos(t1), math.sin(t1)
            ex, ey = mx + radius * (c0 * ax + s0 * bx), my + radius * (c0 * ay + s0 * by)
            fx, fy = mx + radius * (c1 * ax + s1 * bx), my + radius * (c1 * ay + s1 * by)
            ez, fz = mz + radius * (c0 * az + s0 * bz), mz + radius * (c1 * az + s1 * bz)
            far = reach + radius * (1 - math.cos(step / 2))
            x0, x1 = _span(min(ex, fx) - far, max(ex, fx) + far, spacing, shape[0])
            y0, y1 = _span(min(ey, fy) - far, max(ey, fy) + far, spacing, shape[1])
            z0, z1 = _span(min(ez, fz) - far, max(ez, fz) + far, spacing, shape[2])
            # The middle of the piece, and the cosine of half its angle.
            ch, sh = math.cos((t0 + t1) / 2), math.sin((t0 + t1) / 2)
            narrow = math.cos(step / 2)
            for x in range(x0, x1):
                for y in range(y0, y1):
                    for z in range(z0, z1):
                        if not waiting[x, y, z]:
                            continue
                        dx, dy, dz = x * spacing - mx, y * spacing - my, z * spacing - mz
                        a = dx * ax + dy * ay + dz * az
                        b = dx * bx + dy * by + dz * bz
                        h = dx * ux + dy * uy + dz * uz
                        across = math.sqrt(a * a + b * b)
                        if a * ch + b * sh >= narrow * across:
                            square = (across - radius) ** 2 + h * h
                        else:
                            square = (
                                (x * spacing - ex) ** 2
                                + (y * spacing - ey) ** 2
                                + (z * spacing - ez) ** 2
                            )
                            other = (
                                (x * spacing - fx) ** 2
                                + (y * spacing - fy) ** 2
                                + (z * spacing - fz) ** 2
                            )
                            square = min(square, other)
                        if square < distance[x, y, z] ** 2:
                            distance[x, y, z] = math.sqrt(square)
    return distance


@compiled()
def _span(low: float, high: float, spacing: float, size: int) -> tuple[int, int]:
    """Return the range of grid points from `low` to `high`."""
    return max(math.ceil(low / spacing), 0), min(math.floor(high / spacing) + 1, size)


@compiled()
def cubic_values(field: Singles, points: Floats) -> Floats:
    """Return the values and gradients (P, 4) of a function at points (P, 3) in cells, by cubic convolution (Keys 1981).

    The grid has at least four points along each axis.
    """
    values = np.empty((len(points), 4))
    weight, slope = np.empty((3, 4)), np.empty((3, 4))
    low = np.empty(3, np.int64)
    for p in range(len(points)):
        for axis in range(3):
            cell = min(max(math.floor(points[p, axis]), 1), field.shape[axis] - 3)
            t = points[p, axis] - cell
            low[axis] = cell - 1
            weight[axis, 0], slope[axis, 0] = (
                0.5 * t * (-1 + t * (2 - t)),
                0.5 * (-1 + t * (4 - 3 * t)),
            )
            weight[axis, 1], slope[axis, 1] = (
                0.5 * (2 + t * t * (3 * t - 5)),
                0.5 * t * (9 * t - 10),
            )
            weight[axis, 2], slope[axis, 2] = (
                0.5 * t * (1 + t * (4 - 3 * t)),
                0.5 * (1 + t * (8 - 9 * t)),
            )
            weight[axis, 3], slope[axis, 3] = 0.5 * t * t * (t - 1), 0.5 * t * (3 * t - 2)
        value = along_x = along_y = along_z = 0.0
        for a in range(4):
            for b in range(4):
                row = rise = 0.0
                for c in range(4):
                    at = field[low[0] + a, low[1] + b, low[2] + c]
                    row += weight[2, c] * at
                    rise += slope[2, c] * at
                value += weight[0, a] * weight[1, b] * row
                along_x += slope[0, a] * weight[1, b] * row
                along_y += weight[0, a] * slope[1, b] * row
                along_z += weight[0, a] * weight[1, b] * rise
        values[p, 0], values[p, 1], values[p, 2], values[p, 3] = value, along_x, along_y, along_z
    return values
