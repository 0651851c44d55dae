"""Compute the signed distances of grid points to the surface of one body, negative inside. Lengths are in cells."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse

from igps._arrays import Booleans, Floats, Integers, Singles
from igps.mesh._outside import MARGIN, WALL, OrientedSurface
from igps.mesh.surface import box_sides, edge_keys, face_areas

# Maximal exact distance: marching cubes need distances at both ends of the grid edges that cross the surface.
_BAND = 1.1
# Half the thickness of a sheet. Above half a cell, because a sheet may lie midway between two layers of grid points.
_HALF_SHEET = 0.55
MIN_ABS_VALUE = 0.02  # closer to zero, marching cubes would make triangles without area
_MIN_BAR_RADIUS = 0.9
SPECK_VOLUME = 2e-3  # pieces of less than this share of the volume are specks


@dataclass(frozen=True)
class Grid:
    """Regular grid of points."""

    origin: Floats  # (3,) first grid point
    cell: float  # distance between grid points
    shape: tuple[int, int, int]

    @classmethod
    def around(cls, vertices: Floats, faces: Integers, cell: float) -> Self:
        low = vertices[faces].min(axis=(0, 1))
        high = vertices[faces].max(axis=(0, 1))
        n_cells = np.ceil((high - low) / cell).astype(int) + 2 * MARGIN
        shape = n_cells + 1
        # The grid is centred on the body, so that it moves with the body.
        origin = (low + high) / 2 - n_cells / 2 * cell
        n_x, n_y, n_z = shape.tolist()
        return cls(origin, cell, (n_x, n_y, n_z))

    def to_cells(self, points: Floats) -> Floats:
        return (points - self.origin) / self.cell

    def from_cells(self, points: Floats) -> Floats:
        return points * self.cell + self.origin


def cell_sizes(
    vertices: Floats, faces: Integers, resolution: int, spacing: float
) -> tuple[float, float]:
    """Return the default and the minimal size of a cell, which differ only for long bodies.

    With the minimal size the grid has about as many cells, in all and on the surface, as a cube of side `resolution`.
    With the default size it has at most 2 * `resolution` cells along the longest side.
    """
    corners = vertices[faces].reshape(-1, 3)
    sides = box_sides(corners)
    longest = float(sides.max())
    thick_sides = np.maximum(sides, longest / 1000)
    volume = float(np.prod(thick_sides))
    by_volume = volume ** (1 / 3) / resolution
    area = float(face_areas(vertices, faces).sum())
    by_area = math.sqrt(area / (6 * resolution**2))
    min_size = max(by_volume, by_area)
    min_size = min(min_size, longest / (0.8 * resolution))
    min_size = max(min_size, spacing)
    default_size = max(min_size, longest / (2 * resolution))
    return default_size, min_size


def distances(
    vertices: Floats, faces: Integers, shape: tuple[int, int, int]
) -> tuple[Singles, Singles]:
    """Return the distances (X, Y, Z), infinite beyond the band, and the nearest surface points (X, Y, Z, 3)."""
    import igl

    vertices = np.asfortranarray(vertices)
    faces = np.asfortranarray(faces)

    def nearest_to(points: NDArray[Any]) -> tuple[Floats, Floats]:
        """Return the squared distances (P,) of points (P, 3), and their nearest surface points (P, 3)."""
        points = np.asfortranarray(points, dtype=np.float64)
        squared, _, feet = igl.point_mesh_squared_distance(points, vertices, faces)
        return squared, feet

    size = 8  # blocks that may be near the surface are halved until they are single grid points
    blocks = _all_combinations([np.arange(0, n, size) for n in shape])
    while size > 1:
        to_centre = (size - 1) / 2
        squared, _ = nearest_to(blocks + to_centre)
        near = np.sqrt(squared) <= to_centre * np.sqrt(3) + _BAND
        size //= 2
        halves = size * _all_combinations([np.arange(2)] * 3)
        blocks = blocks[near][:, None] + halves
        blocks = blocks.reshape(-1, 3)
        is_in_grid = (blocks < shape).all(axis=1)
        blocks = blocks[is_in_grid]
    squared, feet = nearest_to(blocks)
    distance = np.full(shape, np.inf, dtype=np.float32)
    nearest = np.zeros((*shape, 3), dtype=np.float32)
    in_band = squared <= _BAND**2
    at = tuple(blocks[in_band].T)
    distance[at] = np.sqrt(squared[in_band])
    nearest[at] = feet[in_band]
    return distance, nearest


def _all_combinations(axes: Sequence[Integers]) -> Integers:
    """Return all points (P, 3) of a grid with these coordinates along its axes."""
    coordinates = np.meshgrid(*axes, indexing="ij")
    return np.stack(coordinates, axis=-1).reshape(-1, 3)


def level_set(
    distance: Singles, nearest: Singles, outside: Booleans, surface: OrientedSurface
) -> Singles:
    """Return the signed distance to the surface; sheets, which enclose nothing, get about a cell of thickness."""
    # Grid points near the surface, by their numbers in the flattened grid
    band = np.flatnonzero(np.isfinite(distance))
    points = _points_at(band, distance.shape)
    feet = nearest.reshape(-1, 3)[band]
    heights = np.take(distance, band)
    lengths = np.maximum(heights, 1e-6)
    normals = (points - feet) / lengths[:, None]
    inside = _inside(distance, outside, band, feet, normals)
    is_solid = _is_solid(inside, band, feet, normals)
    if surface.is_nearly_closed and not is_solid.all():
        # A flood cannot find the inside of walls that are thinner than a cell; the winding number can.
        thin = band[~is_solid]
        winding = surface.winding(_points_at(thin, distance.shape))
        np.put(inside, thin[winding > 0.5], True)
        is_solid = _is_solid(inside, band, feet, normals)
    # At least MIN_ABS_VALUE, because zero would have no sign.
    clipped = np.clip(distance, np.float32(MIN_ABS_VALUE), np.float32(_BAND))
    field = np.where(inside, -1, 1) * clipped
    sheet = band[~is_solid]
    np.put(field, sheet, np.take(distance, sheet) - _HALF_SHEET)
    smallest = np.where(field < 0, -MIN_ABS_VALUE, MIN_ABS_VALUE)
    field = np.where(np.abs(field) < MIN_ABS_VALUE, smallest, field)
    return fill_bubbles(field.astype(np.float32))


def _inside(
    distance: Singles, outside: Booleans, band: Integers, feet: NDArray[Any], normals: NDArray[Any]
) -> Booleans:
    """Return which grid points are inside: those beyond the walls that the flood misses, and wall points beside them.

    A wall point belongs to the side beyond it, away from the surface; if only wall lies beyond, to the side of its
    deepest neighbours.
    """
    from skimage.segmentation import watershed

    is_wall = distance <= WALL
    sides = np.where(outside, 1, 2)
    sides = np.where(is_wall, 0, sides).astype(np.int32)
    undecided = np.flatnonzero(np.take(is_wall, band))
    for step in (0.75, 1.0, 1.25):
        beyond = _nearest_values(sides, feet[undecided] + step * normals[undecided])
        is_decided = beyond > 0
        np.put(sides, band[undecided[is_decided]], beyond[is_decided])
        undecided = undecided[~is_decided]
    depth = np.where(np.isfinite(distance), distance, _BAND)
    return np.asarray(watershed(-depth, sides, connectivity=3) == 2)


def _is_solid(
    inside: Booleans, band: Integers, feet: NDArray[Any], normals: NDArray[Any]
) -> Booleans:
    """Return whether each point of the band is inside, or has an inside behind its nearest surface point."""
    is_solid = np.take(inside, band)
    for step in (0.25, 0.5, 0.75, 1.0):
        is_solid |= _nearest_values(inside, feet - step * normals)
    return is_solid


def _points_at(numbers: Integers, shape: tuple[int, ...]) -> Integers:
    """Return the grid points (P, 3) with these numbers in the flattened grid."""
    return np.column_stack(np.unravel_index(numbers, shape))


def _nearest_values(values: NDArray[Any], points: NDArray[Any]) -> NDArray[Any]:
    last = np.array(values.shape) - 1
    index = np.round(points).astype(np.int64)
    index = np.clip(index, 0, last)
    return np.asarray(values[tuple(index.T)])


def fill_bubbles(field: Singles) -> Singles:
    """Make everything part of the body, in place, that is not connected with the outside."""
    label, count = ndimage.label(field > 0)
    if count > 1:
        is_bubble = (field > 0) & (label != label[0, 0, 0])
        field[is_bubble] = -MIN_ABS_VALUE
    return field


def join_pieces(field: Singles, notes: list[str], radius: float = 0.0) -> Singles:
    """Drop small pieces, in place, and join the others by bars where the gaps are narrowest."""
    label, count = ndimage.label(field < 0)
    if count < 2:
        return field
    volume = np.bincount(label.ravel(), minlength=count + 1)
    volume[0] = 0
    total = volume.sum()
    specks = np.flatnonzero(volume < SPECK_VOLUME * total)[1:]
    if len(specks) and volume[specks].sum() < 0.05 * total:
        is_dropped = np.isin(label, specks)
        field[is_dropped] = -field[is_dropped]
        label[is_dropped] = 0
    n_pieces = len(np.unique(label)) - 1
    if n_pieces < 2:
        return field
    bar_radius = max(radius, _MIN_BAR_RADIUS)
    starts, ends = _narrowest_gaps(label)
    for a, b in zip(starts, ends, strict=True):
        _add_bar(field, a, b, bar_radius)
    notes.append(f"joined {n_pieces} pieces by bars")
    return fill_bubbles(field)


def _narrowest_gaps(label: NDArray[np.int32]) -> tuple[Floats, Floats]:
    """Return both ends (L, 3) of gaps between pieces, given by labels, that join all with the least total length."""
    # The width of a gap is measured where the regions touch that are nearest to either piece.
    distance, index = ndimage.distance_transform_edt(label == 0, return_indices=True)
    owner = label[tuple(index)]
    start, end = _borders(owner)
    width = np.take(distance, start) + np.take(distance, end) + 1
    n_labels = int(label.max()) + 1
    first = np.take(owner, start).astype(np.int64)
    second = np.take(owner, end).astype(np.int64)
    pair_of = edge_keys(first, second, n_labels)
    order = np.argsort(width, kind="stable")
    pairs, narrowest = np.unique(pair_of[order], return_index=True)
    chosen = order[narrowest]
    ends = (first[chosen], second[chosen])
    graph = sparse.csr_array((width[chosen], ends), shape=(n_labels, n_labels))
    tree = sparse.csgraph.minimum_spanning_tree(graph).tocoo()
    links = edge_keys(tree.row.astype(np.int64), tree.col.astype(np.int64), n_labels)
    contacts = chosen[np.searchsorted(pairs, links)]
    nearest = index.reshape(3, -1).astype(np.float64)
    return nearest[:, start[contacts]].T, nearest[:, end[contacts]].T


def _borders(owner: NDArray[np.int32]) -> tuple[Integers, Integers]:
    """Return the numbers (C,), in the flattened grid, of neighbouring points that have different owners."""
    _, n_y, n_z = owner.shape
    starts = []
    ends = []
    for axis, step in enumerate((n_y * n_z, n_z, 1)):
        borders = np.nonzero(np.diff(owner, axis=axis))
        here = np.ravel_multi_index(borders, owner.shape)
        starts.append(here)
        ends.append(here + step)
    return np.concatenate(starts), np.concatenate(ends)


def _add_bar(field: Singles, a: Floats, b: Floats, radius: float) -> None:
    margin = math.ceil(radius) + 1
    first = np.minimum(a, b).astype(int)
    last = np.maximum(a, b).astype(int)
    low = np.maximum(first - margin, 0)
    high = np.minimum(last + margin + 1, field.shape)
    box = tuple(map(slice, low, high))
    points = np.moveaxis(np.indices(high - low), 0, -1)
    from_a = points + low - a
    axis = b - a
    squared_length = max(float(axis @ axis), 1e-9)
    along = np.clip(from_a @ axis / squared_length, 0, 1)
    nearest = along[..., None] * axis
    distance = np.linalg.norm(from_a - nearest, axis=-1)
    field[box] = np.minimum(field[box], distance - radius)
