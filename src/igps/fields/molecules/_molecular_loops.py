"""Compiled loops over the balls of a molecule: where a probe fits, and how far each grid point is from there."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from igps._arrays import Booleans, Floats, Integers, Singles
from igps._compiled import ALLOCATES, compiled

_TURN = 2 * math.pi
_SECTOR = _TURN / 32
_ALL_SECTORS = 2**32 - 1


class Balls(NamedTuple):
    """Balls of which none lies inside another.

    Args:
        centres: (N, 3) positions.
        radii: (N,) lengths.
        first: (N + 1,) positions in `neighbours`.
        neighbours: those of ball i, which intersect it, are `neighbours[first[i]:first[i + 1]]`.
    """

    centres: Floats
    radii: Floats
    first: Integers
    neighbours: Integers


class _Circle(NamedTuple):
    """A circle in space: its centre, two axes in its plane (a, b), its normal (u) and its radius."""

    mx: float
    my: float
    mz: float
    ax: float
    ay: float
    az: float
    bx: float
    by: float
    bz: float
    ux: float
    uy: float
    uz: float
    radius: float


@compiled(**ALLOCATES)
def exposed_arcs(balls: Balls) -> tuple[Floats, Integers]:
    """Return the arcs in which two spheres intersect outside all other balls, and which balls (A,) are exposed.

    Columns of the arcs (N, 12): centre of the circle (3), first axis (3), normal (3), radius, angle of the start from
    the first axis, and angle from start to end, up to 2π. Exposed balls (1, else 0) have an arc or no neighbours.
    """
    first = balls.first
    arcs = np.empty((256, 12))
    n_arcs = 0
    exposed = np.zeros(len(balls.radii), np.int64)
    max_intervals = 2 * np.max(np.diff(first))  # an interval may be split in two
    starts = np.empty(max_intervals)
    ends = np.empty(max_intervals)
    for i in range(len(balls.radii)):
        if first[i] == first[i + 1]:
            exposed[i] = 1
        for at in range(first[i], first[i + 1]):
            j = balls.neighbours[at]
            if j < i:
                continue
            circle = _circle(balls, i, j)
            if circle.radius <= 0:
                continue
            n_covered = _cover(circle, balls, i, j, starts, ends)
            if n_covered < 0:
                continue
            order = np.argsort(starts[:n_covered])
            covered_to = 0.0
            for position in range(n_covered + 1):
                start = min(starts[order[position]], _TURN) if position < n_covered else _TURN
                if start > covered_to:
                    if n_arcs == len(arcs):
                        arcs = np.concatenate((arcs, np.empty_like(arcs)))
                    _fill_row(arcs[n_arcs], circle, covered_to, start - covered_to)
                    n_arcs += 1
                    exposed[i] = exposed[j] = 1
                if position < n_covered:
                    covered_to = max(covered_to, ends[order[position]])
    return arcs[:n_arcs], exposed


@compiled()
def _circle(balls: Balls, i: int, j: int) -> _Circle:
    """Return the circle in which two spheres intersect; its radius is 0 if they touch or do not meet."""
    centres = balls.centres
    radii = balls.radii
    ux = centres[j, 0] - centres[i, 0]
    uy = centres[j, 1] - centres[i, 1]
    uz = centres[j, 2] - centres[i, 2]
    apart = math.sqrt(ux * ux + uy * uy + uz * uz)
    ux = ux / apart
    uy = uy / apart
    uz = uz / apart
    along = (apart * apart + radii[i] ** 2 - radii[j] ** 2) / (2 * apart)
    square = radii[i] ** 2 - along * along
    radius = math.sqrt(square) if square > 0 else 0.0
    # Any direction across the normal.
    if abs(ux) < 0.6:
        ax = 0.0
        ay = uz
        az = -uy
    else:
        ax = -uz
        ay = 0.0
        az = ux
    size = math.sqrt(ax * ax + ay * ay + az * az)
    ax = ax / size
    ay = ay / size
    az = az / size
    return _Circle(
        centres[i, 0] + along * ux,
        centres[i, 1] + along * uy,
        centres[i, 2] + along * uz,
        ax,
        ay,
        az,
        uy * az - uz * ay,
        uz * ax - ux * az,
        ux * ay - uy * ax,
        ux,
        uy,
        uz,
        radius,
    )


@compiled()
def _fill_row(row: Floats, circle: _Circle, start: float, angle: float) -> None:
    """Write an arc of a circle as a row of `exposed_arcs`."""
    row[0] = circle.mx
    row[1] = circle.my
    row[2] = circle.mz
    row[3] = circle.ax
    row[4] = circle.ay
    row[5] = circle.az
    row[6] = circle.ux
    row[7] = circle.uy
    row[8] = circle.uz
    row[9] = circle.radius
    row[10] = start
    row[11] = angle


@compiled()
def _cover(circle: _Circle, balls: Balls, i: int, j: int, starts: Floats, ends: Floats) -> int:
    """Write the intervals of a circle of balls i and j that other balls cover, and return how many; -1 if all of it."""
    n_covered = 0
    sectors = 0  # those of 32 that are covered, as bits: most circles are covered before all balls are looked at
    for at in range(balls.first[i], balls.first[i + 1]):
        k = balls.neighbours[at]
        if k == j:
            continue
        wx = circle.mx - balls.centres[k, 0]
        wy = circle.my - balls.centres[k, 1]
        wz = circle.mz - balls.centres[k, 2]
        square = wx * wx + wy * wy + wz * wz
        if square > (circle.radius + balls.radii[k]) ** 2:
            continue
        a = wx * circle.ax + wy * circle.ay + wz * circle.az
        b = wx * circle.bx + wy * circle.by + wz * circle.bz
        across = math.sqrt(a * a + b * b)
        rest = balls.radii[k] ** 2 - square - circle.radius * circle.radius
        bound = rest / (2 * circle.radius)
        if bound >= across:
            return -1
        if bound <= -across:
            continue
        # The circle is outside the ball within this angle of the direction away from its centre.
        half = math.acos(bound / across)
        start = math.atan2(b, a) + half
        start -= _TURN * math.floor(start / _TURN)
        end = start + _TURN - 2 * half
        for sector in range(math.ceil(start / _SECTOR), math.floor(end / _SECTOR)):
            sectors |= 1 << (sector % 32)
        if sectors == _ALL_SECTORS:
            return -1
        starts[n_covered] = start
        ends[n_covered] = end
        n_covered += 1
        if end > _TURN:
            starts[n_covered] = start - _TURN
            ends[n_covered] = end - _TURN
            n_covered += 1
    return n_covered


@compiled(**ALLOCATES)
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


@compiled(**ALLOCATES)
def distances_outside(
    depth: Singles,
    owner: NDArray[np.int32],
    balls: Balls,
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
                if exposed[i] == 0 or _is_covered(balls, i, x * spacing, y * spacing, z * spacing):
                    waiting[x, y, z] = True
                    distance[x, y, z] = reach
    for n in range(len(arcs)):
        # Pieces of at most 60°, each with a bounding box of its own.
        angle = arcs[n, 11]
        n_pieces = math.ceil(angle / (math.pi / 3))
        step = angle / n_pieces
        for piece in range(n_pieces):
            start = arcs[n, 10] + piece * step
            end = arcs[n, 10] + (piece + 1) * step
            _reduce_by_arc(distance, waiting, arcs[n, :10], (start, end, step), spacing, reach)
    return distance


@compiled()
def _is_covered(balls: Balls, i: int, x: float, y: float, z: float) -> bool:
    """Return whether the point of the sphere of ball i that is nearest to a point lies inside another ball."""
    centres = balls.centres
    dx = x - centres[i, 0]
    dy = y - centres[i, 1]
    dz = z - centres[i, 2]
    size = math.sqrt(dx * dx + dy * dy + dz * dz)
    scale = balls.radii[i] / max(size, 1e-9)
    px = centres[i, 0] + scale * dx
    py = centres[i, 1] + scale * dy
    pz = centres[i, 2] + scale * dz
    for at in range(balls.first[i], balls.first[i + 1]):
        k = balls.neighbours[at]
        kx = px - centres[k, 0]
        ky = py - centres[k, 1]
        kz = pz - centres[k, 2]
        if kx**2 + ky**2 + kz**2 < balls.radii[k] * balls.radii[k]:
            return True
    return False


@compiled(**ALLOCATES)
def exposed_areas(balls: Balls, directions: Floats) -> Floats:
    """Return the area of each sphere outside all other balls, by the share of its points in these directions (M, 3)."""
    areas = np.zeros(len(balls.radii))
    for i in range(len(areas)):
        radius = balls.radii[i]
        n_exposed = 0
        for n in range(len(directions)):
            x = balls.centres[i, 0] + radius * directions[n, 0]
            y = balls.centres[i, 1] + radius * directions[n, 1]
            z = balls.centres[i, 2] + radius * directions[n, 2]
            if not _is_covered(balls, i, x, y, z):
                n_exposed += 1
        areas[i] = 4 * math.pi * radius**2 * n_exposed / len(directions)
    return areas


@compiled()
def _reduce_by_arc(
    distance: Singles,
    waiting: Booleans,
    circle: Floats,
    angles: tuple[float, float, float],
    spacing: float,
    reach: float,
) -> None:
    """Lower the distances of waiting grid points to those from an arc, given its angles of start, end and between."""
    shape = distance.shape
    mx, my, mz, ax, ay, az, ux, uy, uz, radius = circle
    start, end, step = angles
    bx = uy * az - uz * ay
    by = uz * ax - ux * az
    bz = ux * ay - uy * ax
    # The ends of the arc, e and f.
    c0 = math.cos(start)
    s0 = math.sin(start)
    c1 = math.cos(end)
    s1 = math.sin(end)
    ex = mx + radius * (c0 * ax + s0 * bx)
    ey = my + radius * (c0 * ay + s0 * by)
    ez = mz + radius * (c0 * az + s0 * bz)
    fx = mx + radius * (c1 * ax + s1 * bx)
    fy = my + radius * (c1 * ay + s1 * by)
    fz = mz + radius * (c1 * az + s1 * bz)
    far = reach + radius * (1 - math.cos(step / 2))
    x0, x1 = _span(min(ex, fx) - far, max(ex, fx) + far, spacing, shape[0])
    y0, y1 = _span(min(ey, fy) - far, max(ey, fy) + far, spacing, shape[1])
    z0, z1 = _span(min(ez, fz) - far, max(ez, fz) + far, spacing, shape[2])
    # The middle of the arc, and the cosine of half its angle.
    ch = math.cos((start + end) / 2)
    sh = math.sin((start + end) / 2)
    narrow = math.cos(step / 2)
    for x in range(x0, x1):
        for y in range(y0, y1):
            for z in range(z0, z1):
                if not waiting[x, y, z]:
                    continue
                dx = x * spacing - mx
                dy = y * spacing - my
                dz = z * spacing - mz
                a = dx * ax + dy * ay + dz * az
                b = dx * bx + dy * by + dz * bz
                h = dx * ux + dy * uy + dz * uz
                across = math.sqrt(a * a + b * b)
                if a * ch + b * sh >= narrow * across:
                    square = (across - radius) ** 2 + h * h
                else:
                    to_start = _square(x * spacing - ex, y * spacing - ey, z * spacing - ez)
                    to_end = _square(x * spacing - fx, y * spacing - fy, z * spacing - fz)
                    square = min(to_start, to_end)
                if square < distance[x, y, z] ** 2:
                    distance[x, y, z] = math.sqrt(square)


@compiled()
def _square(x: float, y: float, z: float) -> float:
    """Return the squared length of a vector."""
    return x**2 + y**2 + z**2


@compiled()
def _span(low: float, high: float, spacing: float, size: int) -> tuple[int, int]:
    """Return the range of grid points from `low` to `high`."""
    return max(math.ceil(low / spacing), 0), min(math.floor(high / spacing) + 1, size)


@compiled(**ALLOCATES)
def cubic_values(field: Singles, points: Floats) -> Floats:
    """Return the values and gradients (P, 4) of a function at points (P, 3) in cells, by cubic convolution (Keys 1981).

    The grid has at least four points along each axis.
    """
    values = np.empty((len(points), 4))
    weight = np.empty((3, 4))
    slope = np.empty((3, 4))
    low = np.empty(3, np.int64)
    for p in range(len(points)):
        for axis in range(3):
            cell = min(max(math.floor(points[p, axis]), 1), field.shape[axis] - 3)
            t = points[p, axis] - cell
            low[axis] = cell - 1
            weight[axis, 0] = 0.5 * t * (-1 + t * (2 - t))
            weight[axis, 1] = 0.5 * (2 + t * t * (3 * t - 5))
            weight[axis, 2] = 0.5 * t * (1 + t * (4 - 3 * t))
            weight[axis, 3] = 0.5 * t * t * (t - 1)
            slope[axis, 0] = 0.5 * (-1 + t * (4 - 3 * t))
            slope[axis, 1] = 0.5 * t * (9 * t - 10)
            slope[axis, 2] = 0.5 * (1 + t * (8 - 9 * t))
            slope[axis, 3] = 0.5 * t * (3 * t - 2)
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
        values[p, 0] = value
        values[p, 1] = along_x
        values[p, 2] = along_y
        values[p, 3] = along_z
    return values


@compiled(**ALLOCATES)
def means_at_vertices(values: Floats, vertices: Floats, faces: Integers) -> Floats:
    """Return the means (V, D), weighted by area, of the values (F, D) of the faces around each vertex."""
    means = np.zeros((len(vertices), values.shape[1]))
    total = np.full(len(vertices), 1e-300)
    for face in range(len(faces)):
        i, j, k = faces[face]
        ux, uy, uz = _difference(vertices, j, i)
        vx, vy, vz = _difference(vertices, k, i)
        area = math.sqrt(_square(uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx))
        for at in (i, j, k):
            total[at] += area
            for column in range(values.shape[1]):
                means[at, column] += area * values[face, column]
    return means / total.reshape(-1, 1)


@compiled()
def _difference(vertices: Floats, a: int, b: int) -> tuple[float, float, float]:
    """Return the vector from vertex b to vertex a."""
    return (
        vertices[a, 0] - vertices[b, 0],
        vertices[a, 1] - vertices[b, 1],
        vertices[a, 2] - vertices[b, 2],
    )
