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
from igps.mesh.surface import face_areas

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
        shape = np.ceil((high - low) / cell).astype(int) + 1 + 2 * MARGIN
        # The grid is centred on the body, so that it moves with the body.
        origin = (low + high) / 2 - (shape - 1) / 2 * cell
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
    corners = vertices[faces]
    sides = np.ptp(corners.reshape(-1, 3), axis=0)
    longest = float(sides.max())
    area = float(face_areas(vertices, faces).sum())
    volume = float(np.prod(np.maximum(sides, longest / 1000)))
    by_volume = volume ** (1 / 3) / resolution
    by_area = float(np.sqrt(area / (6 * resolution**2)))
    min_size = min(max(by_volume, by_area), longest / (0.8 * resolution))
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
    size = 8  # blocks that may be near the surface are halved until they are single grid points
    blocks = _all_combinations([np.arange(0, n, size) for n in shape])
    while size > 1:
        centre = np.asfortranarray(blocks + (size - 1) / 2)
        squared, _, _ = igl.point_mesh_squared_distance(centre, vertices, faces)
        near = np.sqrt(squared) <= (size - 1) / 2 * np.sqrt(3) + _BAND
        size //= 2
        corner = size * _all_combinations([np.arange(2)] * 3)
        blocks = (blocks[near][:, None] + corner).reshape(-1, 3)
        blocks = blocks[(blocks < shape).all(axis=1)]
    points = np.asfortranarray(blocks.astype(np.float64))
    squared, _, point = igl.point_mesh_squared_distance(points, vertices, faces)
    distance = np.full(shape, np.inf, dtype=np.float32)
    nearest = np.zeros((*shape, 3), dtype=np.float32)
    in_band = squared <= _BAND**2
    at = tuple(blocks[in_band].T)
    distance[at] = np.sqrt(squared[in_band])
    nearest[at] = point[in_band]
    return distance, nearest


def _all_combinations(axes: Sequence[Integers]) -> Integers:
    """Return all points (P, 3) of a grid with these coordinates along its axes."""
    coordinates = np.meshgrid(*axes, indexing="ij")
    return np.stack(coordinates, axis=-1).reshape(-1, 3)


def level_set(
    distance: Singles, nearest: Singles, outside: Booleans, surface: OrientedSurface
) -> Singles:
    """Return the signed distance to the surface; sheets, which enclose nothing, get about a cell of thickness."""
    from skimage.segmentation import watershed

    band = np.isfinite(distance)
    wall = distance <= WALL
    at = np.nonzero(band)
    foot = nearest[at]
    height = distance[at]
    length = np.maximum(height, 1e-6)
    normal = (np.stack(at, axis=1) - foot) / length[:, None]
    # A wall point belongs to the side beyond it, away from the surface; if only wall lies beyond, to the side of its
    # deepest neighbours.
    sides = np.where(outside, 1, 2)
    markers = np.where(wall, 0, sides).astype(np.int32)
    undecided = np.nonzero(height <= WALL)[0]
    for step in (0.75, 1.0, 1.25):
        side = _nearest_values(markers, foot[undecided] + step * normal[undecided])
        decided = undecided[side > 0]
        markers[tuple(index[decided] for index in at)] = side[side > 0]
        undecided = undecided[side == 0]
    markers = watershed(-np.where(band, distance, _BAND), markers, connectivity=3)
    inside = markers == 2
    is_solid = _is_solid(inside, at, foot, normal)
    if surface.is_nearly_closed and not is_solid.all():
        # A flood cannot find the inside of walls that are thinner than a cell; the winding number can.
        thin = np.stack([index[~is_solid] for index in at], axis=1)
        inside[tuple(thin[surface.winding(thin) > 0.5].T)] = True
        is_solid = _is_solid(inside, at, foot, normal)
    # At least MIN_ABS_VALUE, because zero would have no sign.
    clipped = np.clip(distance, np.float32(MIN_ABS_VALUE), np.float32(_BAND))
    field = np.where(inside, -1, 1) * clipped
    sheet = tuple(index[~is_solid] for index in at)
    field[sheet] = distance[sheet] - _HALF_SHEET
    smallest = np.where(field < 0, -MIN_ABS_VALUE, MIN_ABS_VALUE)
    field = np.where(np.abs(field) < MIN_ABS_VALUE, smallest, field)
    return fill_bubbles(field.astype(np.float32))


