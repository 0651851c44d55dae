"""Cells of a cubic grid inside a surface: scan lines along three axes, and winding numbers where these disagree."""

import math

import numpy as np
from numpy.typing import NDArray

from igps._arrays import Booleans, Floats, Integers
from igps._parameters import check_at_least
from igps.mesh.errors import MeshError
from igps.mesh.limits import check_grid
from igps.mesh.mesh import Mesh
from igps.mesh.surface import box_sides, directed_edges, longest_side
from igps.mesh.winding import winding_number

# Distance from the surface, in units of a cell, within which a cell centre is on the surface and not inside. It is far
# above rounding, so that a moved or turned mesh keeps its samples.
_ON_SURFACE = 1e-6
# Limits of a grid: cells along the longest side, and cells in all, which take about 40 bytes each during the scan.
_MAX_RESOLUTION = 512
_MAX_CELLS = 2**25


def interior_samples(mesh: Mesh, resolution: int = 32, min_samples: int = 0) -> Floats:
    """Return the centres (P, 3), length, of the cubic voxels inside the mesh (Rustamov 2010, section 3).

    The grid is centred on the bounding box, with cells of 1/`resolution` of its longest side. Moving the mesh, or
    turning it by a symmetry of the grid, therefore moves and turns the samples.

    The grid is refined until at least `min_samples` cells are inside; 0 keeps the resolution.

    Raises:
        MeshError: no cell centre is inside, `min_samples` is out of reach, or the grid would fill the memory.
    """
    check_at_least(1, resolution=resolution)
    check_at_least(0, min_samples=min_samples)
    max_resolution = _max_resolution(mesh)
    if resolution > max_resolution:
        raise MeshError(
            f"{mesh.name}: expected a resolution of at most {max_resolution} ({_MAX_RESOLUTION} cells along the "
            f"longest side, {_MAX_CELLS} in all), got {resolution}. Lower the resolution."
        )
    least = max(min_samples, 1)
    while True:
        axes = grid_axes(mesh, resolution)
        n_cells = math.prod(map(len, axes))
        check_grid(n_cells, mesh.name)
        inside = inside_grid(mesh, axes)
        count = int(inside.sum())
        if count >= least:
            return _centres(axes, inside)
        if min_samples == 0 or resolution >= max_resolution:
            remedy = "raise the resolution, or set min_samples to refine it"
            if min_samples:
                remedy = "lower min_samples"
            raise MeshError(
                f"{mesh.name}: expected at least {least} cells inside, got {count} in a grid of "
                f"{resolution} along the longest side. "
                f"The body is too thin for this grid: {remedy}."
            )
        # The count grows with the cube of the resolution, and for a thin body more slowly.
        # Therefore `min_samples` is approached from below, by factors of 1.05 to 2.
        growth = (min_samples / max(count, 1)) ** (1 / 3)
        factor = min(max(growth, 1.05), 2.0)
        resolution = min(math.ceil(resolution * factor), max_resolution)


def _centres(axes: tuple[Floats, ...], is_chosen: Booleans) -> Floats:
    """Return the centres (P, 3) of the chosen cells (X, Y, Z)."""
    x_axis, y_axis, z_axis = axes
    x, y, z = np.nonzero(is_chosen)
    return np.column_stack([x_axis[x], y_axis[y], z_axis[z]])


def _max_resolution(mesh: Mesh) -> int:
    """Return the largest resolution whose grid is within the limits."""
    sides = box_sides(mesh.vertices)
    sides = sides / sides.max()
    resolution = _MAX_RESOLUTION
    while np.prod(np.ceil(sides * resolution).clip(1)) > _MAX_CELLS:
        resolution -= 1
    return resolution


def grid_axes(mesh: Mesh, resolution: int) -> tuple[Floats, Floats, Floats]:
    """Return the coordinates of the cell centres along x, y and z of the cubic grid centred on the bounding box."""
    low = mesh.vertices.min(axis=0)
    high = mesh.vertices.max(axis=0)
    sides = high - low
    middle = (low + high) / 2
    cell = sides.max() / resolution
    # A small tolerance keeps a side of exactly n cells at n cells in spite of rounding.
    counts = np.ceil(sides / cell - 1e-6).clip(1)
    axes = []
    for centre, count in zip(middle, counts, strict=True):
        from_middle = np.arange(count) - (count - 1) / 2
        axes.append(centre + from_middle * cell)
    x_axis, y_axis, z_axis = axes
    return x_axis, y_axis, z_axis


def inside_grid(mesh: Mesh, axes: tuple[Floats, Floats, Floats]) -> Booleans:
    """Return booleans (X, Y, Z): whether points of a grid are inside the surface, with a winding number above one half.

    Along each axis, the signed crossings of every grid line are summed from both ends. On a closed mesh the six sums
    agree with the winding number. If a line passes through a hole, the other five sums outvote its sum; if more
    disagree, the winding number is computed from solid angles (Jacobson et al. 2013). Surface points are outside.
    """
    shape = tuple(map(len, axes))
    votes = np.zeros(shape, dtype=np.int8)
    on_surface = np.zeros(shape, dtype=bool)
    for order in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        first, second, third = order
        scanned = (axes[first], axes[second], axes[third])
        voting, touching = _scan(mesh.vertices[:, order], mesh.faces, scanned)
        back = np.argsort(order)
        votes += voting.transpose(back)
        on_surface |= touching.transpose(back)
    inside = votes >= 5
    is_doubtful = (votes > 1) & (votes < 5) & ~on_surface
    if is_doubtful.any():
        points = _centres(axes, is_doubtful)
        inside[is_doubtful] = winding_number(mesh.vertices, mesh.faces, points) > 0.5
    return inside & ~on_surface


def _scan(
    vertices: Floats, faces: Integers, axes: tuple[Floats, Floats, Floats]
) -> tuple[NDArray[np.int8], Booleans]:
    """Return how many sums of signed crossings along the first axis say inside, of those after and before each point.

    Return also which points are on the surface.
    """
    x_axis, y_axis, z_axis = axes
    crossing, column, row, signs = _crossings(vertices, faces, y_axis, z_axis)
    # A crossing counts for all points of its line with smaller x: enter it where their suffix sum starts.
    position = np.searchsorted(x_axis, crossing)
    size = (len(x_axis) + 1, len(y_axis), len(z_axis))
    flat = np.ravel_multi_index((position, column, row), size)
    counts = np.bincount(flat, weights=signs, minlength=math.prod(size))
    crossings = counts.reshape(size).astype(np.int32)
    # The points with smaller x than a crossing have indices below its position.
    after = np.cumsum(crossings[::-1], axis=0)[::-1]
    before = -np.cumsum(crossings, axis=0)
    votes = (after[1:] > 0).astype(np.int8)
    votes += before[:-1] > 0

    on_surface = np.zeros(votes.shape, dtype=bool)
    tolerance = _ON_SURFACE * _cell_size(axes, vertices)
    for neighbour in (position - 1, position):
        neighbour = np.clip(neighbour, 0, len(x_axis) - 1)
        is_close = np.abs(x_axis[neighbour] - crossing) < tolerance
        on_surface[neighbour[is_close], column[is_close], row[is_close]] = True
    return votes, on_surface


def _crossings(
    vertices: Floats, faces: Integers, y_axis: Floats, z_axis: Floats
) -> tuple[Floats, Integers, Integers, Integers]:
    """Return where lines along x, through points of a grid, cross the surface: x, index of y, index of z, and sign.

    Every comparison belongs to one edge and has the same result in both faces of the edge. A line through an edge or a
    vertex therefore crosses exactly one of the faces that meet there: ties are resolved as if the line were moved by an
    infinitesimal amount (Edelsbrunner and Mücke 1990), never by rounding.
    """
    # Rows: where each edge crosses each plane z = const, half-open in z. The edge runs from its lower to its upper end
    # whatever the face, so both faces compute the same point.
    start, end = directed_edges(faces)
    is_upward = vertices[start, 2] < vertices[end, 2]
    low = np.where(is_upward, start, end)
    high = np.where(is_upward, end, start)
    first = np.searchsorted(z_axis, vertices[low, 2])
    last = np.searchsorted(z_axis, vertices[high, 2])
    half_edge, row = _ranges(first, last)
    a = vertices[low[half_edge]]
    edge = vertices[high[half_edge]] - a
    t = (z_axis[row] - a[:, 2]) / edge[:, 2]
    x = a[:, 0] + t * edge[:, 0]
    y = a[:, 1] + t * edge[:, 1]
    # A plane that crosses a face crosses exactly two of its edges, one upward and one downward: pair them.
    order = np.lexsort((is_upward[half_edge], row, half_edge // 3))
    down = order[0::2]
    up = order[1::2]
    row = row[up]

    # Columns: the points of each such segment on the lines y = const, half-open in y.
    column_down = np.searchsorted(y_axis, y[down])
    column_up = np.searchsorted(y_axis, y[up])
    first = np.minimum(column_down, column_up)
    last = np.maximum(column_down, column_up)
    segment, column = _ranges(first, last)
    # +1 where the outward normal points towards +x: seen from there, the upward edge has the larger y.
    signs = np.where(column_up > column_down, 1, -1)[segment]
    row = row[segment]
    down = down[segment]
    up = up[segment]
    t = (y_axis[column] - y[down]) / (y[up] - y[down])
    crossing = x[down] + t * (x[up] - x[down])
    return crossing, column, row, signs


def _cell_size(axes: tuple[Floats, ...], vertices: Floats) -> float:
    for axis in axes:
        # An axis across a flat body may have only one point.
        if len(axis) > 1:
            return float(axis[1] - axis[0])
    return longest_side(vertices)


def _ranges(first: Integers, last: Integers) -> tuple[Integers, Integers]:
    """Return all pairs (i, k) with first[i] ≤ k < last[i], in order."""
    lengths = np.maximum(last - first, 0)
    owner = np.repeat(np.arange(len(first)), lengths)
    starts = np.cumsum(lengths) - lengths
    shifts = first - starts
    return owner, np.arange(len(owner)) + shifts[owner]