def _is_solid(
    inside: Booleans, at: tuple[Integers, ...], foot: NDArray[Any], normal: NDArray[Any]
) -> Booleans:
    """Return whether each grid point is inside, or has an inside behind its nearest surface point."""
    is_solid = inside[at]
    for step in (0.25, 0.5, 0.75, 1.0):
        is_solid |= _nearest_values(inside, foot - step * normal)
    return np.asarray(is_solid)


def _nearest_values(values: NDArray[Any], points: NDArray[Any]) -> NDArray[Any]:
    last = np.array(values.shape) - 1
    index = np.clip(np.round(points).astype(np.int64), 0, last)
    return np.asarray(values[tuple(index.T)])


def fill_bubbles(field: Singles) -> Singles:
    """Make everything part of the body, in place, that is not connected with the outside."""
    label, count = ndimage.label(field > 0)
    if count > 1:
        field[(field > 0) & (label != label[0, 0, 0])] = -MIN_ABS_VALUE
    return field


def join_pieces(field: Singles, notes: list[str], radius: float = 0.0) -> Singles:
    """Drop small pieces, in place, and join the others by bars where the gaps are narrowest."""
    label, count = ndimage.label(field < 0)
    if count < 2:
        return field
    volume = np.bincount(label.ravel(), minlength=count + 1)
    volume[0] = 0
    specks = np.nonzero(volume < SPECK_VOLUME * volume.sum())[0][1:]
    if len(specks) and volume[specks].sum() < 0.05 * volume.sum():
        is_dropped = np.isin(label, specks)
        field[is_dropped] = -field[is_dropped]
        label[is_dropped] = 0
    pieces = np.unique(label)[1:]
    if len(pieces) < 2:
        return field
    # The width of a gap is measured where the regions touch that are nearest to either piece.
    distance, index = ndimage.distance_transform_edt(label == 0, return_indices=True)
    owner = label[tuple(index)]
    contacts = []
    positions = np.arange(field.size).reshape(field.shape)
    for axis in range(3):
        a: list[slice] = [slice(None)] * 3
        b: list[slice] = [slice(None)] * 3
        a[axis] = slice(None, -1)
        b[axis] = slice(1, None)
        here = tuple(a)
        there = tuple(b)
        width = distance[here] + distance[there] + 1
        pairs = (owner[here], owner[there], width, positions[here], positions[there])
        is_contact = owner[here] != owner[there]
        contacts.append([values[is_contact] for values in pairs])
    i, j, width, p, q = (np.concatenate(values) for values in zip(*contacts, strict=True))
    order = np.argsort(width, kind="stable")
    smaller = np.minimum(i, j).astype(np.int64)
    pair = smaller * (count + 1) + np.maximum(i, j)
    _, narrowest = np.unique(pair[order], return_index=True)
    chosen = order[narrowest]
    ends = (i[chosen], j[chosen])
    graph = sparse.csr_array((width[chosen], ends), shape=(count + 1,) * 2)
    tree = sparse.csgraph.minimum_spanning_tree(graph).tocoo()
    lookup = {(int(i[k]), int(j[k])): k for k in chosen}
    nearest = index.reshape(3, -1).astype(np.float64)
    bar_radius = max(radius, _MIN_BAR_RADIUS)
    for link in zip(tree.row.tolist(), tree.col.tolist(), strict=True):
        k = lookup[link]
        _add_bar(field, nearest[:, p[k]], nearest[:, q[k]], bar_radius)
    notes.append(f"joined {len(pieces)} pieces by bars")
    return fill_bubbles(field)


def _add_bar(field: Singles, a: Floats, b: Floats, radius: float) -> None:
    around = math.ceil(radius) + 1
    low = np.maximum(np.minimum(a, b).astype(int) - around, 0)
    above = np.maximum(a, b).astype(int) + around + 1
    high = np.minimum(above, field.shape)
    box = tuple(map(slice, low, high))
    from_a = np.moveaxis(np.indices(high - low), 0, -1) + low - a
    axis = b - a
    squared_length = max(float(axis @ axis), 1e-9)
    along = np.clip(from_a @ axis / squared_length, 0, 1)
    distance = np.linalg.norm(from_a - along[..., None] * axis, axis=-1)
    field[box] = np.minimum(field[box], distance - radius)
